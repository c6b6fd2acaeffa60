//! Motions that drive an avatar: recorded ones, and generated ones by name.

use std::path::Path;

use anyhow::{Result, bail, ensure};
use flyrig_body::{MotionClip, RetargetOptions, Template, load_bvh, load_gltf_motion};
use flyrig_sim::{MotionKind, clip_motion};
use flyrig_types::{Pose, PoseTrack};

/// Frame rate of images of a motion, frames per second.
pub(super) const FPS: f64 = 30.0;

/// Motion of an avatar: z up, the floor at z = 0, the middle of its path at the origin.
#[derive(Debug)]
pub(crate) struct DrivenMotion {
    /// File or name, for messages.
    what: String,
    track: PoseTrack,
}

impl DrivenMotion {
    /// Retargets a recorded motion (BVH or glTF file), or a generated one (its name), to the surface of an avatar.
    ///
    /// # Errors
    /// The file cannot be read or does not fit the body; no motion has this name.
    pub fn load(surface: &Template, motion: &Path) -> Result<Self> {
        let ending = motion.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default();
        let clip = match ending.as_str() {
            "bvh" => load_bvh(motion)?.motion(),
            "glb" | "gltf" => load_gltf_motion(motion)?,
            "" => generated(motion)?,
            _ => bail!("{} is neither BVH nor glTF (*.bvh, *.glb, *.gltf)", motion.display()),
        };
        // Centred, with steps of their own length.
        let options = RetargetOptions { reach_m: Some(f64::INFINITY), ..RetargetOptions::default() };
        Ok(Self { what: motion.display().to_string(), track: clip.retarget(surface, &options)? })
    }

    /// Returns the number of frames, at least one.
    pub fn frames(&self) -> u64 {
        let (first, last) = self.track.span_nanos();
        // Times of keys are rounded to nanoseconds.
        (last.saturating_sub(first) as f64 * 1e-9 * FPS + 1e-3) as u64 + 1
    }

    /// Checks that a frame exists.
    ///
    /// # Errors
    /// Names the number of frames.
    pub fn check(&self, frame: u64) -> Result<()> {
        let frames = self.frames();
        ensure!(
            frame < frames,
            "frame {frame} is past the end: {} has {frames} frames at {FPS} per second, 0 to {}",
            self.what,
            frames - 1
        );
        Ok(())
    }

    /// Returns the pose of a frame.
    pub fn pose(&self, frame: u64) -> Pose {
        self.track.at(self.track.span_nanos().0.saturating_add(nanos(frame)))
    }

    /// Returns all poses.
    pub fn track(&self) -> &PoseTrack {
        &self.track
    }
}

/// Returns the time of a frame, nanoseconds.
pub(super) fn nanos(frame: u64) -> i64 {
    (frame as f64 / FPS * 1e9) as i64
}

fn generated(motion: &Path) -> Result<MotionClip> {
    let name = motion.to_string_lossy();
    match MotionKind::CLIPS.iter().find(|(known, _)| *known == name) {
        Some((_, kind)) => Ok(clip_motion(*kind)?),
        None => bail!(
            "no motion is called {name}; name a file (*.bvh, *.glb, *.gltf) or one of {}",
            MotionKind::CLIPS.map(|(known, _)| known).join(", ")
        ),
    }
}

#[cfg(test)]
mod tests {
    use flyrig_body::{Joint, ShapeParams, Shoes, Skeleton, default_template, skin_mesh};
    use glam::{DMat4, DVec3};

    use super::*;

    /// Returns a shod body whose origin is the pelvis.
    fn body() -> Template {
        let body = Shoes { sole_m: 0.03 }.on(&default_template(&ShapeParams::man()).unwrap()).unwrap();
        let down = DVec3::Y * -0.93;
        let joint = |joint: &Joint| Joint {
            rest_translation: joint.rest_translation + if joint.parent.is_none() { down } else { DVec3::ZERO },
            joint_from_canonical: joint.joint_from_canonical * DMat4::from_translation(-down),
            ..joint.clone()
        };
        let skeleton = Skeleton::new(body.skeleton.joints().iter().map(joint).collect()).unwrap();
        let positions = body.positions.iter().map(|place| *place + down.as_vec3()).collect();
        Template { positions, skeleton, ..body }
    }

    #[test]
    fn every_generated_motion_stands_on_the_floor() {
        let body = body();
        for (name, kind) in MotionKind::CLIPS {
            let parsed: flyrig_sim::SimConfig = toml::from_str(&format!("[motion]\nkind = \"{name}\"")).unwrap();
            assert_eq!(parsed.motion.kind, kind, "{name}");
            let motion = DrivenMotion::load(&body, Path::new(name)).unwrap();
            assert!(motion.frames() > 30, "{name}: {} frames", motion.frames());
            let heights: Vec<f32> = (0..motion.frames())
                .step_by(7)
                .map(|frame| skin_mesh(&body, &motion.pose(frame)).0.iter().map(|place| place.z).fold(9.0, f32::min))
                .collect();
            let low = heights.iter().copied().fold(9.0, f32::min);
            let high = heights.iter().copied().fold(-9.0, f32::max);
            println!("{name}: lowest vertex at {:.0} to {:.0} mm", 1e3 * low, 1e3 * high);
            // Jumps and dances leave the floor; a body that lies or sits sinks into it by its flesh.
            let (least, most) = match name {
                "jump" | "dance" => (-0.02, 0.6),
                "lie" | "sit" => (-0.2, 0.2),
                _ => (-0.02, 0.02),
            };
            assert!(low > least && high < most, "{name}: the lowest vertex is at {low} to {high} m");
        }
    }

    #[test]
    fn frames_and_names_that_do_not_exist_are_refused_with_those_that_do() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let motion = DrivenMotion::load(&body, Path::new("turn")).unwrap();
        assert_eq!(motion.frames(), 301);
        motion.check(300).unwrap();
        let error = motion.check(301).unwrap_err().to_string();
        assert_eq!(error, "frame 301 is past the end: turn has 301 frames at 30 per second, 0 to 300");
        let error = DrivenMotion::load(&body, Path::new("wlk")).unwrap_err().to_string();
        assert!(
            error.starts_with(
                "no motion is called wlk; name a file (*.bvh, *.glb, *.gltf) or one of still, turn, walk,"
            ),
            "{error}"
        );
    }
}

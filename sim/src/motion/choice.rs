//! Pose track of a simulation: a clip or a file, chosen by the configuration or the seed.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use flyrig_body::{MotionClip, RetargetOptions, ShapeParams, Template, default_template, load_bvh, load_gltf_motion};
use flyrig_types::{Pose, PoseTrack};
use glam::DVec3;
use rand::{RngExt, SeedableRng, rngs::StdRng};

use crate::config::{MotionConfig, MotionKind, SimConfig};
use crate::error::SimError;
use crate::motion::clips::{clip, passing};
use crate::motion::fingers::with_fingers;
use crate::motion::puppet::Puppet;
use crate::person::assembly::Person;
use crate::person::shoes::SOLE_M;

const DEBIAN_CLIP: &str = "/usr/share/assimp/models/BVH/01_01.bvh";

/// Finds the walking clip 01_01 of the CMU motion capture database in Debian's `assimp-testmodels`.
///
/// # Errors
/// [`SimError::NoClip`] names the package.
pub fn find_debian_clip() -> Result<PathBuf, SimError> {
    existing(Path::new(DEBIAN_CLIP))
}

fn existing(path: &Path) -> Result<PathBuf, SimError> {
    if path.is_file() {
        return Ok(path.to_owned());
    }
    let mend = if path == Path::new(DEBIAN_CLIP) {
        "install it with `apt-get install assimp-testmodels`, name a file of yours in motion.bvh, or set motion.kind = \"turn\""
    } else {
        "check motion.bvh or motion.gltf, or set motion.kind = \"turn\" for a motion that needs no file"
    };
    Err(SimError::NoClip { path: path.to_owned(), mend })
}

/// Returns the configured motion of a person, standing on the floor, around the configured position.
pub(crate) fn track(config: &SimConfig, person: &Person) -> Result<PoseTrack, SimError> {
    let mut track = track_around_origin(config, person)?;
    if config.person.fingers {
        track = with_fingers(&track, &person.body.skeleton, config.seed)?;
    }
    let [x, y] = config.motion.at_m;
    if x == 0.0 && y == 0.0 {
        return Ok(track);
    }
    let moved = |(nanos, pose): &(i64, Pose)| {
        let root_translation = pose.root_translation + DVec3::new(x, y, 0.0);
        (*nanos, Pose { root_translation, ..pose.clone() })
    };
    Ok(PoseTrack::new(track.keys().iter().map(moved).collect())?)
}

fn track_around_origin(config: &SimConfig, person: &Person) -> Result<PoseTrack, SimError> {
    let skeleton = &person.body.skeleton;
    let motion = match config.motion.kind {
        MotionKind::BySeed => by_seed(config),
        _ => config.motion.clone(),
    };
    match motion.kind {
        MotionKind::Bvh => {
            let path = motion.bvh.as_deref().map_or_else(find_debian_clip, existing)?;
            recorded(&load_bvh(&path)?.motion(), &person.body, &motion)
        }
        MotionKind::Gltf => {
            let path = existing(motion.gltf.as_deref().unwrap_or(Path::new("motion.gltf")))?;
            recorded(&load_gltf_motion(&path)?, &person.body, &motion)
        }
        kind => {
            let puppet = Puppet::new(skeleton, &person.clothed)?;
            let clip = clip(kind, &puppet, config.seed, motion.turn_secs, motion.speed);
            if motion.speed > 0.0 && kind != MotionKind::Still {
                clip.track(&puppet, motion.phase)
            } else {
                clip.held(&puppet, motion.phase)
            }
        }
    }
}

/// Returns one cycle of a generated motion of the average body, for any body; other kinds stand still.
///
/// # Errors
/// [`SimError::NoJoint`], [`SimError::Pose`].
pub fn clip_motion(kind: MotionKind) -> Result<MotionClip, SimError> {
    let body = default_template(&ShapeParams::default())?;
    let puppet = Puppet::new(&body.skeleton, &body)?;
    let MotionConfig { turn_secs, speed, phase, .. } = MotionConfig::default();
    let track = clip(kind, &puppet, SimConfig::default().seed, turn_secs, speed).track(&puppet, phase)?;
    Ok(MotionClip::from_poses("the clip", &body.skeleton, &track))
}

/// Draws clip, speed and phase from the seed.
fn by_seed(config: &SimConfig) -> MotionConfig {
    use MotionKind::{CrossArms, Dance, Jump, Reach, Sit, Squat, Still, Turn, Walk, Wave};
    const KINDS: [MotionKind; 13] =
        [Turn, Turn, Walk, Walk, Walk, Dance, Dance, Wave, Squat, Reach, Sit, Jump, CrossArms];
    let mut dice = StdRng::seed_from_u64(config.seed ^ 0x6d6f_7469_6f6e);
    let kind = if dice.random_range(0..30) == 0 { Still } else { KINDS[dice.random_range(0..KINDS.len())] };
    let speed = config.motion.speed * dice.random_range(0.5..1.5);
    MotionConfig { kind, speed, phase: dice.random_range(0.0..1.0), ..config.motion.clone() }
}

/// Returns the track of a person who walks straight through the room, back on another line 0.8 m farther from the
/// centre, and so on. The seed chooses the direction, the pace, and whether the line passes the centre at 0.7 m or up
/// to 1.2 m. `reach_m` is the distance from the centre at which they turn round.
///
/// # Errors
/// [`SimError::NoJoint`], [`SimError::Pose`].
pub(crate) fn pass_by(person: &Person, seed: u64, reach_m: f64) -> Result<PoseTrack, SimError> {
    let mut dice = StdRng::seed_from_u64(seed ^ 0x7061_7373);
    let puppet = Puppet::new(&person.body.skeleton, &person.clothed)?;
    let (near_m, yaw) = (dice.random_range(0.7..1.2), dice.random_range(0.0..TAU));
    let clip = passing(&puppet, near_m, yaw, reach_m, dice.random_range(0.85..1.5), dice.random_range(0.7..1.2));
    clip.track(&puppet, dice.random_range(0.0..1.0))
}

/// Retargets a recorded motion to a person, around the origin, with the shoes' soles on the floor. Feet stay where the
/// source's stand.
fn recorded(clip: &MotionClip, body: &Template, motion: &MotionConfig) -> Result<PoseTrack, SimError> {
    let (start_secs, reach_m, sole_m) = (motion.start_secs, Some(motion.reach_m), f64::from(SOLE_M));
    let options = RetargetOptions { start_secs, reach_m, sole_m };
    let track = clip.retarget(body, &options)?;
    // Recorded at one speed, played at another; at none the first pose is held.
    let paced = |(nanos, pose): &(i64, Pose)| ((*nanos as f64 / motion.speed.max(1e-3)) as i64, pose.clone());
    let count = if motion.speed > 0.0 { track.keys().len() } else { 1 };
    let mut keys: Vec<(i64, Pose)> = track.keys().iter().take(count).map(paced).collect();
    keys.dedup_by_key(|key| key.0);
    Ok(PoseTrack::new(keys)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_clip_is_named_with_its_mend() {
        let error = existing(Path::new("/nowhere/walk.bvh")).unwrap_err().to_string();
        assert!(error.contains("/nowhere/walk.bvh") && error.contains("motion.kind"), "{error}");
        if let Err(error) = find_debian_clip() {
            assert!(error.to_string().contains("assimp-testmodels"));
        }
    }
}

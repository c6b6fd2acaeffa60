//! The pose track of a simulation.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use flyrig_body::{Template, load_bvh, skin_mesh};
use flyrig_types::PoseTrack;
use glam::DVec2;
use rand::{RngExt, SeedableRng, rngs::StdRng};

use crate::clips::{clip, passing};
use crate::person::Person;
use crate::puppet::Puppet;
use crate::{MotionConfig, MotionKind, SimConfig, SimError};

const DEBIAN_CLIP: &str = "/usr/share/assimp/models/BVH/01_01.bvh";

/// The walking clip 01_01 of the CMU motion capture database in Debian's `assimp-testmodels`.
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
        "check motion.bvh, or set motion.kind = \"turn\" for a motion that needs no file"
    };
    Err(SimError::NoClip { path: path.to_owned(), mend })
}

/// The configured motion of a person, standing on the floor, around the world's origin.
pub(crate) fn track(config: &SimConfig, person: &Person) -> Result<PoseTrack, SimError> {
    let skeleton = &person.body.skeleton;
    let motion = match config.motion.kind {
        MotionKind::BySeed => by_seed(config),
        _ => config.motion.clone(),
    };
    match motion.kind {
        MotionKind::Bvh => {
            let path = motion.bvh.as_deref().map_or_else(find_debian_clip, existing)?;
            let whole = load_bvh(&path)?.retarget(skeleton)?;
            let start_nanos = (motion.start_secs * 1e9) as i64;
            grounded(&whole, &person.clothed, start_nanos, motion.reach_m)
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

/// The seed's choice of clip, speed and phase.
fn by_seed(config: &SimConfig) -> MotionConfig {
    use MotionKind::{CrossArms, Dance, Jump, Reach, Sit, Squat, Still, Turn, Walk, Wave};
    const KINDS: [MotionKind; 13] =
        [Turn, Turn, Walk, Walk, Walk, Dance, Dance, Wave, Squat, Reach, Sit, Jump, CrossArms];
    let mut dice = StdRng::seed_from_u64(config.seed ^ 0x6d6f_7469_6f6e);
    let kind = if dice.random_range(0..30) == 0 { Still } else { KINDS[dice.random_range(0..KINDS.len())] };
    let speed = config.motion.speed * dice.random_range(0.5..1.5);
    MotionConfig { kind, speed, phase: dice.random_range(0.0..1.0), ..config.motion.clone() }
}

/// Somebody who walks straight through the room, back on another line 0.8 m farther from the centre, and so on. The
/// seed chooses the direction, the pace, and whether the line runs 0.7 m or up to 1.2 m beside the centre.
/// `reach_m` is how far from the centre they turn round.
///
/// # Errors
/// [`SimError::NoJoint`], [`SimError::Pose`].
#[allow(dead_code)]
pub(crate) fn pass_by(person: &Person, seed: u64, reach_m: f64) -> Result<PoseTrack, SimError> {
    let mut dice = StdRng::seed_from_u64(seed ^ 0x7061_7373);
    let puppet = Puppet::new(&person.body.skeleton, &person.clothed)?;
    let (near_m, yaw) = (dice.random_range(0.7..1.2), dice.random_range(0.0..TAU));
    let clip = passing(&puppet, near_m, yaw, reach_m, dice.random_range(0.85..1.5), dice.random_range(0.7..1.2));
    clip.track(&puppet, dice.random_range(0.0..1.0))
}

/// The track from `start_nanos` on, around the origin and no farther than `reach_m` from it, its deepest sole
/// on the floor.
fn grounded(track: &PoseTrack, clothed: &Template, start_nanos: i64, reach_m: f64) -> Result<PoseTrack, SimError> {
    const PROBES: usize = 24;
    let (first, last) = track.span_nanos();
    let start = (first + start_nanos).min(last);
    let mut keys: Vec<_> = vec![(0, track.at(start))];
    keys.extend(
        track.keys().iter().filter(|(nanos, _)| *nanos > start).map(|(nanos, pose)| (nanos - start, pose.clone())),
    );
    let path = || keys.iter().map(|(_, pose)| pose.root_translation.truncate());
    let low = path().fold(DVec2::INFINITY, DVec2::min);
    let high = path().fold(DVec2::NEG_INFINITY, DVec2::max);
    let middle = (low + high) * 0.5;
    let farthest = path().map(|at| at.distance(middle)).fold(0.0, f64::max);
    let scale = if farthest > reach_m { reach_m / farthest } else { 1.0 };
    let stride = keys.len().div_ceil(PROBES);
    let lowest = |pose| skin_mesh(clothed, pose).0.iter().map(|p| p.z).fold(f32::INFINITY, f32::min);
    let floor = keys.iter().step_by(stride).map(|(_, pose)| lowest(pose)).fold(f32::INFINITY, f32::min);
    for (_, pose) in &mut keys {
        let at = pose.root_translation;
        pose.root_translation = ((at.truncate() - middle) * scale).extend(at.z - f64::from(floor));
    }
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

//! The pose track of a simulation.

use std::path::{Path, PathBuf};

use flyrig_body::{Template, load_bvh, skin_mesh};
use flyrig_types::PoseTrack;
use glam::DVec2;

use crate::person::Person;
use crate::turn::turn_track;
use crate::{MotionKind, SimConfig, SimError};

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
    match config.motion.kind {
        MotionKind::Turn => turn_track(skeleton, config.motion.turn_secs),
        MotionKind::Bvh => {
            let path = config.motion.bvh.as_deref().map_or_else(find_debian_clip, existing)?;
            let whole = load_bvh(&path)?.retarget(skeleton)?;
            let start_nanos = (config.motion.start_secs * 1e9) as i64;
            grounded(&whole, &person.clothed, start_nanos, config.motion.reach_m)
        }
    }
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

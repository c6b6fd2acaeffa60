//! Up direction of a world, from a person who stands in the images.

use std::{path::Path, sync::Arc, time::Duration};

use anyhow::Result;
use flyrig_body::{ShapeParams, default_template};
use flyrig_capture::{CameraSource, FolderOptions, FolderReplay};
use flyrig_fusion::Upright;
use flyrig_tracker::{PoseConfig, PoseEstimate, PoseEstimator, PoseNet, TrackErrorKind};
use flyrig_types::{CameraId, FrameSet, Rig};

/// Frame sets that are looked at, spread over the take.
const SETS: usize = 3;
/// Most attempts to find the person in a frame set; each tries a few more crops.
const ATTEMPTS: usize = 8;
/// Least number of landmarks that two or more cameras agree on in a person who is seen the right way up, of 33.
const LEAST_AGREED: usize = 26;

/// Returns the mean direction from the feet to the head of the person in a data set's images (`images/CAM`); of no frame set
/// where two or more cameras do not agree on a person.
///
/// The person is searched for as the rig's up direction says, and where that does not convince the other way around: cameras may
/// hang upside down, and the network takes an upside-down person for another one.
///
/// # Errors
/// The images cannot be listed, or the network fails.
pub fn person_up(rig: &Rig, root: &Path) -> Result<Upright> {
    let sets = spread_sets(rig, root)?;
    let template = default_template(&ShapeParams::default())?;
    let net = PoseNet::embedded()?;
    let config = PoseConfig { masks: false, outline_rounds: 0, shape_rounds: 0, ..PoseConfig::default() };
    let mut best = (0, Upright::default());
    for up in [rig.world_up, -rig.world_up] {
        let estimator =
            PoseEstimator::new(net.clone(), &template, &Rig { world_up: up, ..rig.clone() }, config.clone())?;
        let (mut agreed, mut upright) = (0, Upright::default());
        for set in &sets {
            let Some(estimate) = estimate(estimator.clone(), set)? else { continue };
            let landmarks = estimate.quality.triangulated;
            if landmarks >= LEAST_AGREED
                && let Some(direction) = template.skeleton.standing(&estimate.pose)
            {
                agreed += landmarks;
                upright.add(direction);
            }
        }
        if agreed > best.0 {
            best = (agreed, upright);
        }
        if best.0 >= LEAST_AGREED * sets.len() {
            break;
        }
    }
    Ok(best.1)
}

/// Finds the person in a frame set; `None` where there is none.
fn estimate(mut estimator: PoseEstimator, set: &FrameSet) -> Result<Option<PoseEstimate>> {
    for _ in 0..ATTEMPTS {
        match estimator.estimate(set) {
            Ok(estimate) => return Ok(Some(estimate)),
            Err(error) if error.kind == TrackErrorKind::Lost => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(None)
}

/// Reads frame sets that are spread over the take; images that cannot be read are left out.
fn spread_sets(rig: &Rig, root: &Path) -> Result<Vec<FrameSet>> {
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let mut sources = FolderReplay::open(root, Some(&ids), &FolderOptions::default())?;
    let count = sources.iter().map(FolderReplay::remaining).min().unwrap_or(0);
    let mut sets = Vec::new();
    for index in 0..count {
        let wanted = (0..SETS).any(|i| i * (count - 1) / (SETS - 1).max(1) == index);
        let mut frames = Vec::new();
        for source in &mut sources {
            if wanted {
                frames.push(source.next_frame(Duration::ZERO).ok().map(Arc::new));
            } else {
                source.skip();
            }
        }
        if wanted {
            let master_nanos = frames.iter().flatten().map(|frame| frame.capture_nanos).next().unwrap_or(0);
            sets.push(FrameSet { index: index as u64, master_nanos, frames });
        }
    }
    Ok(sets)
}

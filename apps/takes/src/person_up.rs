//! Up direction of a world, from a person who stands in the images.

use anyhow::Result;
use flyrig_body::{ShapeParams, default_template};
use flyrig_capture::FolderOptions;
use flyrig_fusion::Upright;
use flyrig_tracker::{PoseConfig, PoseEstimate, PoseEstimator, PoseNet, TrackErrorKind};
use flyrig_types::{CameraId, FrameSet, Rig};

use crate::{
    footage::Footage,
    take::{Take, TakeSpan, ready},
};

/// Frame sets that are looked at, spread over the take.
const SETS: usize = 3;
/// Part of the take that they are spread over, seconds.
const REACH_S: f64 = 8.0;
/// Most attempts to find the person in a frame set; each tries a few more crops.
const ATTEMPTS: usize = 8;
/// Least number of landmarks that two or more cameras agree on in a person who is seen the right way up, of 33.
const LEAST_AGREED: usize = 26;

/// Returns the mean direction from the feet to the head of the person in stored footage, `fps` frames per second in a folder of images; of no frame set
/// where two or more cameras do not agree on a person.
///
/// The person is searched for as the rig's up direction says, and where that does not convince the other way around: cameras may
/// hang upside down, and the network takes an upside-down person for another one.
///
/// # Errors
/// The images cannot be listed, or the network fails.
pub fn person_up(rig: &Rig, footage: &Footage, fps: f64) -> Result<Upright> {
    let sets = spread_sets(rig, footage, fps)?;
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

/// Reads frame sets that are spread over the take's beginning; images that cannot be read are left out.
fn spread_sets(rig: &Rig, footage: &Footage, fps: f64) -> Result<Vec<FrameSet>> {
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let opened = footage.open(Some(&ids), &FolderOptions { fps, ..FolderOptions::default() })?;
    let end = opened.secs.unwrap_or(REACH_S).min(REACH_S);
    let take = Take::from_sources(ready(opened.sources));
    let (mut sets, mut begin): (Vec<FrameSet>, _) = (Vec::new(), None);
    // The last frame of a take ends before its duration.
    let due = |count: usize| (end * count as f64 / (SETS - 1).max(1) as f64 - 1.5 / fps).max(0.0);
    take.for_each_set(rig, TakeSpan { secs: [0.0, end], spread_nanos: 0 }, "which way is up, ms of the take", |set| {
        let begin = *begin.get_or_insert(set.master_nanos);
        let secs = set.master_nanos.saturating_sub(begin) as f64 * 1e-9;
        if sets.len() < SETS && secs >= due(sets.len()) {
            sets.push(set.clone());
        }
        Ok(())
    })?;
    Ok(sets)
}

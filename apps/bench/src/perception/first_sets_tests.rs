//! A moving person is tracked from the second frame set on, before any speed is known.

use std::sync::Arc;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{MotionConfig, MotionKind, RingConfig, SimConfig, Simulator};
use flyrig_tracker::{PoseConfig, PoseEstimator, PoseNet};
use flyrig_types::{Frame, FrameSet, Image};

const STEP_NANOS: i64 = 33_333_333;

fn set(simulator: &mut Simulator, index: u64, nanos: i64) -> FrameSet {
    let slots: Vec<usize> = (0..simulator.rig().cameras.len()).collect();
    let images = simulator.capture_all(nanos, &slots).unwrap();
    let frame = |(slot, (image, _)): (usize, (Image, _))| {
        let camera = simulator.rig().cameras[slot].id.clone();
        Some(Arc::new(Frame { camera, sequence: index, capture_nanos: nanos, exposure_nanos: None, image, mask: None }))
    };
    FrameSet { index, master_nanos: nanos, frames: images.into_iter().enumerate().map(frame).collect() }
}

#[test]
fn every_view_is_looked_at_until_the_motion_is_known() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let config = SimConfig {
        seed: 21,
        motion: MotionConfig { kind: MotionKind::Dance, ..MotionConfig::default() },
        cameras: RingConfig { count: 3, ..RingConfig::default() },
        width: 384,
        height: 384,
        texture_px: 256,
        ..SimConfig::default()
    };
    let mut simulator = Simulator::new(&gpu, &config).unwrap();
    let (template, rig) = (simulator.template().clone(), simulator.rig().clone());
    let mut estimator =
        PoseEstimator::new(PoseNet::embedded().unwrap(), &template, &rig, PoseConfig::default()).unwrap();
    // A search may take several sets.
    let first =
        (0..40).find(|&index| estimator.estimate(&set(&mut simulator, index, index as i64 * STEP_NANOS)).is_ok());
    let mut index = first.expect("the person is found");
    let mut next = |estimator: &mut PoseEstimator, nanos: i64| {
        index += 1;
        estimator.estimate(&set(&mut simulator, index, nanos)).unwrap()
    };
    let start = (first.unwrap() as i64) * STEP_NANOS;
    assert_eq!(next(&mut estimator, start + STEP_NANOS).quality.inferred, 3, "the speed is not known");
    // From now on only where the body is predicted to have moved: not within a millisecond.
    assert_eq!(next(&mut estimator, start + STEP_NANOS + 1_000_000).quality.inferred, 0);
}

//! Fingers of a simulated person estimated by the perception of the live system.

use std::sync::Arc;

use flyrig_fusion::{EstimatedPerception, Origin, Perception as _, PerceptionSettings, PersonObservation, StageTimes};
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{MotionConfig, MotionKind, PersonConfig, RingConfig, SimConfig, Simulator};
use flyrig_tracker::{HandConfig, HandTracker};
use flyrig_types::{Frame, FrameSet, Image, Mask, Pose};

const TIPS: [usize; 5] = [4, 8, 12, 16, 20];

fn frame_set(simulator: &mut Simulator, index: u64, nanos: i64) -> FrameSet {
    let slots: Vec<usize> = (0..simulator.rig().cameras.len()).collect();
    let pictures = simulator.capture_all(nanos, &slots).unwrap();
    let frame = |(slot, (image, mask)): (usize, (Image, Mask))| {
        let camera = simulator.rig().cameras[slot].id.clone();
        let frame =
            Frame { camera, sequence: index, capture_nanos: nanos, exposure_nanos: None, image, mask: Some(mask) };
        Some(Arc::new(frame))
    };
    FrameSet { index, master_nanos: nanos, frames: pictures.into_iter().enumerate().map(frame).collect() }
}

#[test]
fn estimated_fingers_are_nearer_to_the_true_ones_than_the_relaxed_hand() {
    let config = SimConfig {
        seed: 402,
        person: PersonConfig { fingers: true, ..PersonConfig::default() },
        motion: MotionConfig { kind: MotionKind::Still, ..MotionConfig::default() },
        cameras: RingConfig { count: 3, ..RingConfig::default() },
        width: 800,
        height: 800,
        texture_px: 256,
        ..SimConfig::default()
    };
    let mut simulator = Simulator::new(&GpuContext::new(&AdapterChoice::Best).unwrap(), &config).unwrap();
    let (rig, template) = (simulator.rig().clone(), simulator.template().clone());
    let plates: Vec<Option<Image>> = rig.cameras.iter().map(|_| None).collect();
    let settings = PerceptionSettings {
        shape: Some(Origin::Given),
        masks: Origin::Given,
        hands: Origin::Estimated,
        ..PerceptionSettings::default()
    };
    settings.validate().unwrap();
    let given_pose = PerceptionSettings { pose: Origin::Given, ..settings.clone() };
    assert!(given_pose.validate().unwrap_err().to_string().contains("perception.hands"));
    let mut perception = EstimatedPerception::new(&rig, &template, &settings, &plates).unwrap();
    assert_eq!(perception.people()[0].template.skeleton.joints().len(), 59);
    let off = HandConfig { fingers: false, head: false, ..HandConfig::default() };
    let mut relaxed = HandTracker::new(&template, &rig, off).unwrap();
    let measure = HandTracker::new(&template, &rig, off).unwrap();
    let (mut fitted_mm, mut relaxed_mm) = (0.0, 0.0);
    let mut seen = 0;
    for index in 0..4 {
        let nanos = index as i64 * 1_200_000_000;
        let set = frame_set(&mut simulator, index, nanos);
        let truth = simulator.pose(nanos);
        let mut stages = StageTimes::default();
        let observed = perception.observe(&set, &mut stages).unwrap();
        let [PersonObservation::Seen(person)] = observed.as_slice() else { continue };
        seen += 1;
        let (without, _) = relaxed.estimate(&set, &person.pose).unwrap();
        let off_mm = |pose: &Pose| {
            let (found, real) = (measure.hand_landmarks(pose).unwrap(), measure.hand_landmarks(&truth).unwrap());
            let tip = |side: usize, tip: usize| {
                (found[side][tip] - found[side][0]).distance(real[side][tip] - real[side][0]) * 1e3
            };
            (0..2).flat_map(|side| TIPS.map(|k| tip(side, k))).sum::<f64>() / 10.0
        };
        fitted_mm += off_mm(&person.pose);
        relaxed_mm += off_mm(&without);
    }
    assert!(seen >= 3, "the person was seen in {seen} sets of 4");
    assert!(fitted_mm < 0.75 * relaxed_mm, "fingertips {fitted_mm:.1} mm, relaxed {relaxed_mm:.1} mm, of {seen} sets");
}

//! Tests of the schedule: when the network runs again, and how landmarks are carried along until then.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

use std::sync::Arc;

use glam::{DVec2, DVec3};

use super::*;
use crate::image::crop::Crop;
use crate::network::output::{CropLandmark, NetOutput};
use crate::pose::body_model::BodyModel;
use crate::testing::{body, random_turns};

fn sighting() -> Sighting {
    let output = NetOutput { landmarks: [CropLandmark::default(); LANDMARK_COUNT], presence: 1.0, mask: None };
    let crop = Crop::upright(DVec2::splat(100.0), 200.0);
    let keypoints = crop.keypoints(&output);
    Sighting { crop, output, keypoints }
}

fn inference_at(marks: &[DVec3; LANDMARK_COUNT], turns: &JointTurns, nanos: i64) -> Inference {
    let body = InferredBody { nanos, turns: Arc::new(turns.clone()), marks: *marks };
    Inference { body: Some(body), ..Inference::fresh(sighting()) }
}

#[test]
fn views_without_an_inference_and_moved_views_are_due_and_still_ones_are_not() {
    let model = BodyModel::new(&body()).unwrap();
    let turns = random_turns(&model, 1);
    let marks = model.marks(&turns);
    let mut moved = marks;
    moved[15] += DVec3::new(0.0, 0.02, 0.0);
    let mut far = marks;
    far[15] += DVec3::new(0.0, 0.2, 0.0);
    let inferences = |a, b| vec![Some(inference_at(&a, &turns, 0)), Some(inference_at(&b, &turns, 0)), None];
    let due = |inferences: &[Option<Inference>], has_third, nanos| {
        due(inferences, |slot| slot < 2 || has_third, &marks, nanos, 0.01, 3)
    };
    assert_eq!(due(&inferences(marks, marks), false, 0), [false, false, false], "nobody moved");
    assert_eq!(due(&inferences(marks, marks), true, 0), [false, false, true], "no inference yet");
    assert_eq!(due(&inferences(marks, moved), false, 0), [false, true, false]);
    assert_eq!(due(&inferences(moved, far), false, 0), [false, true, false], "the other one waits for its turn");
    assert_eq!(due(&inferences(far, far), false, 0), [true, true, false], "too far to wait");
    assert_eq!(
        due(&inferences(marks, marks), false, 1_000_000_000),
        [true, true, false],
        "nothing stays believed for ever"
    );
    let one = super::due(&inferences(far, moved), |_| true, &marks, 0, 0.01, 1);
    assert_eq!(one, [true, false, true], "one view again, and the one without an inference");
    let always = super::due(&inferences(marks, marks), |_| true, &marks, 1, 0.0, 3);
    assert_eq!(always, [true, true, true], "without a limit all views are due");
}

#[test]
fn landmarks_are_carried_with_the_body_and_trusted_less() {
    let model = BodyModel::new(&body()).unwrap();
    let turns = random_turns(&model, 1);
    let then = model.marks(&turns);
    let mut now = then;
    now[0] += DVec3::new(CARRIED_M, 0.0, 0.0);
    let carried = inference_at(&then, &turns, 0).carried(&now, &now);
    assert!((carried[0].0 - DVec3::new(-CARRIED_M, 0.0, 0.0)).length() < 1e-12);
    assert!((carried[0].1 - 0.5).abs() < 1e-12);
    assert_eq!(carried[1], (DVec3::ZERO, 1.0));
    let fresh = Inference { body: None, ..inference_at(&then, &turns, 0) };
    assert_eq!(fresh.carried(&now, &now)[0], (DVec3::ZERO, 1.0));
}

//! Tests of looks: when the network looks again, and what is carried along until then.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

use std::sync::Arc;

use flyrig_body::skin_mesh;
use glam::{DVec2, DVec3};

use super::*;
use crate::image::crop::Crop;
use crate::network::output::{CropLandmark, NET_SIDE, NetOutput};
use crate::pose::body_model::BodyModel;
use crate::testing::{body, mask_of, random_turns, ring};

/// A network that sees a person on the coverage of an image.
fn sighting(crop: Crop, coverage: impl Fn(DVec2) -> f32) -> Sighting {
    let mut mask = Vec::new();
    for y in 0..NET_SIDE {
        for x in 0..NET_SIDE {
            mask.push(coverage(crop.to_image(DVec2::new(x as f64, y as f64))));
        }
    }
    let landmarks = [CropLandmark::default(); LANDMARK_COUNT];
    let output = NetOutput { landmarks, presence: 1.0, mask: Some(mask) };
    let keypoints = crop.keypoints(&output);
    Sighting { crop, output, keypoints }
}

fn look_at(marks: &[DVec3; LANDMARK_COUNT], turns: &Turns, nanos: i64) -> Look {
    let crop = Crop::upright(DVec2::splat(100.0), 200.0);
    let body = LookBody { nanos, turns: Arc::new(turns.clone()), marks: *marks };
    Look { body: Some(body), ..Look::fresh(sighting(crop, |_| 0.0)) }
}

#[test]
fn views_without_a_look_and_moved_views_are_due_and_still_ones_are_not() {
    let model = BodyModel::new(&body()).unwrap();
    let turns = random_turns(&model, 1);
    let marks = model.marks(&turns);
    let mut moved = marks;
    moved[15] += DVec3::new(0.0, 0.02, 0.0);
    let mut far = marks;
    far[15] += DVec3::new(0.0, 0.2, 0.0);
    let looks = |a, b| vec![Some(look_at(&a, &turns, 0)), Some(look_at(&b, &turns, 0)), None];
    let due =
        |looks: &[Option<Look>], has_third, nanos| due(looks, |slot| slot < 2 || has_third, &marks, nanos, 0.01, 3);
    assert_eq!(due(&looks(marks, marks), false, 0), [false, false, false], "nobody moved");
    assert_eq!(due(&looks(marks, marks), true, 0), [false, false, true], "no look yet");
    assert_eq!(due(&looks(marks, moved), false, 0), [false, true, false]);
    assert_eq!(due(&looks(moved, far), false, 0), [false, true, false], "the other one waits for its turn");
    assert_eq!(due(&looks(far, far), false, 0), [true, true, false], "too far to wait");
    assert_eq!(due(&looks(marks, marks), false, 1_000_000_000), [true, true, false], "nothing stays believed for ever");
    let one = super::due(&looks(far, moved), |_| true, &marks, 0, 0.01, 1);
    assert_eq!(one, [true, false, true], "one look again, and the one without a look");
    let always = super::due(&looks(marks, marks), |_| true, &marks, 1, 0.0, 3);
    assert_eq!(always, [true, true, true], "without a limit all views are looked at");
}

#[test]
fn landmarks_are_carried_with_the_body_and_trusted_less() {
    let model = BodyModel::new(&body()).unwrap();
    let turns = random_turns(&model, 1);
    let then = model.marks(&turns);
    let mut now = then;
    now[0] += DVec3::new(CARRIED_M, 0.0, 0.0);
    let carried = look_at(&then, &turns, 0).carried(&now, &now);
    assert!((carried[0].0 - DVec3::new(-CARRIED_M, 0.0, 0.0)).length() < 1e-12);
    assert!((carried[0].1 - 0.5).abs() < 1e-12);
    assert_eq!(carried[1], (DVec3::ZERO, 1.0));
    let fresh = Look { body: None, ..look_at(&then, &turns, 0) };
    assert_eq!(fresh.carried(&now, &now)[0], (DVec3::ZERO, 1.0));
}

#[test]
fn a_mask_is_carried_to_where_the_body_went() {
    let (template, camera) = (body(), ring(3).cameras[0].clone());
    let model = BodyModel::new(&template).unwrap();
    let turns = random_turns(&model, 5);
    let mut moved = turns.clone();
    moved.root += DVec3::new(0.12, 0.08, 0.0);
    let place = |turns: &Turns| corners(&camera, &skin_mesh(&template, &model.to_pose(turns)).0);
    let mask = |turns: &Turns| mask_of(&camera, &template, &model.to_pose(turns));
    let (before, after) = (mask(&turns), mask(&moved));
    let (width, height) = (before.width() as usize, before.height() as usize);
    let seen = sighting(Crop::upright(DVec2::new(width as f64, height as f64) * 0.5, width as f64), |at| {
        let (x, y) = (at.x.round().max(0.0) as usize, at.y.round().max(0.0) as usize);
        if x < width && y < height { f32::from(before.coverage()[y * width + x]) / 255.0 } else { 0.0 }
    });
    let carried = carried_mask(
        seen.output.mask.as_ref().unwrap(),
        seen.crop,
        &place(&turns),
        &place(&moved),
        [0, 0, width, height],
    );
    let overlap = |mask: &flyrig_types::Mask| {
        let pairs = carried.values.iter().zip(mask.coverage()).map(|(a, b)| (*a > 0.5, *b > 127));
        let (both, either) =
            pairs.fold((0, 0), |(both, either), (a, b)| (both + i32::from(a && b), either + i32::from(a || b)));
        f64::from(both) / f64::from(either)
    };
    assert!(overlap(&after) > 0.93, "{} of the mask of the moved body", overlap(&after));
    assert!(overlap(&before) < 0.8, "{} of the old one", overlap(&before));
}

#[test]
fn nothing_is_carried_of_a_body_out_of_view_and_poison_stays_out() {
    let seen = sighting(Crop::upright(DVec2::splat(16.0), 32.0), |_| 1.0);
    for corner in [None, Some((DVec2::NAN, f64::NAN)), Some((DVec2::splat(1e9), 1.0))] {
        let body = vec![corner; 5];
        let carried = carried_mask(seen.output.mask.as_ref().unwrap(), seen.crop, &body, &body, [0, 0, 8, 8]);
        assert!(carried.values.iter().all(|value| value.is_finite() && (0.0..=1.0).contains(value)));
    }
    assert!(
        carried_mask(seen.output.mask.as_ref().unwrap(), seen.crop, &Vec::new(), &Vec::new(), [3, 3, 3, 3])
            .values
            .is_empty()
    );
}

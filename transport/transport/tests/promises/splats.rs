//! The splat codec: error bounds, poisoned Gaussians, an end to what it accepts.

use std::{collections::BTreeSet, sync::Arc, time::Duration};

use flyrig_transport::{
    Interests, MAX_PERSON_TOPICS, MAX_SPLATS, PublishOutcome, SplatState, TransportError, TransportErrorKind,
};

use crate::support::*;

/// sRGB of a linear value, IEC 61966-2-1.
fn srgb(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[test]
fn every_number_stays_within_half_a_step() {
    let mut state = splats(11, 20_000);
    for (i, splat) in state.center_scale.iter_mut().enumerate() {
        // A person of 0.6 x 0.4 x 1.8 m, 3 m from the origin, Gaussians of 0 to 8 mm.
        *splat = [3.0 + 0.6 * splat[0], -0.4 * splat[1], 1.8 * splat[2], 0.008 * splat[3]];
        if i % 1000 == 0 {
            splat[3] = 0.0;
        }
    }
    let back = SplatState::decode(&state.encode().unwrap()).unwrap();
    let limit = state.position_error_m();
    assert!(limit.iter().all(|limit| *limit < 16e-6), "{limit:?}");
    let mut largest = [0.0f32; 3];
    for (a, b) in state.center_scale.iter().zip(&back.center_scale) {
        for axis in 0..3 {
            let error = (a[axis] - b[axis]).abs();
            assert!(error <= limit[axis], "axis {axis}: {error} > {}", limit[axis]);
            largest[axis] = largest[axis].max(error);
        }
        assert!((a[3] - b[3]).abs() <= 0.008 / 65_535.0 * 0.51, "{} {}", a[3], b[3]);
    }
    assert!(
        (0..3).all(|axis| largest[axis] > 0.5 * limit[axis]),
        "the stated bound is not tight: {largest:?} {limit:?}"
    );
    for (a, b) in state.color.iter().zip(&back.color) {
        assert!((0..3).all(|c| (srgb(a[c]) - srgb(b[c])).abs() <= 0.501 / 255.0), "{a:?} {b:?}");
        assert!((a[3] - b[3]).abs() <= 0.501 / 255.0);
    }
}

#[test]
fn encoding_what_was_decoded_changes_nothing_more() {
    let once = SplatState::decode(&splats(5, 3000).encode().unwrap()).unwrap();
    let twice = SplatState::decode(&once.encode().unwrap()).unwrap();
    assert_eq!(once.color, twice.color);
    for (a, b) in once.center_scale.iter().zip(&twice.center_scale) {
        assert!((0..4).all(|i| (a[i] - b[i]).abs() < 1e-6));
    }
}

#[test]
fn poisoned_gaussians_vanish_and_leave_the_rest_alone() {
    let mut state = splats(1, 10);
    let clean = SplatState::decode(&state.encode().unwrap()).unwrap();
    // Inner Gaussians, so that the box stays what it was.
    let extreme = |i: usize| {
        (0..4).any(|axis| {
            let of = |f: fn(f32, f32) -> f32, start| state.center_scale.iter().map(|s| s[axis]).fold(start, f);
            let value = state.center_scale[i][axis];
            value <= of(f32::min, f32::INFINITY) || value >= of(f32::max, f32::NEG_INFINITY)
        })
    };
    let inner: Vec<usize> = (0..10).filter(|i| !extreme(*i)).collect();
    assert!(inner.len() >= 2, "the scene leaves nothing to poison");
    state.center_scale[inner[0]][1] = f32::NAN;
    state.color[inner[1]][2] = f32::INFINITY;
    let back = SplatState::decode(&state.encode().unwrap()).unwrap();
    assert_eq!(back.invalid, 2);
    for i in 0..10 {
        if inner[..2].contains(&i) {
            assert_eq!((back.center_scale[i][3], back.color[i][3]), (0.0, 0.0), "{i}");
        } else {
            assert_eq!((back.center_scale[i], back.color[i]), (clean.center_scale[i], clean.color[i]), "{i}");
        }
    }
    let far = SplatState { center_scale: vec![[1e30; 4], [0.0; 4]], color: vec![[1.0; 4]; 2], ..SplatState::default() };
    assert_eq!(SplatState::decode(&far.encode().unwrap()).unwrap().invalid, 1);
    let lost = SplatState { center_scale: vec![[f32::NAN; 4]; 3], color: vec![[1.0; 4]; 3], ..SplatState::default() };
    assert_eq!(SplatState::decode(&lost.encode().unwrap()).unwrap().invalid, 3);
}

#[test]
fn the_edges_none_one_flat_and_too_many() {
    let none = SplatState::default();
    assert_eq!(SplatState::decode(&none.encode().unwrap()).unwrap(), none);
    let one = SplatState {
        center_scale: vec![[1.5, -2.5, 0.25, 0.125]],
        color: vec![[1.0, 0.0, 1.0, 1.0]],
        ..SplatState::default()
    };
    assert_eq!(SplatState::decode(&one.encode().unwrap()).unwrap(), one);
    let many =
        SplatState { center_scale: vec![[0.0; 4]; MAX_SPLATS + 1], color: vec![[0.0; 4]; MAX_SPLATS + 1], ..none };
    assert_eq!(TransportError::from(many.encode().unwrap_err()).kind, TransportErrorKind::Config);
    let uneven = SplatState { color: vec![], ..one };
    assert!(uneven.encode().unwrap_err().to_string().contains("1 positions but 0 colours"));
}

#[test]
fn persons_of_one_frame_do_not_replace_each_other() {
    let publisher = open_publisher(|_| {});
    let subscriber = open_subscriber(&publisher, &Interests { splats: true, ..Interests::default() });
    let mut seen = BTreeSet::new();
    wait_until("all three persons", || {
        for person in [0, 3, 7] {
            publisher.publish_splats(Arc::new(SplatState { person, ..splats(1, 50) }));
        }
        while let Some(received) = subscriber.next_splats(Duration::from_millis(20)).unwrap() {
            let topic =
                if received.body.person == 0 { "splats".into() } else { format!("splats/{}", received.body.person) };
            assert_eq!(received.topic, topic);
            seen.insert(received.body.person);
        }
        seen == [0, 3, 7].into()
    });
    // Persons come and go for days: topics are bounded, and the first person keeps its own.
    for person in 100..200 {
        assert_eq!(
            publisher.publish_splats(Arc::new(SplatState { person, ..splats(1, 5) })),
            PublishOutcome::Unwatched
        );
    }
    let counts = publisher.counts();
    let labels: Vec<&str> =
        counts.iter().map(|(label, _)| label.as_str()).filter(|l| l.starts_with("splats")).collect();
    assert_eq!(labels.len(), MAX_PERSON_TOPICS + 1, "{labels:?}");
    assert!(labels.contains(&"splats") && labels.contains(&"splats/199") && labels.contains(&"splats/184"));
    assert!(subscriber.next_splats(Duration::ZERO).is_ok());
}

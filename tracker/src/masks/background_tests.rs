//! Tests of backgrounds: light that changes, cameras that move, people who stand around, and poison.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking

use flyrig_types::PixelFormat;
use rand::{RngExt, SeedableRng, rngs::StdRng};

use super::*;
use crate::image::grid::Grid;
use crate::testing::small_camera;

const SIDE: usize = 96;

fn camera() -> Camera {
    small_camera("left", SIDE)
}

fn picture(seed: u64, paint: impl Fn(i64, i64) -> [f64; 3]) -> Image {
    let mut rng = StdRng::seed_from_u64(seed);
    let mut noisy = |c: f64| (c + rng.random_range(-2.0..2.0)).clamp(0.0, 255.0) as u8;
    let bytes: Vec<u8> =
        (0..SIDE * SIDE).flat_map(|at| paint((at % SIDE) as i64, (at / SIDE) as i64)).map(&mut noisy).collect();
    Image::new(SIDE as u32, SIDE as u32, PixelFormat::Rgb8, bytes).unwrap()
}

/// A wall with posters.
fn room(x: i64, y: i64) -> [f64; 3] {
    let poster = (x.div_euclid(11) * 7 + y.div_euclid(13) * 5).rem_euclid(4) as f64;
    [90.0 + 30.0 * poster, 70.0 + 26.0 * poster, 80.0 + 20.0 * poster]
}

fn dimmed(x: i64, y: i64) -> [f64; 3] {
    let [r, g, b] = room(x, y);
    [0.15 * r, 0.25 * g, 0.9 * b]
}

/// A gate around a body in the middle.
fn gate() -> BodyGate {
    let mut body = Grid::new(SIDE, SIDE, 0.0);
    for y in 30..70 {
        body.values[y * SIDE + 42..y * SIDE + 54].fill(1.0);
    }
    BodyGate::of_grid(&body, 60.0)
}

fn area(gate: &BodyGate) -> PersonArea<'static> {
    PersonArea { gate: gate.clone(), mask: None }
}

fn evidence(background: &Background, now: &Image) -> Option<Grid> {
    let picture = Rgb::new(now).unwrap();
    background.light(&picture, &|_| true)?.evidence(&picture, [0, 0, SIDE, SIDE])
}

fn wrong(background: &Background, now: &Image) -> usize {
    let evidence = evidence(background, now).unwrap();
    evidence.values.iter().filter(|v| **v > 0.5).count()
}

#[test]
fn a_switched_lamp_is_reported_once_and_the_room_is_learnt_anew() {
    let mut background = Background::from_plate(&camera(), &picture(1, room)).unwrap();
    let gate = gate();
    for seed in 2..6 {
        assert_eq!(background.update(&picture(seed, room), &[area(&gate)]).unwrap(), []);
    }
    let mut events = Vec::new();
    for seed in 10..30 {
        let now = picture(seed, dimmed);
        events.extend(background.update(&now, &[area(&gate)]).unwrap());
        if let Some(evidence) = evidence(&background, &now) {
            assert!(evidence.values.iter().all(|v| *v <= 0.5), "what is not known is no evidence");
        }
    }
    assert!(
        matches!(events[..], [BackgroundEvent::Changed(share), BackgroundEvent::Recovered] if share > 0.9),
        "{events:?}"
    );
    let now = picture(31, |x, y| if x < 12 { [250.0, 20.0, 20.0] } else { dimmed(x, y) });
    assert!((SIDE * 11..SIDE * 13).contains(&wrong(&background, &now)), "{}", wrong(&background, &now));
}

#[test]
fn an_unknown_background_is_learnt_away_from_body_and_mask_and_never_on_them() {
    let mut background = Background::unknown(&camera());
    let gate = gate();
    // The person reaches beyond the body, and the mask shows it.
    let person = |x: i64, y: i64| (38..58).contains(&x) && (26..74).contains(&y);
    let now = |seed| picture(seed, |x, y| if person(x, y) { [10.0; 3] } else { room(x, y) });
    let coverage = (0..SIDE * SIDE).map(|at| 255 * u8::from(person((at % SIDE) as i64, (at / SIDE) as i64)));
    let mask = Mask::new(SIDE as u32, SIDE as u32, coverage.collect()).unwrap();
    let knows = |background: &Background, x: usize, y: usize| {
        let Kind::Plate(plate) = &background.kind else { panic!("a learnt background is a plate") };
        plate.knows(y * SIDE + x)
    };
    assert!(evidence(&background, &now(0)).is_none() && background.is_learning());
    for seed in 0..10 {
        let area = PersonArea { gate: gate.clone(), mask: Some(&mask) };
        assert_eq!(background.update(&now(seed), &[area]).unwrap(), []);
    }
    assert!(knows(&background, 2, 50) && !knows(&background, 64, 50), "far first");
    for seed in 10..50 {
        let area = PersonArea { gate: gate.clone(), mask: Some(&mask) };
        assert_eq!(background.update(&now(seed), &[area]).unwrap(), []);
    }
    assert!(knows(&background, 64, 50), "then what is clear of the mask");
    for (x, y) in [(48, 50), (39, 50), (48, 27), (57, 73)] {
        assert!(!knows(&background, x, y), "the person at {x}, {y}");
    }
    // Without a mask nothing in reach is learnt.
    let mut careful = Background::unknown(&camera());
    for seed in 0..60 {
        assert_eq!(careful.update(&now(seed), &[area(&gate)]).unwrap(), []);
    }
    assert!(knows(&careful, 2, 50) && !knows(&careful, 64, 50) && !careful.is_learning());
}

#[test]
fn slow_light_and_white_balance_are_followed() {
    let mut background = Background::from_plate(&camera(), &picture(1, room)).unwrap();
    let gate = gate();
    for step in 0..60 {
        let warm = f64::from(step) / 60.0;
        let now = picture(step as u64, |x, y| {
            let lamp = 1.0 + 0.4 * warm * (x as f64 / SIDE as f64);
            std::array::from_fn(|k| room(x, y)[k] * lamp * [1.0 + 0.1 * warm, 1.0, 1.0 - 0.3 * warm][k])
        });
        assert_eq!(background.update(&now, &[area(&gate)]).unwrap(), [], "step {step}");
        assert!(wrong(&background, &now) < 40, "step {step}: {}", wrong(&background, &now));
    }
}

#[test]
fn a_shifted_plate_is_recognised() {
    let mut background = Background::from_plate(&camera(), &picture(1, room)).unwrap();
    let moved = picture(2, |x, y| room(x - 5, y + 3));
    let events = background.update(&moved, &[area(&gate())]).unwrap();
    assert_eq!(events, [BackgroundEvent::Shifted(5, -3)]);
    assert!(evidence(&background, &moved).is_none(), "the plate is not used");
}

#[test]
fn somebody_in_the_plate_is_reported_once_and_forgotten() {
    let in_plate = |x: i64, y: i64| if (6..20).contains(&x) && y > 30 { [20.0, 20.0, 60.0] } else { room(x, y) };
    let mut background = Background::from_plate(&camera(), &picture(1, in_plate)).unwrap();
    let (gate, mut events) = (gate(), Vec::new());
    for seed in 2..40 {
        events.extend(background.update(&picture(seed, room), &[area(&gate)]).unwrap());
    }
    let [BackgroundEvent::Differs(share, [x, y])] = events[..] else { panic!("{events:?}") };
    assert!(share > 0.05 && (8..18).contains(&x) && (50..75).contains(&y), "{share} at {x}, {y}");
    assert!(wrong(&background, &picture(50, room)) < 20);
}

#[test]
fn bodies_are_never_learnt_and_poison_does_no_harm() {
    let mut background = Background::from_plate(&camera(), &picture(1, room)).unwrap();
    let gate = gate();
    let person = |x: i64, y: i64| if (42..54).contains(&x) && (30..70).contains(&y) { [10.0; 3] } else { room(x, y) };
    for seed in 0..40 {
        assert_eq!(background.update(&picture(seed, person), &[area(&gate)]).unwrap(), []);
    }
    assert!(wrong(&background, &picture(60, person)) > 400);
    // The body everywhere, images of other sizes, black ones.
    let mut everywhere = Grid::new(SIDE, SIDE, 1.0);
    everywhere.values[0] = 1.0;
    assert_eq!(background.update(&picture(1, dimmed), &[area(&BodyGate::of_grid(&everywhere, 60.0))]).unwrap(), []);
    let small = Image::new(2, 2, PixelFormat::Rgb8, vec![0; 12]).unwrap();
    assert_eq!(background.update(&small, &[]).unwrap(), []);
    let black = picture(1, |_, _| [-9.0; 3]);
    let mut dark = Background::from_plate(&camera(), &black).unwrap();
    assert_eq!(dark.update(&black, &[]).unwrap(), []);
    let error = Background::from_plate(&camera(), &small).unwrap_err().to_string();
    assert!(error.contains("camera left") && error.contains("2x2") && error.contains("96x96"), "{error}");
}

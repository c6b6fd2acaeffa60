//! Tests of masks from a plate: shadows, skirts, drifting exposure and people of the background's colour.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

use flyrig_types::{Image, PixelFormat};
use rand::{RngExt, SeedableRng, rngs::StdRng};

use super::*;
use crate::masks::background::Background;
use crate::testing::small_camera;

const SIDE: usize = 96;

fn picture(paint: impl Fn(usize, usize) -> [f64; 3], seed: u64) -> Image {
    let mut rng = StdRng::seed_from_u64(seed);
    let mut bytes = Vec::new();
    for y in 0..SIDE {
        for x in 0..SIDE {
            bytes.extend(paint(x, y).map(|c| (c + rng.random_range(-2.0..2.0)).clamp(0.0, 255.0) as u8));
        }
    }
    Image::new(SIDE as u32, SIDE as u32, PixelFormat::Rgb8, bytes).unwrap()
}

fn wall(x: usize, y: usize) -> [f64; 3] {
    [120.0 + x as f64 * 0.5, 130.0 + y as f64 * 0.3, 110.0]
}

fn person(x: usize, y: usize) -> bool {
    (30..60).contains(&x) && (20..80).contains(&y)
}

/// Mask of an image from an image of the empty scene and the body.
fn mask_of(now: &Image, plate: &Image, gate: &BodyGate) -> Option<Mask> {
    Background::from_plate(&small_camera("a", SIDE), plate).unwrap().mask(now, gate).unwrap()
}

/// A gate around a body that is 4 pixels narrower than the person on every side.
fn gate() -> BodyGate {
    BodyGate::of_grid(&body(|x, y| (34..56).contains(&x) && (24..76).contains(&y)), 100.0)
}

fn body(inside: impl Fn(usize, usize) -> bool) -> Grid {
    let mut grid = Grid::new(SIDE, SIDE, 0.0);
    for at in 0..SIDE * SIDE {
        grid.values[at] = f32::from(inside(at % SIDE, at / SIDE));
    }
    grid
}

fn iou(mask: &Mask, truth: impl Fn(usize, usize) -> bool) -> f64 {
    let (mut both, mut either) = (0, 0);
    for y in 0..SIDE {
        for x in 0..SIDE {
            let found = mask.coverage()[y * SIDE + x] >= 128;
            both += usize::from(found && truth(x, y));
            either += usize::from(found || truth(x, y));
        }
    }
    both as f64 / either as f64
}

#[test]
fn the_person_is_found_and_neither_the_shadow_nor_things_far_from_the_body() {
    let plate = picture(wall, 1);
    let now = picture(
        |x, y| {
            if person(x, y) || (78..90).contains(&x) && y < 60 {
                [60.0, 60.0, 150.0]
            } else if (60..85).contains(&x) && y > 60 {
                wall(x, y).map(|c| c * 0.7)
            } else {
                wall(x, y)
            }
        },
        2,
    );
    let mask = mask_of(&now, &plate, &gate()).unwrap();
    assert!(iou(&mask, person) > 0.93, "{}", iou(&mask, person));
}

#[test]
fn a_skirt_that_hangs_on_the_body_is_kept_where_most_clothes_end() {
    let plate = picture(wall, 1);
    let skirt = |x: usize, y: usize| person(x, y) || (40..80).contains(&y) && x < 60 + (y - 40) * 3 / 4 && x >= 30;
    let now = picture(|x, y| if skirt(x, y) { [60.0, 60.0, 150.0] } else { wall(x, y) }, 2);
    let mask = mask_of(&now, &plate, &gate()).unwrap();
    // 22 pixels from the body are 22 cm; the reach ends at 32.
    assert!(mask.coverage()[78 * SIDE + 78] >= 128);
    assert!(iou(&mask, skirt) > 0.93, "{}", iou(&mask, skirt));
    // Without a skirt it is another object.
    let mask = mask_of(&now, &plate, &gate().of_known_clothes()).unwrap();
    assert_eq!(mask.coverage()[78 * SIDE + 79], 0);
    assert!(mask.coverage()[70 * SIDE + 62] >= 128);
}

#[test]
fn an_empty_scene_has_no_mask_off_the_body_even_when_the_exposure_drifts() {
    let plate = picture(wall, 1);
    let off_body = BodyGate::of_grid(&body(|x, y| x == 48 && y == 48), 60.0);
    let found = |now: &Image, plate: &Image| mask_of(now, plate, &off_body);
    assert_eq!(found(&picture(wall, 3), &plate), None);
    let brighter = picture(|x, y| wall(x, y).map(|c| c * 1.15), 4);
    assert_eq!(found(&brighter, &plate), None);
    let warmer = picture(|x, y| std::array::from_fn(|k| wall(x, y)[k] * [1.2, 1.0, 0.8][k]), 4);
    assert_eq!(found(&warmer, &plate), None, "white balance drifts by channel");
    let black = picture(|_, _| [0.0; 3], 5);
    assert_eq!(found(&black, &black), None);
}

#[test]
fn a_person_of_the_backgrounds_colour_is_kept_by_the_body() {
    let plate = picture(wall, 1);
    let mask = mask_of(&picture(wall, 3), &plate, &gate()).unwrap();
    let inner = iou(&mask, |x, y| (34..56).contains(&x) && (24..76).contains(&y));
    assert!(inner > 0.6, "{inner}");
}

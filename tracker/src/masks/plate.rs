//! Differences of an image from the empty scene of the same camera, and masks from them.

use flyrig_solve::median;
use flyrig_types::{Image, Mask};
use rayon::prelude::*;

use crate::gate::BodyGate;
use crate::grid::{Grid, clean, components};
use crate::pixels::Rgb;
use crate::{TrackError, TrackErrorKind};

/// A shadow darkens the plate to no less than this share, keeping its colour.
const SHADOW: f32 = 0.45;
/// Noise is believed to be at least this large, sRGB steps.
const MIN_NOISE: f32 = 2.0;
/// The exposure's drift is measured at every so many pixels.
const GAIN_STEP: usize = 17;
/// Channels outside of this range are clipped or mostly noise, and measure no gain.
const GAIN_RANGE: std::ops::RangeInclusive<f32> = 16.0..=245.0;
/// Limits of the exposure's drift.
const GAIN_LIMITS: (f32, f32) = (0.6, 1.6);
/// Samples that a gain needs.
const GAIN_SAMPLES: usize = 40;
/// Evidence added on the body, and inside of it by its depth over [`DEEP_M`]; taken off where most clothes end, and beyond.
const ON_BODY: f32 = 0.15;
const DEEP_IN_BODY: f32 = 0.35;
const OFF_BODY: f32 = 0.4;
/// Evidence where the background is not known.
pub(crate) const NO_EVIDENCE: f32 = 0.5;
/// Depth in the body, metres, from which only a sure difference of the image speaks against a person.
const DEEP_M: f64 = 0.04;

/// Returns the person's mask in an image from the empty scene of the same camera and the posed body; `None` when nothing
/// stands out near the body.
///
/// A pixel's colour is split into brightness along the plate's colour and a remainder (Horprasert et al. 1999): a remainder
/// beyond the image's own noise, or a brightness that no shadow explains, is foreground, unless it lies out of the gate's
/// reach. Farther away than most clothes hang, only what surely differs and touches something nearer counts: a wide skirt.
/// Large pieces stay, small holes are filled.
///
/// # Errors
/// Kind `Image` when the sizes differ or a format cannot be read.
pub fn mask_from_plate(image: &Image, plate: &Image, gate: &BodyGate) -> Result<Option<Mask>, TrackError> {
    let (picture, plate) = (Rgb::new(image)?, Rgb::new(plate)?);
    for (width, height, whose) in
        [(plate.width, plate.height, "plate"), (gate.image[0], gate.image[1], "camera's calibration")]
    {
        if (picture.width, picture.height) != (width, height) {
            return Err(TrackError::new(
                TrackErrorKind::Image,
                format!(
                    "the image is {}x{} but the {whose} {width}x{height}; take the plate with the same camera settings",
                    picture.width, picture.height
                ),
            ));
        }
    }
    let plate = floats(&plate);
    let drift = Drift::new(&picture, &plate, &|at| !gate.reaches_pixel(at));
    let evidence = plate_evidence(&picture, &plate, &drift, gate.bounds);
    Ok(evidence.and_then(|evidence| gated_mask(&evidence, gate)))
}

/// Returns the mask that evidence ([`plate_evidence`], in the gate's bounds) and the body give together.
pub(crate) fn gated_mask(evidence: &Grid, gate: &BodyGate) -> Option<Mask> {
    let ([x0, y0, ..], [width, height]) = (gate.bounds, gate.image);
    if (evidence.width, evidence.height) != (gate.distance.width, gate.distance.height) {
        return None;
    }
    // A vote among neighbours removes specks and closes pinholes.
    let mut voted = evidence.box_mean(1);
    let mut outside = gate.distance.clone();
    outside.values.iter_mut().for_each(|d| *d = f32::from(*d > 0.0));
    let depth = outside.distance_to_set();
    let deep_px = (DEEP_M * gate.px_per_m).max(1.0) as f32;
    for ((value, distance), depth) in voted.values.iter_mut().zip(&gate.distance.values).zip(&depth.values) {
        let prior = if *distance > 0.0 {
            ON_BODY - (ON_BODY + OFF_BODY) * distance.min(1.0)
        } else {
            ON_BODY + DEEP_IN_BODY * (depth / deep_px).min(1.0)
        };
        let is_out = *distance >= gate.reach;
        *value = if is_out { 0.0 } else { ((*value + prior - 0.5) * 2.0 + 0.5).clamp(0.0, 1.0) };
    }
    drop_what_hangs_on_nothing(&mut voted, &gate.distance);
    clean(&mut voted, (0.02 * gate.px_per_m).round().max(2.0) as usize);
    let least = (width * height / 5000).max(12);
    if voted.values.iter().filter(|v| **v >= 0.5).count() < least {
        return None;
    }
    voted.paste(width, height, x0, y0)
}

/// Clears pieces that lie farther from the body than most clothes as a whole: other things than a person's clothes.
fn drop_what_hangs_on_nothing(voted: &mut Grid, distance: &Grid) {
    let mut alone = Vec::new();
    let take_alone = |pixels: &[usize]| {
        if pixels.iter().all(|at| distance.values[*at] >= 1.0) {
            alone.extend_from_slice(pixels);
        }
    };
    components(voted, |value| value >= 0.5, take_alone);
    alone.into_iter().for_each(|at| voted.values[at] = 0.0);
}

/// Returns an image's bytes as numbers.
pub(crate) fn floats(picture: &Rgb) -> Vec<f32> {
    picture.bytes.iter().map(|byte| f32::from(*byte)).collect()
}

/// Exposure of an image relative to a plate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Drift {
    /// Image over plate, by channel.
    pub gain: [f32; 3],
    /// Standard deviation of the background after the gain, sRGB steps.
    pub noise: f32,
}

impl Drift {
    /// Measures the drift at pixels that are known to show the background.
    pub fn new(picture: &Rgb, plate: &[f32], is_background: &dyn Fn(usize) -> bool) -> Self {
        let away: Vec<usize> =
            (0..picture.width * picture.height).step_by(GAIN_STEP).filter(|at| is_background(*at)).collect();
        let ratio = |k: usize| {
            let pairs = away.iter().map(|at| (f32::from(picture.bytes[3 * at + k]), plate[3 * at + k]));
            let usable = pairs.filter(|(now, plate)| GAIN_RANGE.contains(now) && GAIN_RANGE.contains(plate));
            let mut ratios: Vec<f64> = usable.map(|(now, plate)| f64::from(now / plate)).collect();
            let enough = ratios.len() >= GAIN_SAMPLES;
            median(&mut ratios).filter(|_| enough).map(|gain| (gain as f32).clamp(GAIN_LIMITS.0, GAIN_LIMITS.1))
        };
        let gains: [Option<f32>; 3] = std::array::from_fn(ratio);
        // A channel that is dark or clipped everywhere drifts as the others do.
        let known: Vec<f32> = gains.iter().flatten().copied().collect();
        let mean = if known.is_empty() { 1.0 } else { known.iter().sum::<f32>() / known.len() as f32 };
        let gain = gains.map(|gain| gain.unwrap_or(mean));
        let difference =
            |at: usize, k: usize| (f32::from(picture.bytes[3 * at + k]) - gain[k] * plate[3 * at + k]).abs();
        let mut differences: Vec<f64> =
            away.iter().flat_map(|&at| (0..3).map(move |k| f64::from(difference(at, k)))).collect();
        let noise = (1.48 * median(&mut differences).unwrap_or(0.0) as f32).clamp(MIN_NOISE, 8.0);
        Self { gain, noise }
    }
}

/// Returns per-pixel evidence for a foreground inside of `bounds` (x0, y0, x1, y1, ends excluded), 0..=1 with the border at one
/// half; `None` when the sizes differ. `plate` holds sRGB values, three a pixel.
pub(crate) fn plate_evidence(picture: &Rgb, plate: &[f32], drift: &Drift, bounds: [usize; 4]) -> Option<Grid> {
    let [x0, y0, x1, y1] = bounds;
    if plate.len() != picture.bytes.len() || x1 > picture.width || y1 > picture.height {
        return None;
    }
    let Drift { gain, noise } = *drift;
    let mut grid = Grid::new(x1 - x0, y1 - y0, 0.0);
    let of_pixel = |(value, (now, plate)): (&mut f32, (&[u8], &[f32]))| {
        // A dark plate has no colour to speak of: lift it so that the split stays sound.
        let plate: [f32; 3] = std::array::from_fn(|k| gain[k] * plate[k] + 4.0);
        let now: [f32; 3] = std::array::from_fn(|k| f32::from(now[k]) + 4.0);
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let length = dot(plate, plate).sqrt();
        let along = dot(now, plate) / (length * length);
        let left: [f32; 3] = std::array::from_fn(|k| now[k] - along * plate[k]);
        let color = dot(left, left).sqrt() / (4.0 * noise);
        let change = (along - 1.0) * length;
        let light = if along < SHADOW {
            // Where feet touch the floor shadows are this dark, too.
            1.0 + (1.5 * (1.0 - along / SHADOW)).clamp(0.0, 1.0)
        } else if change > 0.0 {
            change / (7.0 * noise)
        } else {
            // Inside the shadow's range darkening alone is weak evidence.
            (-change / (16.0 * noise)).min(0.45 + 0.8 * (1.0 - along))
        };
        *value = color.max(light).min(2.0) * 0.5;
    };
    grid.rows_mut().for_each(|(y, values)| {
        let row = 3 * ((y + y0) * picture.width + x0)..3 * ((y + y0) * picture.width + x1);
        let pairs = picture.bytes[row.clone()].chunks_exact(3).zip(plate[row].chunks_exact(3));
        values.iter_mut().zip(pairs).for_each(of_pixel);
    });
    Some(grid)
}

#[cfg(test)]
mod tests {
    use super::*;
    use flyrig_types::PixelFormat;
    use rand::{RngExt, SeedableRng, rngs::StdRng};

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
        let mask = mask_from_plate(&now, &plate, &gate()).unwrap().unwrap();
        assert!(iou(&mask, person) > 0.93, "{}", iou(&mask, person));
    }

    #[test]
    fn a_skirt_that_hangs_on_the_body_is_kept_where_most_clothes_end() {
        let plate = picture(wall, 1);
        let skirt = |x: usize, y: usize| person(x, y) || (40..80).contains(&y) && x < 60 + (y - 40) * 3 / 4 && x >= 30;
        let now = picture(|x, y| if skirt(x, y) { [60.0, 60.0, 150.0] } else { wall(x, y) }, 2);
        let mask = mask_from_plate(&now, &plate, &gate()).unwrap().unwrap();
        // 22 pixels from the body are 22 cm; the reach ends at 32.
        assert!(mask.coverage()[78 * SIDE + 78] >= 128);
        assert!(iou(&mask, skirt) > 0.93, "{}", iou(&mask, skirt));
        // Of somebody who wears no skirt it is something else.
        let mask = mask_from_plate(&now, &plate, &gate().of_known_clothes()).unwrap().unwrap();
        assert_eq!(mask.coverage()[78 * SIDE + 79], 0);
        assert!(mask.coverage()[70 * SIDE + 62] >= 128);
    }

    #[test]
    fn an_empty_scene_has_no_mask_off_the_body_even_when_the_exposure_drifts() {
        let plate = picture(wall, 1);
        let off_body = BodyGate::of_grid(&body(|x, y| x == 48 && y == 48), 60.0);
        let mask = |now: &Image, plate: &Image| mask_from_plate(now, plate, &off_body).unwrap();
        assert_eq!(mask(&picture(wall, 3), &plate), None);
        let brighter = picture(|x, y| wall(x, y).map(|c| c * 1.15), 4);
        assert_eq!(mask(&brighter, &plate), None);
        let warmer = picture(|x, y| std::array::from_fn(|k| wall(x, y)[k] * [1.2, 1.0, 0.8][k]), 4);
        assert_eq!(mask(&warmer, &plate), None, "white balance drifts by channel");
        let black = picture(|_, _| [0.0; 3], 5);
        assert_eq!(mask(&black, &black), None);
    }

    #[test]
    fn a_person_of_the_backgrounds_colour_is_kept_by_the_body() {
        let plate = picture(wall, 1);
        let mask = mask_from_plate(&picture(wall, 3), &plate, &gate()).unwrap().unwrap();
        let inner = iou(&mask, |x, y| (34..56).contains(&x) && (24..76).contains(&y));
        assert!(inner > 0.6, "{inner}");
    }

    #[test]
    fn other_sizes_are_refused() {
        let plate = Image::new(2, 2, PixelFormat::Rgb8, vec![0; 12]).unwrap();
        let refused = |now: &Image, plate: &Image| mask_from_plate(now, plate, &gate()).unwrap_err().kind;
        assert_eq!(refused(&picture(wall, 1), &plate), TrackErrorKind::Image);
        assert_eq!(refused(&plate, &plate), TrackErrorKind::Image, "the gate is of another size");
    }
}

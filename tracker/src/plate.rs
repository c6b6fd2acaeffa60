//! Masks from an empty plate.

use flyrig_solve::median;
use flyrig_types::{Image, Mask};

use crate::grid::{Grid, clean};
use crate::pixels::Rgb;
use crate::{TrackError, TrackErrorKind};

/// A shadow darkens the plate to no less than this share, keeping its colour.
const SHADOW: f32 = 0.45;
/// Noise is believed to be at least this large, sRGB steps.
const MIN_NOISE: f32 = 2.0;

/// Person mask of a picture from the empty scene of the same camera; `None` when nothing stands out.
///
/// A pixel's colour is split into brightness along the plate's colour and what is left over (Horprasert et
/// al. 1999): a left-over beyond the picture's own noise, or a brightness that no shadow explains, is
/// foreground. The largest pieces stay, small holes are filled.
///
/// # Errors
/// Kind `Image` when the sizes differ or a format cannot be read.
pub fn mask_from_plate(image: &Image, plate: &Image) -> Result<Option<Mask>, TrackError> {
    if (image.width(), image.height()) != (plate.width(), plate.height()) {
        return Err(TrackError::new(
            TrackErrorKind::Image,
            format!(
                "the picture is {}x{} but the plate {}x{}; take the plate with the same camera settings",
                image.width(),
                image.height(),
                plate.width(),
                plate.height()
            ),
        ));
    }
    Ok(foreground(&Rgb::new(image)?, &Rgb::new(plate)?.bytes))
}

/// The same on plain bytes of equal size.
pub(crate) fn foreground(picture: &Rgb, plate: &[u8]) -> Option<Mask> {
    let (width, height) = (picture.width, picture.height);
    let evidence = plate_evidence(picture, plate)?;
    // A vote among neighbours removes specks and closes pinholes.
    let mut voted = evidence.box_mean(1);
    for value in &mut voted.values {
        *value = ((*value - 0.5) * 2.0 + 0.5).clamp(0.0, 1.0);
    }
    clean(&mut voted, (width.max(height) / 60).max(2));
    let least = (width * height / 5000).max(12);
    if voted.values.iter().filter(|v| **v >= 0.5).count() < least {
        return None;
    }
    voted.paste(width, height, 0, 0)
}

/// How much each pixel speaks for a foreground, 0..=1 with the border at one half; `None` when the sizes differ.
pub(crate) fn plate_evidence(picture: &Rgb, plate: &[u8]) -> Option<Grid> {
    let (width, height) = (picture.width, picture.height);
    if plate.len() != picture.bytes.len() {
        return None;
    }
    let pairs = || picture.bytes.chunks_exact(3).zip(plate.chunks_exact(3));
    // The exposure may have drifted: the median of the brightness ratio is the background's.
    let brightness = |c: &[u8]| f64::from(c[0]) + f64::from(c[1]) + f64::from(c[2]);
    let mut gains: Vec<f64> = pairs()
        .step_by(17)
        .filter(|(_, plate)| brightness(plate) > 60.0)
        .map(|(now, plate)| brightness(now) / brightness(plate))
        .collect();
    let gain = median(&mut gains).unwrap_or(1.0).clamp(0.7, 1.4) as f32;
    let mut differences: Vec<f64> = pairs()
        .step_by(17)
        .flat_map(|(now, plate)| (0..3).map(move |k| f64::from((f32::from(now[k]) - gain * f32::from(plate[k])).abs())))
        .collect();
    let noise = (1.48 * median(&mut differences).unwrap_or(0.0) as f32).clamp(MIN_NOISE, 8.0);
    let mut grid = Grid::new(width, height, 0.0);
    for (value, (now, plate)) in grid.values.iter_mut().zip(pairs()) {
        let now: [f32; 3] = std::array::from_fn(|k| f32::from(now[k]));
        // A dark plate has no colour to speak of: lift it so that the split stays sound.
        let plate: [f32; 3] = std::array::from_fn(|k| gain * f32::from(plate[k]) + 4.0);
        let now = now.map(|n| n + 4.0);
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let length = dot(plate, plate).sqrt();
        let along = dot(now, plate) / (length * length);
        let left: [f32; 3] = std::array::from_fn(|k| now[k] - along * plate[k]);
        let color = dot(left, left).sqrt() / (4.0 * noise);
        let change = (along - 1.0) * length;
        let light = if along < SHADOW {
            2.0
        } else if change > 0.0 {
            change / (7.0 * noise)
        } else {
            // Inside the shadow's range darkening alone is weak evidence.
            (-change / (16.0 * noise)).min(0.45 + 0.8 * (1.0 - along))
        };
        *value = color.max(light).min(2.0) * 0.5;
    }
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

    #[test]
    fn the_person_is_found_and_the_shadow_is_not() {
        let plate = picture(wall, 1);
        let now = picture(
            |x, y| {
                if person(x, y) {
                    [60.0, 60.0, 150.0]
                } else if (60..85).contains(&x) && y > 60 {
                    wall(x, y).map(|c| c * 0.7)
                } else {
                    wall(x, y)
                }
            },
            2,
        );
        let mask = mask_from_plate(&now, &plate).unwrap().unwrap();
        let (mut both, mut either) = (0, 0);
        for y in 0..SIDE {
            for x in 0..SIDE {
                let found = mask.coverage()[y * SIDE + x] >= 128;
                both += usize::from(found && person(x, y));
                either += usize::from(found || person(x, y));
            }
        }
        assert!(f64::from(both as u32) / f64::from(either as u32) > 0.93, "{both} of {either}");
    }

    #[test]
    fn an_empty_scene_has_no_mask_even_when_the_exposure_drifts() {
        let plate = picture(wall, 1);
        assert_eq!(mask_from_plate(&picture(wall, 3), &plate).unwrap(), None);
        let brighter = picture(|x, y| wall(x, y).map(|c| c * 1.15), 4);
        assert_eq!(mask_from_plate(&brighter, &plate).unwrap(), None);
        let black = picture(|_, _| [0.0; 3], 5);
        assert_eq!(mask_from_plate(&black, &black).unwrap(), None);
    }

    #[test]
    fn another_size_is_refused() {
        let plate = Image::new(2, 2, PixelFormat::Rgb8, vec![0; 12]).unwrap();
        assert_eq!(mask_from_plate(&picture(wall, 1), &plate).unwrap_err().kind, TrackErrorKind::Image);
    }
}

//! Evidence for a foreground: differences of an image from the empty scene of the same camera.
//!
//! A pixel's colour is split into brightness along the plate's colour and a remainder (Horprasert, Harwood and Davis 1999).
//! A remainder beyond the image's own noise, or a brightness that no shadow explains, is foreground.

use rayon::prelude::*;

use crate::image::grid::Grid;
use crate::image::pixels::Rgb;
use crate::masks::drift::Drift;

/// Least share of its brightness that a shadow leaves to the plate, while its colour stays.
const SHADOW: f32 = 0.45;
/// Evidence where the background is unknown.
pub(crate) const NO_EVIDENCE: f32 = 0.5;

/// Returns per-pixel evidence for a foreground inside `bounds` (x0, y0, x1, y1, ends excluded), 0..=1 with the border at
/// one half; `None` when the sizes differ. `plate` holds three sRGB values per pixel.
pub(crate) fn plate_evidence(picture: &Rgb, plate: &[f32], drift: &Drift, bounds: [usize; 4]) -> Option<Grid> {
    let [x0, y0, x1, y1] = bounds;
    if plate.len() != picture.bytes.len() || x1 > picture.width || y1 > picture.height {
        return None;
    }
    let mut grid = Grid::new(x1 - x0, y1 - y0, 0.0);
    grid.rows_mut().for_each(|(y, values)| {
        let row = 3 * ((y + y0) * picture.width + x0)..3 * ((y + y0) * picture.width + x1);
        flyrig_types::vectorized(Row { now: &picture.bytes[row.clone()], plate: &plate[row], drift, values });
    });
    Some(grid)
}

/// Pixels whose evidence is computed side by side.
const LANES: usize = 16;

/// Evidence of a row of pixels, compiled for the processor's vector instructions.
struct Row<'a> {
    now: &'a [u8],
    plate: &'a [f32],
    drift: &'a Drift,
    values: &'a mut [f32],
}

impl pulp::NullaryFnOnce for Row<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let pixels = self.now.chunks(3 * LANES).zip(self.plate.chunks(3 * LANES));
        for (values, (now, plate)) in self.values.chunks_mut(LANES).zip(pixels) {
            // By channel; what is beyond the row's end is computed and dropped.
            let (mut colors, mut plates) = ([[0.0f32; LANES]; 3], [[0.0f32; LANES]; 3]);
            for (i, (now, plate)) in now.chunks_exact(3).zip(plate.chunks_exact(3)).enumerate() {
                for k in 0..3 {
                    // A dark plate has hardly any colour: lift it so that the split stays sound.
                    colors[k][i] = f32::from(now[k]) + 4.0;
                    plates[k][i] = self.drift.gain[k] * plate[k] + 4.0;
                }
            }
            let found = evidence(&colors, &plates, self.drift.noise);
            values.copy_from_slice(&found[..values.len()]);
        }
    }
}

/// Returns the evidence of [`LANES`] pixels from their colours and the plate's, by channel.
#[inline(always)]
fn evidence(now: &[[f32; LANES]; 3], plate: &[[f32; LANES]; 3], noise: f32) -> [f32; LANES] {
    std::array::from_fn(|i| {
        let (now, plate) = (now.map(|channel| channel[i]), plate.map(|channel| channel[i]));
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let length = dot(plate, plate).sqrt();
        let along = dot(now, plate) / (length * length);
        let left: [f32; 3] = std::array::from_fn(|k| now[k] - along * plate[k]);
        let color = dot(left, left).sqrt() / (4.0 * noise);
        let change = (along - 1.0) * length;
        // Where feet touch the floor shadows are this dark, too.
        let dark = 1.0 + (1.5 * (1.0 - along / SHADOW)).clamp(0.0, 1.0);
        let bright = change / (7.0 * noise);
        // Inside the shadow's range darkening alone is weak evidence.
        let shaded = (-change / (16.0 * noise)).min(0.45 + 0.8 * (1.0 - along));
        let light = if along < SHADOW {
            dark
        } else if change > 0.0 {
            bright
        } else {
            shaded
        };
        color.max(light).min(2.0) * 0.5
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Evidence of one pixel by the definition, in f64.
    fn plain(now: [u8; 3], plate: [f32; 3], drift: &Drift) -> f64 {
        let plate: [f64; 3] = std::array::from_fn(|k| f64::from(drift.gain[k]) * f64::from(plate[k]) + 4.0);
        let now = now.map(|byte| f64::from(byte) + 4.0);
        let noise = f64::from(drift.noise);
        let length2: f64 = plate.iter().map(|p| p * p).sum();
        let along = now.iter().zip(plate).map(|(n, p)| n * p).sum::<f64>() / length2;
        let left: f64 = now.iter().zip(plate).map(|(n, p)| (n - along * p).powi(2)).sum();
        let change = (along - 1.0) * length2.sqrt();
        let light = match along {
            _ if along < 0.45 => 1.0 + (1.5 * (1.0 - along / 0.45)).min(1.0),
            _ if change > 0.0 => change / (7.0 * noise),
            _ => (-change / (16.0 * noise)).min(0.45 + 0.8 * (1.0 - along)),
        };
        (left.sqrt() / (4.0 * noise)).max(light).min(2.0) * 0.5
    }

    #[test]
    fn evidence_is_that_of_the_definition_in_any_part_of_an_image() {
        let (width, height) = (53usize, 7usize);
        let byte = |i: usize| ((i * 7919) % 256) as u8;
        let picture = Rgb { width, height, bytes: (0..3 * width * height).map(byte).collect::<Vec<_>>().into() };
        // From far darker to far brighter than the image.
        let plate: Vec<f32> =
            (0..3 * width * height).map(|i| f32::from(byte(i)) * (0.2 + (i % 31) as f32 / 15.0)).collect();
        let drift = Drift { gain: [0.9, 1.0, 1.2], noise: 3.0 };
        for bounds in [[0, 0, 53, 7], [5, 2, 5, 2], [1, 1, 2, 7], [20, 3, 52, 4]] {
            let grid = plate_evidence(&picture, &plate, &drift, bounds).unwrap();
            assert_eq!((grid.width, grid.height), (bounds[2] - bounds[0], bounds[3] - bounds[1]));
            for (at, found) in grid.values.iter().enumerate() {
                let pixel = (bounds[1] + at / grid.width) * width + bounds[0] + at % grid.width;
                let of = |k: usize| plate[3 * pixel + k];
                let expected = plain(picture.pixel(pixel % width, pixel / width), [of(0), of(1), of(2)], &drift);
                assert!((f64::from(*found) - expected).abs() < 1e-4, "{pixel}: {found} {expected}");
            }
        }
        assert!(plate_evidence(&picture, &plate, &drift, [0, 0, 54, 7]).is_none());
        assert!(plate_evidence(&picture, &plate[3..], &drift, [0, 0, 53, 7]).is_none());
        let poisoned = plate_evidence(&picture, &vec![f32::NAN; plate.len()], &drift, [0, 0, 53, 7]).unwrap();
        assert!(poisoned.values.iter().all(|value| (0.0..=1.0).contains(value)));
    }
}

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
    let Drift { gain, noise } = *drift;
    let mut grid = Grid::new(x1 - x0, y1 - y0, 0.0);
    let of_pixel = |(value, (now, plate)): (&mut f32, (&[u8], &[f32]))| {
        // A dark plate has hardly any colour: lift it so that the split stays sound.
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

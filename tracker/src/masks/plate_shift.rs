//! Shift of an image against the plate, as after a camera was moved.

use crate::image::pixels::Rgb;

/// Range of shifts that are searched, pixels, and the smallest one that is reported.
const FAR_SHIFT: i64 = 8;
const LEAST_SHIFT: i64 = 2;
/// Largest share of the unshifted difference that may remain at the best shift.
const SHIFT_GAIN: f64 = 0.6;
/// Least contrast of the plate's brightness over four pixels at an informative place, sRGB steps, and the places needed.
const SHIFT_EDGE: f32 = 14.0;
const SHIFT_SAMPLES: usize = 120;

/// Returns the shift (x, y) of an image against the plate, pixels; `None` unless a shift explains most of their difference.
/// `plate` holds three sRGB values per pixel; `away` marks pixels that no person reaches.
pub(crate) fn find_shift(picture: &Rgb, plate: &[f32], away: &[bool]) -> Option<[i64; 2]> {
    let (width, height) = (picture.width as i64, picture.height as i64);
    let first = |x: i64, y: i64| 3 * (y * width + x) as usize;
    let empty = |x: i64, y: i64| plate[first(x, y)..first(x, y) + 3].iter().sum::<f32>() / 3.0;
    let now = |x: i64, y: i64| {
        let sum: u32 = picture.bytes[first(x, y)..first(x, y) + 3].iter().map(|c| u32::from(*c)).sum();
        sum as f32 / 3.0
    };
    let edge = |x: i64, y: i64| {
        let (across, down) = (empty(x + 2, y) - empty(x - 2, y), empty(x, y + 2) - empty(x, y - 2));
        across.abs().max(down.abs()) > SHIFT_EDGE
    };
    let margin = FAR_SHIFT + 2;
    let mut places = Vec::new();
    for y in (margin..height - margin).step_by(3) {
        let row = (margin..width - margin).step_by(3);
        places.extend(row.filter(|&x| away[(y * width + x) as usize] && edge(x, y)).map(|x| (x, y)));
    }
    if places.len() < SHIFT_SAMPLES {
        return None;
    }
    let difference = |dx: i64, dy: i64| {
        let of = |&(x, y): &(i64, i64)| f64::from((now(x + dx, y + dy) - empty(x, y)).abs()).min(60.0);
        places.iter().map(of).sum::<f64>()
    };
    let shifts = (-FAR_SHIFT..=FAR_SHIFT).flat_map(|dy| (-FAR_SHIFT..=FAR_SHIFT).map(move |dx| [dx, dy]));
    let best = shifts.map(|[dx, dy]| (difference(dx, dy), [dx, dy])).min_by(|a, b| a.0.total_cmp(&b.0))?;
    let far = best.1[0].abs().max(best.1[1].abs()) >= LEAST_SHIFT;
    (far && best.0 < SHIFT_GAIN * difference(0, 0)).then_some(best.1)
}

//! Pixels at a person's outline. Their colours are mixed with the background and would leave streaks on the avatar
//! along each camera's outline. They are compared by coverage alone.

use rayon::prelude::*;

/// Distance from the outline within which pixels are mixed, pixels.
const RIM_PX: usize = 1;
/// Largest distance of a marked pixel from an unmarked one inside, pixels.
const REACH_PX: usize = 3;
/// Least mask value of a pixel that shows the person alone.
const WHOLE: u8 = 250;

/// Marks the pixels of a person (`rgba`: the mask is the alpha, `width` pixels a row) that lie near the outline and
/// beside pixels farther inside. Parts thinner than the rims of both sides are not marked, since their colours would be
/// unknown.
pub(crate) fn mixed(rgba: &[u8], width: usize) -> Vec<bool> {
    let height = rgba.len() / 4 / width.max(1);
    let around = |i: usize, reach: usize| {
        let (x, y) = (i % width, i / width);
        let rows = y.saturating_sub(reach)..(y + reach + 1).min(height);
        rows.flat_map(move |y| (x.saturating_sub(reach)..(x + reach + 1).min(width)).map(move |x| y * width + x))
    };
    let pixels = || (0..width * height).into_par_iter().with_min_len(4096);
    let is_inside: Vec<bool> = pixels().map(|i| around(i, RIM_PX).all(|i| rgba[4 * i + 3] >= WHOLE)).collect();
    pixels().map(|i| rgba[4 * i + 3] > 0 && !is_inside[i] && around(i, REACH_PX).any(|i| is_inside[i])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 20;

    #[test]
    fn the_outermost_pixels_are_marked_but_for_thin_parts() {
        // A square, half covered at its outline, and a line of two pixels that nothing is inside of.
        let depth = |at: usize| at.min(13usize.saturating_sub(at)).saturating_sub(2);
        let alpha = |i: usize| match depth(i % SIDE).min(depth(i / SIDE)) {
            _ if [17, 18].contains(&(i % SIDE)) => 255,
            0 => 0,
            1 => 128,
            _ => 255,
        };
        let rgba: Vec<u8> = (0..SIDE * SIDE).flat_map(|i| [7, 8, 9, alpha(i)]).collect();
        for (i, is_mixed) in mixed(&rgba, SIDE).into_iter().enumerate() {
            let expected = [1, 2].contains(&depth(i % SIDE).min(depth(i / SIDE)));
            assert_eq!(is_mixed, expected, "{} {}", i % SIDE, i / SIDE);
        }
    }

    #[test]
    fn nothing_is_known_beyond_the_image_and_odd_sizes_are_no_harm() {
        assert_eq!(mixed(&[9, 9, 9, 255].repeat(SIDE), SIDE), [false; SIDE]);
        assert_eq!(mixed(&[9, 9, 9, 0].repeat(SIDE), SIDE), [false; SIDE]);
        assert!(mixed(&[], 5).is_empty() && mixed(&[1, 2, 3, 4], 0).is_empty() && mixed(&[1, 2, 3, 4], 9).is_empty());
        assert_eq!(mixed(&[1, 2, 3, 4, 5], 1), [false]);
    }
}

//! Parts of images whose error does not change any more are drawn less often.
//!
//! Images are cut into bands of rows. A band whose error stays the same from one drawing to the next rests for some rounds; an image is drawn
//! from its first to its last band that does not rest, and left out where all of them do.

use std::ops::Range;

/// Rows of a band. Images have a multiple of so many, but for those that are smaller.
pub(crate) const BAND_PX: u32 = 64;
/// A band rests after its error changed by less than this part.
const CHANGE: f32 = 0.02;
/// Rounds in which a band rests.
const ROUNDS: f32 = 3.0;

/// How much of the images was drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Drawn {
    /// Images that were drawn.
    pub images: u64,
    /// Images that were left out.
    pub left_out: u64,
    /// Rows that were drawn of these images, and all of their rows.
    pub rows: [u64; 2],
}

/// Bands of all images of a fit.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Rest {
    /// Mean squared error of each band when it was drawn last; negative before.
    pub errors: Vec<f32>,
    /// First round in which each band is drawn again.
    pub until: Vec<f32>,
    /// First band of each image, and of one after the last.
    first: Vec<usize>,
    /// Rows of each image.
    rows: Vec<u32>,
    is_on: bool,
    pub drawn: Drawn,
}

impl Rest {
    /// Of images of so many rows; where it is off, all of them are drawn.
    pub fn new(rows: impl IntoIterator<Item = u32>, is_on: bool) -> Self {
        let rows: Vec<u32> = rows.into_iter().collect();
        let mut first = vec![0];
        for rows in &rows {
            first.push(first[first.len() - 1] + rows.div_ceil(BAND_PX) as usize);
        }
        let bands = first[first.len() - 1];
        Self { errors: vec![-1.0; bands], until: vec![0.0; bands], first, rows, is_on, drawn: Drawn::default() }
    }

    /// Whether `until` can be the state of these bands in a round.
    pub fn is_possible(until: &[f32], round: u64) -> bool {
        until.iter().all(|until| *until <= round as f32 + 1.0 + ROUNDS)
    }

    fn bands(&self, image: usize) -> Range<usize> {
        let at = |image: usize| self.first.get(image).copied().unwrap_or(0);
        at(image)..at(image + 1).max(at(image))
    }

    /// Returns the rows of an image that are drawn in a round; None where all of them rest.
    pub fn rows(&mut self, image: usize, round: u64) -> Option<Range<u32>> {
        let rows = *self.rows.get(image)?;
        let bands = self.bands(image);
        let is_awake = |band: &usize| !self.is_on || self.until[*band] <= round as f32;
        let Some(first) = bands.clone().find(is_awake) else {
            self.drawn.left_out += 1;
            return None;
        };
        let last = bands.clone().rfind(is_awake).unwrap_or(first);
        let at = |band: usize| (band - bands.start) as u32 * BAND_PX;
        let drawn = at(first)..(at(last) + BAND_PX).min(rows);
        self.drawn.images += 1;
        self.drawn.rows[0] += u64::from(drawn.end - drawn.start);
        self.drawn.rows[1] += u64::from(rows);
        Some(drawn)
    }

    /// Takes note of the squared error of the pixels that were drawn, `width` in a row, from a band's first row on.
    pub fn judge(&mut self, image: usize, round: u64, from_row: u32, squares: &[f32], width: usize) {
        if !self.is_on {
            return;
        }
        let first = self.bands(image).start + (from_row / BAND_PX) as usize;
        let end = self.bands(image).end;
        for (band, pixels) in (first..end).zip(squares.chunks((width * BAND_PX as usize).max(1))) {
            let sum: f64 = pixels.iter().map(|square| f64::from(*square)).sum();
            let (now, before) = ((sum / pixels.len().max(1) as f64) as f32, self.errors[band]);
            if (now - before).abs() <= CHANGE * before {
                self.until[band] = round as f32 + 1.0 + ROUNDS;
            }
            self.errors[band] = now;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Squared errors of an image of 8 pixels a row: one for each band.
    fn pixels(bands: &[f32]) -> Vec<f32> {
        bands.iter().flat_map(|error| vec![*error; 8 * BAND_PX as usize]).collect()
    }

    #[test]
    fn a_band_rests_for_three_rounds_once_its_error_stays() {
        let mut rest = Rest::new([3 * BAND_PX, 100], true);
        assert_eq!(rest.rows(0, 0), Some(0..3 * BAND_PX));
        rest.judge(0, 0, 0, &pixels(&[0.5, 0.4, 0.3]), 8);
        assert_eq!(rest.rows(0, 1), Some(0..3 * BAND_PX));
        // The first falls, the second stays, the third rises.
        rest.judge(0, 1, 0, &pixels(&[0.4, 0.396, 0.4]), 8);
        assert_eq!(rest.rows(0, 2), Some(0..3 * BAND_PX), "what lies between two is drawn as well");
        rest.judge(0, 2, 0, &pixels(&[0.4, 0.396, 0.3]), 8);
        assert_eq!(rest.rows(0, 3), Some(2 * BAND_PX..3 * BAND_PX));
        rest.judge(0, 3, 2 * BAND_PX, &pixels(&[0.3]), 8);
        for round in [4, 5] {
            assert_eq!(rest.rows(0, round), None);
        }
        // The first two come back three rounds after the one in which they fell asleep, the last one a round later.
        assert_eq!(rest.rows(0, 6), Some(0..2 * BAND_PX));
        assert_eq!(rest.rows(0, 7), Some(0..3 * BAND_PX));
        // Nothing is known of the other image.
        assert_eq!(rest.rows(1, 7), Some(0..100));
        let drawn =
            Drawn { images: 7, left_out: 2, rows: [u64::from(15 * BAND_PX) + 100, u64::from(18 * BAND_PX) + 100] };
        assert_eq!(rest.drawn, drawn);
        assert!(Rest::is_possible(&rest.until, 3) && !Rest::is_possible(&rest.until, 2));
        assert!(!Rest::is_possible(&[f32::NAN], 9));
    }

    #[test]
    fn nothing_rests_where_it_is_off_and_poison_keeps_a_band_awake() {
        let mut off = Rest::new([128], false);
        for round in 0..5 {
            assert_eq!(off.rows(0, round), Some(0..128));
            off.judge(0, round, 0, &pixels(&[0.5, 0.5]), 8);
        }
        let mut rest = Rest::new([128, 0], true);
        for round in 0..5 {
            assert_eq!(rest.rows(0, round), Some(0..128));
            rest.judge(0, round, 0, &pixels(&[f32::NAN, f32::INFINITY]), 8);
        }
        // No rows, no such image, no pixels.
        assert_eq!((rest.rows(1, 0), rest.rows(2, 0), rest.rows(usize::MAX, 0)), (None, None, None));
        rest.judge(1, 0, 0, &[1.0], 0);
        rest.judge(7, 0, 0, &[1.0], 8);
        rest.judge(0, 9, 640, &[1.0], 8);
        rest.judge(0, 9, 0, &[], 8);
        assert_eq!(rest.rows(0, 9), Some(0..128));
    }
}

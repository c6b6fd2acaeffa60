//! Pixel-aligned features (FlyHuman, Eq. 5): weighted bilinear samples of feature maps, and their derivative for
//! training.

use std::ops::Range;

use rayon::prelude::*;

/// Sample of one view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tap {
    /// Index of the map.
    pub view: u32,
    /// Pixel of the full-size crop; centres at integers.
    pub pixel: [f32; 2],
    /// Weight in the row.
    pub weight: f32,
}

/// Rows of taps, each of which gives one feature vector.
#[derive(Debug, Clone, PartialEq)]
pub struct Taps {
    /// First tap of each row, and the end.
    pub starts: Vec<u32>,
    /// All rows' taps.
    pub taps: Vec<Tap>,
}

impl Default for Taps {
    fn default() -> Self {
        Self { starts: vec![0], taps: Vec::new() }
    }
}

/// Feature maps of all views at one scale: view, row, column, channel.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureMaps {
    /// Columns of one map.
    pub width: usize,
    /// Rows of one map.
    pub height: usize,
    /// Numbers per pixel.
    pub channels: usize,
    /// Full-size pixels between neighbouring pixels; pixel 0 coincides with the full-size pixel 0.
    pub stride: usize,
    /// All maps.
    pub values: Vec<f32>,
}

impl FeatureMaps {
    /// Returns a map of the same shape without numbers.
    pub(crate) fn without_values(&self) -> Self {
        Self { values: Vec::new(), ..*self }
    }

    /// Returns the number of values in one map.
    fn map_len(&self) -> usize {
        self.width * self.height * self.channels
    }

    /// Returns offsets in a map and weights of the four pixels around a position; positions outside are clamped to the
    /// border.
    fn corners(&self, pixel: [f32; 2]) -> [(usize, f32); 4] {
        let axis = |value: f32, size: usize| {
            let last = size.saturating_sub(1);
            let at = (value / self.stride as f32).clamp(0.0, last as f32);
            // A NaN becomes 0.
            let low = (at as usize).min(last);
            let fraction = if at.is_finite() { at - low as f32 } else { 0.0 };
            (low, (low + 1).min(last), fraction)
        };
        let (x0, x1, fx) = axis(pixel[0], self.width);
        let (y0, y1, fy) = axis(pixel[1], self.height);
        let offset = |x: usize, y: usize| (y * self.width + x) * self.channels;
        [
            (offset(x0, y0), (1.0 - fx) * (1.0 - fy)),
            (offset(x1, y0), fx * (1.0 - fy)),
            (offset(x0, y1), (1.0 - fx) * fy),
            (offset(x1, y1), fx * fy),
        ]
    }
}

impl Taps {
    /// Ends the current row.
    pub fn end_row(&mut self) {
        self.starts.push(self.taps.len() as u32);
    }

    /// Concatenates the rows of several lists.
    #[must_use]
    pub(crate) fn joined(parts: Vec<Self>) -> Self {
        let mut out = Self::default();
        out.taps.reserve(parts.iter().map(|part| part.taps.len()).sum());
        for part in parts {
            let first = out.taps.len() as u32;
            out.starts.extend(part.starts.iter().skip(1).map(|start| first + start));
            out.taps.extend(part.taps);
        }
        out
    }

    /// Returns the number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Returns the taps of a row.
    #[must_use]
    pub fn row(&self, row: usize) -> &[Tap] {
        &self.taps[self.starts[row] as usize..self.starts[row + 1] as usize]
    }

    /// Returns whether every tap refers to one of `views` maps.
    #[must_use]
    pub fn fits(&self, views: usize) -> bool {
        self.starts.first() == Some(&0)
            && self.starts.windows(2).all(|pair| pair[0] <= pair[1])
            && self.starts.last().is_some_and(|&end| end as usize == self.taps.len())
            && self.taps.iter().all(|tap| (tap.view as usize) < views)
    }

    /// Selects the tap with the largest weight in every row, the first one of equals, and sets its weight to 1.
    #[must_use]
    pub fn heaviest(&self) -> Self {
        let mut out = Self::default();
        out.starts.reserve(self.rows());
        for row in 0..self.rows() {
            let heavier = |best: Option<Tap>, tap: &Tap| match best {
                Some(best) if best.weight >= tap.weight => Some(best),
                _ => Some(*tap),
            };
            let best = self.row(row).iter().fold(None, heavier);
            out.taps.extend(best.map(|tap| Tap { weight: 1.0, ..tap }));
            out.end_row();
        }
        out
    }

    /// Mirrors the taps for horizontally flipped images of `width` pixels.
    #[must_use]
    pub fn flipped(&self, width: usize) -> Self {
        let last = width.saturating_sub(1) as f32;
        let turn = |tap: &Tap| Tap { pixel: [last - tap.pixel[0], tap.pixel[1]], ..*tap };
        Self { starts: self.starts.clone(), taps: self.taps.iter().map(turn).collect() }
    }

    /// Samples the concatenated features of all scales, row by row. Taps must fit the maps' number of views.
    #[must_use]
    pub fn sample(&self, levels: &[FeatureMaps]) -> Vec<f32> {
        self.sample_rows(levels, 0..self.rows())
    }

    /// Samples some rows, as [`Self::sample`] does.
    #[must_use]
    pub fn sample_rows(&self, levels: &[FeatureMaps], rows: Range<usize>) -> Vec<f32> {
        let channels: usize = levels.iter().map(|level| level.channels).sum();
        let mut out = vec![0.0; rows.len() * channels];
        out.par_chunks_mut(channels.max(1)).zip(rows).for_each(|(out, row)| {
            for tap in self.row(row).iter().filter(|tap| tap.weight != 0.0) {
                let mut first = 0;
                for level in levels {
                    let map = &level.values[tap.view as usize * level.map_len()..];
                    let out = &mut out[first..first + level.channels];
                    for (offset, share) in level.corners(tap.pixel) {
                        let weight = share * tap.weight;
                        for (out, value) in out.iter_mut().zip(&map[offset..offset + level.channels]) {
                            *out += weight * value;
                        }
                    }
                    first += level.channels;
                }
            }
        });
        out
    }

    /// Computes dL/d maps from dL/d rows: the transpose of [`Self::sample`]. Sums run in the order of the rows.
    #[must_use]
    pub fn sample_backward(&self, levels: &[FeatureMaps], row_gradients: &[f32]) -> Vec<Vec<f32>> {
        let channels: usize = levels.iter().map(|level| level.channels).sum();
        let mut first = 0;
        let starts: Vec<usize> = levels
            .iter()
            .map(|level| {
                first += level.channels;
                first - level.channels
            })
            .collect();
        levels
            .iter()
            .zip(starts)
            .map(|(level, start)| {
                let mut gradient = vec![0.0; level.values.len()];
                gradient.par_chunks_mut(level.map_len().max(1)).enumerate().for_each(|(view, gradient)| {
                    for (row, row_gradient) in row_gradients.chunks_exact(channels.max(1)).enumerate() {
                        let row_gradient = &row_gradient[start..start + level.channels];
                        for tap in self.row(row).iter().filter(|tap| tap.view as usize == view && tap.weight != 0.0) {
                            for (offset, share) in level.corners(tap.pixel) {
                                let weight = share * tap.weight;
                                let target = &mut gradient[offset..offset + level.channels];
                                for (target, value) in target.iter_mut().zip(row_gradient) {
                                    *target += weight * value;
                                }
                            }
                        }
                    }
                });
                gradient
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

    use super::*;

    fn random(rng: &mut SmallRng) -> (Taps, Vec<FeatureMaps>) {
        let mut taps = Taps::default();
        for row in 0..40 {
            for _ in 0..row % 4 {
                let pixel = [rng.random_range(-3.0..19.0), rng.random_range(-3.0..15.0)];
                taps.taps.push(Tap { view: rng.random_range(0..2), pixel, weight: rng.random_range(0.0..1.0) });
            }
            taps.end_row();
        }
        let level = |rng: &mut SmallRng, width: usize, height: usize, channels: usize, stride| {
            let values = (0..2 * width * height * channels).map(|_| rng.random_range(-1.0..1.0)).collect();
            FeatureMaps { width, height, channels, stride, values }
        };
        let levels = vec![level(rng, 16, 12, 3, 1), level(rng, 8, 6, 5, 2), level(rng, 4, 3, 2, 4)];
        (taps, levels)
    }

    /// Computes the interpolation in f64.
    fn reference(taps: &Taps, levels: &[FeatureMaps], row: usize) -> Vec<f64> {
        let mut out = Vec::new();
        for level in levels {
            for channel in 0..level.channels {
                let mut sum = 0.0;
                for tap in taps.row(row) {
                    let at = |x: i64, y: i64| {
                        let x = x.clamp(0, level.width as i64 - 1) as usize;
                        let y = y.clamp(0, level.height as i64 - 1) as usize;
                        let index = ((tap.view as usize * level.height + y) * level.width + x) * level.channels;
                        f64::from(level.values[index + channel])
                    };
                    let x = (f64::from(tap.pixel[0]) / level.stride as f64).clamp(0.0, level.width as f64 - 1.0);
                    let y = (f64::from(tap.pixel[1]) / level.stride as f64).clamp(0.0, level.height as f64 - 1.0);
                    let (x0, y0) = (x.floor() as i64, y.floor() as i64);
                    let (fx, fy) = (x - x.floor(), y - y.floor());
                    let top = at(x0, y0) * (1.0 - fx) + at(x0 + 1, y0) * fx;
                    let bottom = at(x0, y0 + 1) * (1.0 - fx) + at(x0 + 1, y0 + 1) * fx;
                    sum += f64::from(tap.weight) * (top * (1.0 - fy) + bottom * fy);
                }
                out.push(sum);
            }
        }
        out
    }

    #[test]
    fn samples_equal_plain_interpolation() {
        let (taps, levels) = random(&mut SmallRng::seed_from_u64(3));
        assert!(taps.fits(2) && !taps.fits(1));
        let rows = taps.sample(&levels);
        for (row, ours) in rows.chunks_exact(10).enumerate() {
            for (a, b) in ours.iter().zip(reference(&taps, &levels, row)) {
                assert!((f64::from(*a) - b).abs() < 2e-6, "row {row}: {a} against {b}");
            }
        }
    }

    #[test]
    fn the_way_back_is_the_transpose() {
        let mut rng = SmallRng::seed_from_u64(4);
        let (taps, levels) = random(&mut rng);
        let rows = taps.sample(&levels);
        let upstream: Vec<f32> = rows.iter().map(|_| rng.random_range(-1.0..1.0)).collect();
        let gradients = taps.sample_backward(&levels, &upstream);
        // <A x, y> = <x, A^T y>, exactly linear.
        let left: f64 = rows.iter().zip(&upstream).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
        let right: f64 = levels
            .iter()
            .zip(&gradients)
            .flat_map(|(level, gradient)| level.values.iter().zip(gradient))
            .map(|(a, b)| f64::from(*a) * f64::from(*b))
            .sum();
        assert!((left - right).abs() < 1e-4 * left.abs().max(1.0), "{left} against {right}");
        // Finite differences of a few single numbers.
        for (level, at) in [(0, 17), (1, 33), (2, 5)] {
            let mut moved = levels.clone();
            moved[level].values[at] += 0.5;
            let change: f64 = taps
                .sample(&moved)
                .iter()
                .zip(&rows)
                .zip(&upstream)
                .map(|((a, b), g)| (f64::from(*a) - f64::from(*b)) * f64::from(*g))
                .sum();
            assert!((change / 0.5 - f64::from(gradients[level][at])).abs() < 1e-4);
        }
    }

    #[test]
    fn places_that_are_no_numbers_do_no_harm() {
        let level = FeatureMaps { width: 2, height: 2, channels: 1, stride: 1, values: vec![1.0, 2.0, 3.0, 4.0] };
        let mut taps = Taps::default();
        for pixel in [[f32::NAN, 0.0], [f32::INFINITY, f32::NEG_INFINITY], [1e30, 1e30]] {
            taps.taps.push(Tap { view: 0, pixel, weight: 1.0 });
            taps.end_row();
        }
        taps.end_row();
        let sampled = taps.sample(&[level]);
        assert!(sampled.iter().zip([1.0, 2.0, 4.0, 0.0f32]).all(|(a, b)| (a - b).abs() < 1e-6), "{sampled:?}");
    }
}

//! Derivatives of a loss with respect to the weights of a convolution.
#![allow(clippy::needless_range_loop)] // adapters of iterators are not inlined into code for vector instructions

use std::ops::Range;

use pulp::{Simd, WithSimd};

use super::planes::Planes;
use super::sums::{BLOCK, TAPS};

/// Derivatives that some rows add.
#[derive(Debug)]
pub(super) struct WeightSlopes<'a> {
    input: &'a Planes,
    /// Derivatives with respect to the output.
    slopes: &'a Planes,
    rows: Range<usize>,
    /// Output, input, tap.
    pub weights: Vec<f32>,
    pub biases: Vec<f32>,
}

impl<'a> WeightSlopes<'a> {
    pub fn new(input: &'a Planes, slopes: &'a Planes, rows: Range<usize>) -> Self {
        let weights = vec![0.0; slopes.channels() * input.channels() * TAPS];
        Self { input, slopes, rows, weights, biases: vec![0.0; slopes.channels()] }
    }

    /// Writes the derivatives of some channels of the output, from `first` on.
    #[inline(always)]
    fn block<S: Simd, const CHANNELS: usize>(&mut self, simd: S, first: usize) {
        let inputs = self.input.channels();
        for input in 0..inputs {
            for row in 0..3 {
                let sums = self.products::<S, CHANNELS>(simd, first, input, row);
                for channel in 0..CHANNELS {
                    let taps = ((first + channel) * inputs + input) * TAPS + 3 * row;
                    for column in 0..3 {
                        self.weights[taps + column] = simd.reduce_sum_f32s(sums[channel][column]);
                    }
                }
            }
        }
        for channel in first..first + CHANNELS {
            let mut sum = simd.splat_f32s(0.0);
            for y in self.rows.clone() {
                let pixels = vectors::<S>(self.slopes, self.slopes.start(y + 1, channel));
                for at in 0..pixels.len() {
                    sum = simd.add_f32s(sum, pixels[at]);
                }
            }
            self.biases[channel] = simd.reduce_sum_f32s(sum);
        }
    }

    /// Returns sums of products for the three taps of a row, lane by lane.
    #[inline(always)]
    fn products<S: Simd, const CHANNELS: usize>(
        &self,
        simd: S,
        first: usize,
        input: usize,
        row: usize,
    ) -> [[S::f32s; 3]; CHANNELS] {
        let mut sums = [[simd.splat_f32s(0.0); 3]; CHANNELS];
        let count = self.input.padded_width() / S::F32_LANES;
        for y in self.rows.clone() {
            // One pixel to the left.
            let from = self.input.start(y + row, input) - 1;
            let mut pixels: [&[S::f32s]; 3] = [&[]; 3];
            for column in 0..3 {
                pixels[column] = &vectors::<S>(self.input, from + column)[..count];
            }
            let mut slopes: [&[S::f32s]; CHANNELS] = [&[]; CHANNELS];
            for channel in 0..CHANNELS {
                slopes[channel] = &vectors::<S>(self.slopes, self.slopes.start(y + 1, first + channel))[..count];
            }
            for at in 0..count {
                for channel in 0..CHANNELS {
                    let slope = slopes[channel][at];
                    for column in 0..3 {
                        sums[channel][column] = simd.mul_add_e_f32s(slope, pixels[column][at], sums[channel][column]);
                    }
                }
            }
        }
        sums
    }
}

/// Returns the vectors of a row. Beyond the last pixel they are zero.
#[inline(always)]
fn vectors<S: Simd>(planes: &Planes, start: usize) -> &[S::f32s] {
    S::as_simd_f32s(&planes.values()[start..start + planes.padded_width()]).0
}

impl WithSimd for &mut WeightSlopes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let channels = self.slopes.channels();
        let whole = channels - channels % BLOCK;
        for first in (0..whole).step_by(BLOCK) {
            self.block::<S, BLOCK>(simd, first);
        }
        for channel in whole..channels {
            self.block::<S, 1>(simd, channel);
        }
    }
}

//! Sums over the taps and channels of a convolution.
#![allow(clippy::needless_range_loop)] // adapters of iterators are not inlined into code for vector instructions

use pulp::{Simd, WithSimd};

use super::planes::Planes;

/// Taps of one pair of channels.
pub(super) const TAPS: usize = 9;
/// Channels whose weights lie side by side.
pub(super) const BLOCK: usize = 4;

/// Last operation on a sum.
#[derive(Debug, Clone, Copy)]
pub(super) enum After<'a> {
    Nothing,
    /// Negative sums become zero.
    Rectify,
    /// Sums become zero where these planes, of the size of the output, are not positive.
    Gate(&'a Planes),
}

/// Some rows of the output.
pub(super) struct Strip<'a> {
    pub input: &'a Planes,
    /// For each [`BLOCK`] of outputs, and for each input, the taps: each a number for every output of the block.
    pub weights: &'a [f32],
    /// One for each output, filled up to whole blocks.
    pub biases: &'a [f32],
    /// Channels of the output.
    pub outputs: usize,
    /// First row.
    pub first: usize,
    /// Rows of all channels with their borders, from the first pixel on.
    pub rows: &'a mut [f32],
    pub after: After<'a>,
}

impl WithSimd for Strip<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // As many sums as leave registers for the pixels and a weight.
        if S::REGISTER_COUNT >= 32 { self.all::<S, 4>(simd) } else { self.all::<S, 2>(simd) }
    }
}

impl Strip<'_> {
    #[inline(always)]
    fn all<S: Simd, const VECTORS: usize>(mut self, simd: S) {
        let width = self.input.padded_width();
        let rows = self.rows.len() / (self.outputs * self.input.stride()).max(1);
        for y in 0..rows {
            for block in 0..self.outputs.div_ceil(BLOCK) {
                let mut x = 0;
                while x + VECTORS * S::F32_LANES <= width {
                    self.pixels::<S, VECTORS>(simd, block, [y, x]);
                    x += VECTORS * S::F32_LANES;
                }
                while x < width {
                    self.pixels::<S, 1>(simd, block, [y, x]);
                    x += S::F32_LANES;
                }
            }
        }
    }

    /// Computes some vectors of pixels from row `y` of the strip and column `x` on.
    #[inline(always)]
    fn pixels<S: Simd, const VECTORS: usize>(&mut self, simd: S, block: usize, [y, x]: [usize; 2]) {
        let sums = self.sums::<S, VECTORS>(simd, block, [y, x]);
        self.store(simd, block, [y, x], &sums);
    }

    /// Returns the sums of some vectors of pixels. A function of its own, with loops that count, so that the compiler keeps the sums in
    /// registers and inlines everything into code for vector instructions.
    #[inline(always)]
    fn sums<S: Simd, const VECTORS: usize>(
        &self,
        simd: S,
        block: usize,
        [y, x]: [usize; 2],
    ) -> [[S::f32s; VECTORS]; BLOCK] {
        let mut sums = [[simd.splat_f32s(0.0); VECTORS]; BLOCK];
        for channel in 0..BLOCK {
            sums[channel] = [simd.splat_f32s(self.biases[block * BLOCK + channel]); VECTORS];
        }
        let (length, inputs) = (VECTORS * S::F32_LANES, self.input.channels());
        let weights = &self.weights.as_chunks::<BLOCK>().0.as_chunks::<TAPS>().0[block * inputs..(block + 1) * inputs];
        for channel in 0..inputs {
            for row in 0..3 {
                // One pixel to the left.
                let start = self.input.start(self.first + y + row, channel) + x - 1;
                let pixels = &self.input.values()[start..start + length + 2];
                for column in 0..3 {
                    let pixels = S::as_simd_f32s(&pixels[column..column + length]).0;
                    let Some(pixels) = pixels.first_chunk::<VECTORS>() else { return sums };
                    for output in 0..BLOCK {
                        let weight = simd.splat_f32s(weights[channel][3 * row + column][output]);
                        for vector in 0..VECTORS {
                            sums[output][vector] = simd.mul_add_e_f32s(weight, pixels[vector], sums[output][vector]);
                        }
                    }
                }
            }
        }
        sums
    }

    #[inline(always)]
    fn store<S: Simd, const VECTORS: usize>(
        &mut self,
        simd: S,
        block: usize,
        [y, x]: [usize; 2],
        sums: &[[S::f32s; VECTORS]; BLOCK],
    ) {
        let (stride, zero) = (self.input.stride(), simd.splat_f32s(0.0));
        let width = self.input.size()[1];
        // Indices that the compiler knows keep the sums in registers.
        for output in 0..BLOCK {
            let channel = block * BLOCK + output;
            if channel >= self.outputs {
                return;
            }
            for vector in 0..VECTORS {
                let (sum, from) = (sums[output][vector], x + vector * S::F32_LANES);
                let value = match self.after {
                    After::Nothing => sum,
                    // Comparisons are false for NaN, which must not become a number.
                    After::Rectify => simd.select_f32s(simd.less_than_f32s(sum, zero), zero, sum),
                    After::Gate(planes) => {
                        let gate = &planes.values()[planes.start(self.first + y + 1, channel) + from..];
                        match S::as_simd_f32s(&gate[..S::F32_LANES]).0 {
                            [gate] => simd.select_f32s(simd.less_than_f32s(zero, *gate), sum, zero),
                            _ => sum,
                        }
                    }
                };
                let range = from.min(width)..(from + S::F32_LANES).min(width);
                let output = &mut self.rows[(y * self.outputs + channel) * stride..][range];
                match S::as_mut_simd_f32s(output).0 {
                    [whole] => *whole = value,
                    _ => simd.partial_store_f32s(output, value),
                }
            }
        }
    }
}

//! Adaptive models of integers.

use crate::range_coder::{BitCoder, Probability};

/// Largest magnitude of a coded value.
pub(crate) const MOST: i32 = 1 << 20;

/// Number of steps of a magnitude with a probability of their own.
const STEPS: usize = 14;

/// Model of values that are not zero: unary steps from 1 for small magnitudes, then an Elias gamma code.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct MagnitudeModel([Probability; STEPS]);

impl MagnitudeModel {
    /// Codes a value of -[`MOST`]..=[`MOST`] that is not zero.
    pub fn code(&mut self, coder: &mut impl BitCoder, value: i32) -> i32 {
        let is_negative = coder.raw(1, u32::from(value < 0)) == 1;
        let magnitude = value.unsigned_abs();
        let mut found = 1;
        for step in &mut self.0 {
            if !coder.bit(step, magnitude > found) {
                return if is_negative { -(found as i32) } else { found as i32 };
            }
            found += 1;
        }
        let found = (found + gamma(coder, magnitude.saturating_sub(found))).min(MOST as u32) as i32;
        if is_negative { -found } else { found }
    }
}

/// Number of steps of a residual's upper part with a probability of their own.
const UPPER_STEPS: usize = 12;
/// Number of expected sizes, two per doubling.
const SIZES: usize = 32;
/// Largest magnitude of a residual.
const MOST_RESIDUAL: i32 = 4 * MOST;

/// Model of differences from a prediction, selected by their expected size: the quotient of magnitude and size takes unary steps from 0,
/// as in a Golomb code with adaptive decisions.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ResidualModel([(MagnitudeSteps, Probability); SIZES]);

type MagnitudeSteps = [Probability; UPPER_STEPS];

impl ResidualModel {
    /// Codes a value of magnitude at most [`MOST_RESIDUAL`]; `expected` is four times the expected magnitude.
    pub fn code(&mut self, coder: &mut impl BitCoder, value: i32, expected: u32) -> i32 {
        let expected = expected.max(1);
        let doublings = expected.ilog2();
        let size = 2 * doublings + (expected << 1 >> doublings & 1);
        let (steps, highest_below) = &mut self.0[(size as usize).min(SIZES - 1)];
        let below = doublings.saturating_sub(2).min(24);
        let magnitude = value.unsigned_abs();
        let upper = magnitude >> below;
        let mut found = 0;
        for step in steps.iter_mut() {
            if !coder.bit(step, upper > found) {
                break;
            }
            found += 1;
        }
        if found == UPPER_STEPS as u32 {
            found += gamma(coder, upper.saturating_sub(found));
        }
        if below > 0 {
            found = found << 1 | u32::from(coder.bit(highest_below, magnitude >> (below - 1) & 1 == 1));
            let lower = coder.raw(below - 1, magnitude & ((1 << (below - 1)) - 1));
            found = (u64::from(found) << (below - 1)).min(MOST_RESIDUAL as u64) as u32 | lower;
        }
        let found = found.min(MOST_RESIDUAL as u32) as i32;
        if found != 0 && coder.raw(1, u32::from(value < 0)) == 1 { -found } else { found }
    }
}

/// Codes `value + 1` as Elias gamma, for values below 2^23.
fn gamma(coder: &mut impl BitCoder, value: u32) -> u32 {
    let bits = (value + 1).ilog2();
    let mut found = 0;
    while found < 23 && coder.raw(1, u32::from(bits > found)) == 1 {
        found += 1;
    }
    let below = coder.raw(found, (value + 1) & ((1 << bits) - 1));
    (1 << found | below) - 1
}

/// Model of numbers below 2^24: their length as a tree of adaptive decisions, then two bits with a model and the rest without.
#[derive(Debug, Clone, Default)]
pub(crate) struct NumberModel {
    length: [Probability; 32],
    upper: [[Probability; 4]; 32],
}

impl NumberModel {
    /// Codes a number below 2^24.
    pub fn code(&mut self, coder: &mut impl BitCoder, number: u32) -> u32 {
        let length = 32 - number.leading_zeros();
        let mut node = 1;
        for at in (0..5).rev() {
            node = 2 * node + usize::from(coder.bit(&mut self.length[node & 31], length >> at & 1 == 1));
        }
        let length = (node & 31).min(24) as u32;
        if length < 2 {
            return length;
        }
        // After the leading 1: two bits with a model, then the rest.
        let mut found = 1;
        let modelled = (length - 1).min(2);
        let mut node = 1;
        for at in 0..modelled {
            let bit = number >> (length - 2 - at) & 1 == 1;
            let bit = coder.bit(&mut self.upper[length as usize][node & 3], bit);
            node = 2 * node + usize::from(bit);
            found = found << 1 | u32::from(bit);
        }
        let rest = length - 1 - modelled;
        found << rest | coder.raw(rest, number & ((1 << rest) - 1))
    }

    /// Codes a signed number of magnitude below 2^23.
    pub fn code_signed(&mut self, coder: &mut impl BitCoder, number: i32) -> i32 {
        let folded = ((number << 1) ^ (number >> 31)) as u32;
        let folded = self.code(coder, folded);
        (folded >> 1) as i32 ^ -((folded & 1) as i32)
    }
}

#[cfg(test)]
mod tests {
    use alloc::vec::Vec;

    use super::*;
    use crate::range_coder::{RangeDecoder, RangeEncoder};

    #[test]
    fn values_of_every_size_come_back() {
        let values: Vec<i32> =
            (0..21).flat_map(|bits| [1 << bits, (1 << bits) - 1, -(1 << bits), 1 - (1 << bits)]).collect();
        let mut encoder = RangeEncoder::new(Vec::new());
        let (mut magnitudes, mut numbers) = (MagnitudeModel::default(), NumberModel::default());
        let mut residuals = ResidualModel::default();
        let expected = [0, 1, 3, 4, 7, 900, 1 << 23, u32::MAX];
        for value in &values {
            for expected in expected {
                residuals.code(&mut encoder, *value, expected);
            }
            if *value != 0 {
                magnitudes.code(&mut encoder, *value);
            }
            numbers.code_signed(&mut encoder, *value);
            numbers.code(&mut encoder, value.unsigned_abs());
        }
        let bytes = encoder.finish();
        let mut decoder = RangeDecoder::new(&bytes);
        let (mut magnitudes, mut numbers) = (MagnitudeModel::default(), NumberModel::default());
        let mut residuals = ResidualModel::default();
        for value in &values {
            for expected in expected {
                assert_eq!(residuals.code(&mut decoder, 0, expected), *value, "{expected}");
            }
            if *value != 0 {
                assert_eq!(magnitudes.code(&mut decoder, 1), *value);
            }
            assert_eq!(numbers.code_signed(&mut decoder, 0), *value);
            assert_eq!(numbers.code(&mut decoder, 0), value.unsigned_abs());
        }
    }
}

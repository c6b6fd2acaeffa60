//! Convolutions of 3x3 taps with their derivatives, on the processor.
//!
//! Sums stay in vector registers while all taps of all channels are added; a strip of rows is one task. The order of
//! additions depends on the sizes and the vector instructions alone, so that results are equal for any number of threads. `burn` computes the
//! derivative of the weights as a convolution with kernels as large as the image, which takes longer (`cargo bench -p
//! flyrig-learn`).

mod planes;
mod slopes;
mod sums;

use rayon::prelude::*;

pub use planes::Planes;
use slopes::WeightSlopes;
use sums::{After, BLOCK, Strip, TAPS};

/// Rows of a task. More would leave the first-level cache, fewer would sum up more often.
const ROWS: usize = 8;

/// Convolution with 3x3 taps, one pixel apart, whose output has the size of its input.
#[derive(Debug, Clone)]
pub struct Convolution {
    inputs: usize,
    outputs: usize,
    /// For each [`BLOCK`] of outputs, and for each input: taps of these outputs side by side. Zero beyond the last output.
    weights: Vec<f32>,
    /// Weights from outputs to inputs in the same order, turned by half a turn, for the derivative of the input.
    turned: Vec<f32>,
    /// One for each output, zero beyond the last.
    biases: Vec<f32>,
}

/// Derivatives of a loss with respect to what a convolution takes.
#[derive(Debug, Clone, PartialEq)]
pub struct ConvolutionSlopes {
    /// With respect to the weights, in their order.
    pub weights: Vec<f32>,
    /// With respect to the biases.
    pub biases: Vec<f32>,
    /// With respect to the input.
    pub input: Planes,
}

impl Convolution {
    /// Creates a convolution from weights (output, input, row, column) and one bias for each output. Missing weights are zero.
    #[must_use]
    pub fn new(inputs: usize, weights: &[f32], biases: &[f32]) -> Self {
        let outputs = biases.len();
        let at = |output: usize, input: usize, tap: usize| {
            weights.get((output * inputs + input) * TAPS + tap).copied().unwrap_or(0.0)
        };
        let mut padded = biases.to_vec();
        padded.resize(outputs.next_multiple_of(BLOCK), 0.0);
        Self {
            inputs,
            outputs,
            weights: blocks([outputs, inputs], at),
            turned: blocks([inputs, outputs], |input, output, tap| at(output, input, TAPS - 1 - tap)),
            biases: padded,
        }
    }

    /// Computes the output; with `rectified`, negative numbers become zero.
    ///
    /// ```
    /// use flyrig_learn::{Convolution, Planes};
    ///
    /// let mut weights = [0.0; 9];
    /// weights[5] = 2.0; // the pixel to the right
    /// let moved = Convolution::new(1, &weights, &[-1.0]).forward(&Planes::new(1, 1, 3, &[5.0, 6.0, 7.0]), true);
    /// assert_eq!(moved.to_vec(), [11.0, 13.0, 0.0]);
    /// ```
    #[must_use]
    pub fn forward(&self, input: &Planes, rectified: bool) -> Planes {
        debug_assert_eq!(input.channels(), self.inputs);
        let after = if rectified { After::Rectify } else { After::Nothing };
        convolve(input, [&self.weights, &self.biases], self.outputs, after)
    }

    /// Computes derivatives from those with respect to the output, before it was rectified. With `rectified`, the input is the
    /// rectified output of another convolution, and the derivative is that of what it was before.
    #[must_use]
    pub fn backward(&self, input: &Planes, slopes: &Planes, rectified: bool) -> ConvolutionSlopes {
        debug_assert!(input.channels() == self.inputs && slopes.channels() == self.outputs);
        debug_assert_eq!(input.size(), slopes.size());
        let after = if rectified { After::Gate(input) } else { After::Nothing };
        let none = vec![0.0; self.inputs.next_multiple_of(BLOCK)];
        let starts: Vec<usize> = (0..input.size()[0]).step_by(ROWS).collect();
        let strips = starts.par_iter().map(|first| {
            let mut found = WeightSlopes::new(input, slopes, *first..(first + ROWS).min(input.size()[0]));
            flyrig_types::vectorized(&mut found);
            found
        });
        let mut weights = vec![0.0; self.outputs * self.inputs * TAPS];
        let mut biases = vec![0.0; self.outputs];
        for strip in strips.collect::<Vec<_>>() {
            weights.iter_mut().zip(strip.weights).for_each(|(sum, more)| *sum += more);
            biases.iter_mut().zip(strip.biases).for_each(|(sum, more)| *sum += more);
        }
        ConvolutionSlopes { weights, biases, input: convolve(slopes, [&self.turned, &none], self.inputs, after) }
    }
}

/// Returns weights in blocks of outputs; see [`Convolution::weights`].
fn blocks([outputs, inputs]: [usize; 2], at: impl Fn(usize, usize, usize) -> f32) -> Vec<f32> {
    let mut blocks = vec![0.0; outputs.next_multiple_of(BLOCK) * inputs * TAPS];
    for output in 0..outputs {
        for input in 0..inputs {
            for tap in 0..TAPS {
                let row = (output / BLOCK * inputs + input) * TAPS + tap;
                blocks[row * BLOCK + output % BLOCK] = at(output, input, tap);
            }
        }
    }
    blocks
}

/// Convolves planes with weights in blocks.
fn convolve(input: &Planes, [weights, biases]: [&[f32]; 2], outputs: usize, after: After<'_>) -> Planes {
    let [height, width] = input.size();
    let mut output = Planes::zeros(outputs, height, width);
    let strips: Vec<_> = output.strips_mut(ROWS).collect();
    strips.into_par_iter().enumerate().for_each(|(strip, rows)| {
        flyrig_types::vectorized(Strip { input, weights, biases, outputs, first: strip * ROWS, rows, after });
    });
    output
}

#[cfg(test)]
mod tests;

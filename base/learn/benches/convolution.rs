//! Times convolutions of 3x3 taps and their derivatives beside those of burn, and prints the largest difference.
//!
//! ```text
//! cargo bench -p flyrig-learn --bench convolution -- [RUNS]
//! ```

use std::time::Instant;

use flyrig_learn::{
    Convolution, Planes,
    burn_tensor::{Device, Tensor, TensorData, module, ops::ConvOptions},
    to_vec,
};

/// Channels of input and output, side of the image in pixels.
const SIZES: [[usize; 3]; 6] = [[8, 16, 256], [16, 16, 256], [16, 3, 256], [32, 32, 128], [64, 64, 64], [64, 64, 256]];

struct Layer {
    weights: Vec<f32>,
    biases: Vec<f32>,
    input: Vec<f32>,
    slopes: Vec<f32>,
}

fn main() {
    // Cargo adds "--bench".
    let runs = std::env::args().skip(1).find_map(|argument| argument.parse().ok()).unwrap_or(5);
    println!("median of {runs}; GFLOP/s of output, and of all derivatives (twice the operations)");
    println!("| channels, side | ms | GFLOP/s | ms, burn | derivatives ms | GFLOP/s | ms, burn | largest difference |");
    println!("|---|---|---|---|---|---|---|---|");
    for [inputs, outputs, side] in SIZES {
        let numbers = |count: usize, phase: f32| (0..count).map(|i| (i as f32 * phase).sin()).collect::<Vec<_>>();
        let layer = Layer {
            weights: numbers(outputs * inputs * 9, 0.71),
            biases: numbers(outputs, 0.5),
            input: numbers(inputs * side * side, 0.37),
            slopes: numbers(outputs * side * side, 0.23),
        };
        let (own, burn) = (own(&layer, [inputs, outputs, side], runs), burn(&layer, [inputs, outputs, side], runs));
        let differences = own.1.iter().zip(&burn.1).map(|(a, b)| {
            let largest = b.iter().fold(1e-9f32, |most, value| most.max(value.abs()));
            a.iter().zip(b).fold(0.0f32, |most, (a, b)| most.max((a - b).abs())) / largest
        });
        let difference = differences.fold(0.0, f32::max);
        let giga = 18e-9 * (inputs * outputs * side * side) as f64;
        let ([forward, backward], [burn_forward, burn_backward]) = (own.0, burn.0);
        println!(
            "| {inputs} to {outputs}, {side} | {:.2} | {:.0} | {:.2} | {:.2} | {:.0} | {:.2} | {difference:.1e} |",
            forward * 1e3,
            giga / forward,
            burn_forward * 1e3,
            backward * 1e3,
            2.0 * giga / backward,
            burn_backward * 1e3,
        );
    }
}

/// Returns seconds of output and derivatives, and output and derivatives of weights, biases and input.
fn own(layer: &Layer, [inputs, outputs, side]: [usize; 3], runs: usize) -> ([f64; 2], [Vec<f32>; 4]) {
    let convolution = Convolution::new(inputs, &layer.weights, &layer.biases);
    let input = Planes::new(inputs, side, side, &layer.input);
    let slopes = Planes::new(outputs, side, side, &layer.slopes);
    let (forward, output) = median(runs, || convolution.forward(&input, false));
    let (backward, found) = median(runs, || convolution.backward(&input, &slopes, false));
    ([forward, backward], [output.to_vec(), found.weights, found.biases, found.input.to_vec()])
}

/// Returns what [`own`] does, by burn. Its derivatives are timed with the sum of products whose derivative is `slopes`.
fn burn(layer: &Layer, [inputs, outputs, side]: [usize; 3], runs: usize) -> ([f64; 2], [Vec<f32>; 4]) {
    let device = Device::flex().autodiff();
    let tensor = |values: &[f32], shape: [usize; 4]| {
        Tensor::<4>::from_data(TensorData::new(values.to_vec(), shape), &device).require_grad()
    };
    let weights = tensor(&layer.weights, [outputs, inputs, 3, 3]);
    let input = tensor(&layer.input, [1, inputs, side, side]);
    let biases = Tensor::<1>::from_data(TensorData::new(layer.biases.clone(), [outputs]), &device).require_grad();
    let slopes = tensor(&layer.slopes, [1, outputs, side, side]);
    let options = || ConvOptions::new([1; 2], [1; 2], [1; 2], 1);
    let apply = || module::conv2d(input.clone(), weights.clone(), Some(biases.clone()), options());
    let (forward, output) = median(runs, &apply);
    let (both, found) = median(runs, || (apply() * slopes.clone()).sum().backward());
    let gradient = |of: Option<Vec<f32>>| of.unwrap_or_default();
    (
        [forward, both - forward],
        [
            to_vec(output),
            gradient(weights.grad(&found).map(to_vec)),
            gradient(biases.grad(&found).map(to_vec)),
            gradient(input.grad(&found).map(to_vec)),
        ],
    )
}

/// Returns the median time in seconds and the last result.
fn median<T>(runs: usize, mut work: impl FnMut() -> T) -> (f64, T) {
    let mut times = Vec::new();
    let mut last = work();
    for _ in 0..runs {
        let start = Instant::now();
        last = work();
        times.push(start.elapsed().as_secs_f64());
    }
    times.sort_by(f64::total_cmp);
    (times.get(times.len() / 2).copied().unwrap_or_default(), last)
}

use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

use super::*;

/// Channels of input and output, height, width.
const SIZES: [[usize; 4]; 7] =
    [[1, 1, 1, 1], [2, 3, 5, 7], [3, 4, 9, 16], [5, 9, 17, 33], [4, 6, 8, 70], [1, 5, 20, 15], [8, 8, 16, 64]];

struct Layer {
    weights: Vec<f32>,
    biases: Vec<f32>,
    input: Planes,
}

fn layer([inputs, outputs, height, width]: [usize; 4], random: &mut SmallRng) -> Layer {
    let mut numbers = |count: usize| (0..count).map(|_| random.random_range(-1.0f32..1.0)).collect::<Vec<_>>();
    Layer {
        weights: numbers(outputs * inputs * TAPS),
        biases: numbers(outputs),
        input: Planes::new(inputs, height, width, &numbers(inputs * height * width)),
    }
}

/// Calls `with` for each product of the definition: weight, pixel of the input, pixel of the output.
fn products([inputs, outputs, height, width]: [usize; 4], mut with: impl FnMut(usize, usize, usize)) {
    for output in 0..outputs {
        for input in 0..inputs {
            for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
                for tap in 0..TAPS {
                    let (row, column) = (y + tap / 3, x + tap % 3);
                    if (1..=height).contains(&row) && (1..=width).contains(&column) {
                        let from = (input * height + row - 1) * width + column - 1;
                        with((output * inputs + input) * TAPS + tap, from, (output * height + y) * width + x);
                    }
                }
            }
        }
    }
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|value| f64::from(*value)).collect()
}

/// The output by its definition, in f64.
fn output(size: [usize; 4], weights: &[f64], biases: &[f64], input: &[f64]) -> Vec<f64> {
    let [_, outputs, height, width] = size;
    let mut sums: Vec<f64> = (0..outputs * height * width).map(|i| biases[i / (height * width)]).collect();
    products(size, |weight, from, to| sums[to] += weights[weight] * input[from]);
    sums
}

fn assert_close(found: &[f32], expected: &[f64], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let largest = expected.iter().fold(1.0f64, |most, value| most.max(value.abs()));
    for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert!((f64::from(*found) - expected).abs() < 3e-6 * largest, "{what} {i}: {found} {expected}");
    }
}

#[test]
fn outputs_and_derivatives_are_those_of_the_definition() {
    let mut random = SmallRng::seed_from_u64(1);
    for size in SIZES {
        let [_, outputs, height, width] = size;
        let Layer { weights, biases, input } = layer(size, &mut random);
        let convolution = Convolution::new(size[0], &weights, &biases);
        let [wide_weights, wide_biases, wide_input] = [&weights, &biases, &input.to_vec()].map(|list| wide(list));
        let mut expected = output(size, &wide_weights, &wide_biases, &wide_input);
        assert_close(&convolution.forward(&input, false).to_vec(), &expected, "output");
        expected.iter_mut().for_each(|value| *value = value.max(0.0));
        assert_close(&convolution.forward(&input, true).to_vec(), &expected, "rectified");

        let slopes: Vec<f32> = (0..outputs * height * width).map(|_| random.random_range(-1.0f32..1.0)).collect();
        let mut by_weight = vec![0.0; weights.len()];
        let mut by_input = vec![0.0; wide_input.len()];
        products(size, |weight, from, to| {
            by_weight[weight] += f64::from(slopes[to]) * wide_input[from];
            by_input[from] += f64::from(slopes[to]) * wide_weights[weight];
        });
        let by_bias: Vec<f64> = slopes.chunks(height * width).map(|plane| wide(plane).iter().sum()).collect();
        let slopes = Planes::new(outputs, height, width, &slopes);
        let found = convolution.backward(&input, &slopes, false);
        assert_close(&found.weights, &by_weight, "weights");
        assert_close(&found.biases, &by_bias, "biases");
        assert_close(&found.input.to_vec(), &by_input, "input");
        by_input.iter_mut().zip(&wide_input).filter(|(_, input)| **input <= 0.0).for_each(|(slope, _)| *slope = 0.0);
        assert_close(&convolution.backward(&input, &slopes, true).input.to_vec(), &by_input, "gated input");
    }
}

#[test]
fn other_vector_instructions_give_the_same_results() {
    for limit in ["avx2", "none"] {
        let mut program = std::process::Command::new(std::env::current_exe().unwrap());
        let test = "convolution::tests::outputs_and_derivatives_are_those_of_the_definition";
        let run = program.args([test, "--exact"]).env("FLYRIG_VECTORS", limit).output().unwrap();
        let printed = String::from_utf8_lossy(&run.stdout);
        assert!(run.status.success() && printed.contains("1 passed"), "{limit}: {printed}");
    }
}

#[test]
fn derivatives_of_two_layers_are_finite_differences() {
    let mut random = SmallRng::seed_from_u64(2);
    let [inner, outer] = [[2, 6, 6, 19], [6, 3, 6, 19]];
    let (first, second) = (layer(inner, &mut random), layer(outer, &mut random));
    let layers = [(2, &first), (6, &second)].map(|(inputs, l)| Convolution::new(inputs, &l.weights, &l.biases));
    let between = layers[0].forward(&first.input, true);
    let last = layers[1].forward(&between, false);
    // Half the sum of squares, whose derivative is the output.
    let outer_slopes = layers[1].backward(&between, &last, true);
    let inner_slopes = layers[0].backward(&first.input, &outer_slopes.input, false);
    let loss = |numbers: &[Vec<f64>; 3]| -> f64 {
        let hidden: Vec<f64> = output(inner, &numbers[0], &wide(&first.biases), &numbers[1]);
        let hidden: Vec<f64> = hidden.into_iter().map(|value| value.max(0.0)).collect();
        let out = output(outer, &numbers[2], &wide(&second.biases), &hidden);
        out.iter().map(|value| 0.5 * value * value).sum()
    };
    let mut numbers = [wide(&first.weights), wide(&first.input.to_vec()), wide(&second.weights)];
    let found = [inner_slopes.weights, inner_slopes.input.to_vec(), outer_slopes.weights];
    for (list, slopes) in found.iter().enumerate() {
        for i in (0..slopes.len()).step_by(slopes.len() / 7) {
            let (before, step) = (numbers[list][i], 1e-6);
            let mut at = |value: f64| {
                numbers[list][i] = value;
                loss(&numbers)
            };
            let expected = (at(before + step) - at(before - step)) / (2.0 * step);
            at(before);
            assert!((expected - f64::from(slopes[i])).abs() < 1e-4 * (1.0 + expected.abs()), "{list} {i}: {expected}");
        }
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let size = [8, 6, 40, 37];
    let Layer { weights, biases, input } = layer(size, &mut SmallRng::seed_from_u64(3));
    let convolution = Convolution::new(8, &weights, &biases);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let output = convolution.forward(&input, true);
            (convolution.backward(&input, &output, false), output)
        })
    };
    assert!(with(1) == with(3));
}

#[test]
fn poison_stays_where_it_is_and_is_not_hidden() {
    let mut random = SmallRng::seed_from_u64(4);
    let Layer { weights, biases, input } = layer([2, 5, 9, 20], &mut random);
    let convolution = Convolution::new(2, &weights, &biases);
    for poison in [f32::NAN, f32::INFINITY] {
        let mut values = input.to_vec();
        values[9 * 20 + 4 * 20 + 7] = poison; // second channel, row 4, column 7
        let poisoned = Planes::new(2, 9, 20, &values);
        let spoiled = |planes: &Planes| {
            let is_bad = |i: &usize| !planes.to_vec()[*i].is_finite();
            (0..planes.channels() * 180).filter(is_bad).map(|i| [i % 180 / 20, i % 20]).collect::<Vec<_>>()
        };
        let found = spoiled(&convolution.forward(&poisoned, false));
        assert!(found.len() == 5 * 9 && found.iter().all(|[y, x]| (3..=5).contains(y) && (6..=8).contains(x)));
        assert!(poison.is_infinite() || spoiled(&convolution.forward(&poisoned, true)).len() == 5 * 9);
        // A derivative's border stays zero: what lies beside it is not spoiled either.
        let slopes = convolution.backward(&poisoned, &convolution.forward(&input, false), false);
        assert!(slopes.input.to_vec().iter().all(|slope| slope.is_finite()) && slopes.weights[0].is_finite());
        assert!(slopes.weights.iter().any(|slope| !slope.is_finite()));
    }
}

#[test]
fn nothing_gives_nothing() {
    for size in [[0, 3], [3, 0], [0, 0]] {
        let empty = Planes::zeros(2, size[0], size[1]);
        let found = Convolution::new(2, &[], &[1.0; 3]).backward(&empty, &Planes::zeros(3, size[0], size[1]), true);
        assert!(found.weights == [0.0; 54] && found.input == empty && empty.to_vec().is_empty());
    }
    // No channel, no weights, a list that is too short.
    assert!(Convolution::new(0, &[], &[]).forward(&Planes::zeros(0, 4, 4), true).to_vec().is_empty());
    assert_eq!(Convolution::new(0, &[], &[2.0]).forward(&Planes::zeros(0, 1, 2), true).to_vec(), [2.0, 2.0]);
    assert_eq!(Planes::new(1, 2, 2, &[1.0, 2.0, 3.0]).to_vec(), [1.0, 2.0, 3.0, 0.0]);
    assert!(Planes::new(1, 2, 0, &[1.0, 2.0]) == Planes::zeros(1, 2, 0));
}

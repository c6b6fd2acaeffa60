//! The networks against plain loops in f64.

use flyrig_learn::burn_tensor::Device;
use flyrig_model::srgb;
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

use super::*;
use crate::Parameters;

const SIZE: NetworkSize = NetworkSize { channels: [3, 4, 5], node: 6, heads: 2, layers: 2, hidden: [7, 5] };

/// Random in every parameter, the zero ones too.
fn parameters() -> Parameters {
    let mut parameters = Parameters::untrained(SIZE, 5);
    let mut rng = SmallRng::seed_from_u64(6);
    for parameter in parameters.by_name.values_mut() {
        for value in &mut parameter.values {
            *value += rng.random_range(-0.2..0.2);
        }
    }
    parameters
}

fn network(parameters: &Parameters) -> Network {
    let device = Device::flex();
    Network { tensors: parameters.tensors(&device, false), device, size: parameters.size }
}

fn random(rng: &mut SmallRng, count: usize) -> Vec<f32> {
    (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
}

fn values(parameters: &Parameters, name: &str) -> Vec<f64> {
    parameters.by_name[name].values.iter().map(|v| f64::from(*v)).collect()
}

fn linear(parameters: &Parameters, name: &str, x: &[f64]) -> Vec<f64> {
    let (weight, bias) = (values(parameters, &format!("{name}.weight")), values(parameters, &format!("{name}.bias")));
    let out = bias.len();
    (0..out).map(|j| bias[j] + x.iter().enumerate().map(|(i, x)| x * weight[i * out + j]).sum::<f64>()).collect()
}

fn relu(x: &[f64]) -> Vec<f64> {
    x.iter().map(|v| v.max(0.0)).collect()
}

fn close(ours: &[f32], expected: &[f64], tolerance: f64) {
    assert_eq!(ours.len(), expected.len());
    for (i, (a, b)) in ours.iter().zip(expected).enumerate() {
        assert!((f64::from(*a) - b).abs() < tolerance * b.abs().max(1.0), "number {i}: {a} against {b}");
    }
}

/// 3x3 convolution with a border of zeros, then the positive part; channels first.
fn conv(p: &Parameters, name: &str, x: &[f64], [height, width]: [usize; 2], stride: usize) -> (Vec<f64>, [usize; 2]) {
    let (weight, bias) = (values(p, &format!("encoder.{name}.weight")), values(p, &format!("encoder.{name}.bias")));
    let inputs = x.len() / (height * width);
    let [out_height, out_width] = [height.div_ceil(stride), width.div_ceil(stride)];
    let mut out = Vec::new();
    for (o, bias) in bias.iter().enumerate() {
        for y in 0..out_height {
            for column in 0..out_width {
                let mut sum = *bias;
                for i in 0..inputs {
                    for ky in 0..3 {
                        for kx in 0..3 {
                            let (sy, sx) = ((y * stride + ky).wrapping_sub(1), (column * stride + kx).wrapping_sub(1));
                            if sy < height && sx < width {
                                sum += weight[((o * inputs + i) * 3 + ky) * 3 + kx] * x[(i * height + sy) * width + sx];
                            }
                        }
                    }
                }
                out.push(sum.max(0.0));
            }
        }
    }
    (out, [out_height, out_width])
}

#[test]
fn the_encoder_is_four_convolutions() {
    let p = parameters();
    let mut rng = SmallRng::seed_from_u64(7);
    let (height, width) = (8, 12);
    let planes = random(&mut rng, 2 * 4 * height * width);
    let net = network(&p);
    let maps = feature_maps(&net.encode(net.pictures(planes.clone(), 2, height, width)));
    for view in 0..2 {
        let x: Vec<f64> =
            planes[view * 4 * height * width..][..4 * height * width].iter().map(|v| f64::from(*v)).collect();
        let (full, size) = conv(&p, "full", &x, [height, width], 1);
        let (half, half_size) = conv(&p, "half", &full, size, 2);
        let (quarter, quarter_size) = conv(&p, "quarter", &half, half_size, 2);
        let (quarter, _) = conv(&p, "mix", &quarter, quarter_size, 1);
        for (map, (expected, [height, width])) in
            maps.iter().zip([(full, size), (half, half_size), (quarter, quarter_size)])
        {
            assert_eq!([map.height, map.width], [height, width]);
            let first = view * height * width * map.channels;
            let last: Vec<f64> = (0..height * width * map.channels)
                .map(|i| expected[(i % map.channels) * height * width + i / map.channels])
                .collect();
            close(&map.values[first..first + last.len()], &last, 1e-5);
        }
    }
}

#[test]
fn graph_layers_follow_the_paper() {
    let p = parameters();
    let mut rng = SmallRng::seed_from_u64(8);
    let nodes = 9;
    let (feature, inputs, place) =
        (random(&mut rng, nodes * 12), random(&mut rng, nodes * NODE), random(&mut rng, nodes * PLACE));
    let edges: Vec<u32> = (0..nodes * EDGES).map(|_| rng.random_range(0..nodes as u32)).collect();
    let net = network(&p);
    let ours = to_vec(net.graph(
        net.table(feature.clone(), 12),
        net.table(inputs.clone(), NODE),
        net.table(place.clone(), PLACE),
        &net.indices(edges.iter().copied()),
    ));

    let mut x: Vec<Vec<f64>> = (0..nodes)
        .map(|n| {
            let row =
                feature[n * 12..][..12].iter().chain(&inputs[n * NODE..][..NODE]).chain(&place[n * PLACE..][..PLACE]);
            relu(&linear(&p, "graph.in", &row.map(|v| f64::from(*v)).collect::<Vec<_>>()))
        })
        .collect();
    for layer in 0..2 {
        let at = |what: &str| format!("graph.{layer}.{what}");
        let (edge_key, edge_value) = (values(&p, &at("edge_key")), values(&p, &at("edge_value")));
        let (scale, shift) = (values(&p, &at("scale")), values(&p, &at("shift")));
        let next = (0..nodes).map(|n| {
            let query = linear(&p, &at("query"), &x[n]);
            let mut message = linear(&p, &at("skip"), &x[n]);
            for head in 0..2 {
                let channel = |c: usize| head * 3 + c;
                let neighbour = |e: usize| &x[edges[n * EDGES + e] as usize];
                let scores: Vec<f64> = (0..EDGES)
                    .map(|e| {
                        let key = linear(&p, &at("key"), neighbour(e));
                        let dot = |c: usize| query[channel(c)] * (key[channel(c)] + edge_key[e * 6 + channel(c)]);
                        (0..3).map(dot).sum::<f64>() / 3f64.sqrt()
                    })
                    .collect();
                let total: f64 = scores.iter().map(|s| s.exp()).sum();
                for (e, score) in scores.iter().enumerate() {
                    let value = linear(&p, &at("value"), neighbour(e));
                    for c in 0..3 {
                        message[channel(c)] +=
                            score.exp() / total * (value[channel(c)] + edge_value[e * 6 + channel(c)]);
                    }
                }
            }
            let mean = message.iter().sum::<f64>() / 6.0;
            let variance = message.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 6.0;
            let normal = |c: usize| (message[c] - mean) / (variance + 1e-5).sqrt() * scale[c] + shift[c];
            relu(&(0..6).map(normal).collect::<Vec<_>>())
        });
        x = next.collect();
    }
    close(&ours, &x.concat(), 1e-4);
}

fn encode(linear: f64) -> f64 {
    srgb::encode(linear.clamp(0.0, 1.0), f64::powf)
}

#[test]
fn tensor_form_of_srgb_agrees_with_the_curve() {
    let values: Vec<f32> = (-200..=2200).map(|i| i as f32 / 2000.0).collect();
    let net = network(&parameters());
    let tensor = || net.table(values.clone(), 1);
    let expected: Vec<f64> = values.iter().map(|v| encode(f64::from(*v))).collect();
    close(&to_vec(srgb_from_linear(tensor())), &expected, 2e-6);
    let expected: Vec<f64> = values.iter().map(|v| srgb::decode(f64::from(*v).clamp(0.0, 1.0), f64::powf)).collect();
    close(&to_vec(linear_from_srgb(tensor())), &expected, 2e-6);
}

#[test]
fn filling_and_colour_follow_the_equations() {
    let p = parameters();
    let mut rng = SmallRng::seed_from_u64(9);
    let count = 6;
    let net = network(&p);
    let (visible, graph) = (random(&mut rng, count * 12), random(&mut rng, count * 6));
    let weights: Vec<f32> = (0..count).map(|i| i as f32 / 5.0).collect();
    let filled =
        to_vec(net.fill(net.table(visible.clone(), 12), net.table(weights.clone(), 1), net.table(graph.clone(), 6)));
    let state = random(&mut rng, count * STATE);
    let rows: Vec<f32> =
        (0..count).flat_map(|i| [&state[i * STATE..][..STATE], &filled[i * 12..][..12]].concat()).collect();
    let colors = to_vec(net.color(net.table(rows, SIZE.row())));
    for i in 0..count {
        let wide = |v: &[f32]| -> Vec<f64> { v.iter().map(|v| f64::from(*v)).collect() };
        let own = wide(&visible[i * 12..][..12]);
        let generated = linear(&p, "fill", &[wide(&graph[i * 6..][..6]), own.clone()].concat());
        let weight = f64::from(weights[i]);
        let current: Vec<f64> = generated.iter().zip(&own).map(|(g, v)| (1.0 - weight) * g + v).collect();
        close(&filled[i * 12..][..12], &current, 1e-5);

        let state = wide(&state[i * STATE..][..STATE]);
        let base: Vec<f64> = state[..3].iter().map(|v| encode(*v)).collect();
        let x = relu(&linear(&p, "color.0", &[base.clone(), state[3..].to_vec(), current].concat()));
        let out: Vec<f64> = linear(&p, "color.2", &relu(&linear(&p, "color.1", &x))).iter().map(|v| v.tanh()).collect();
        let color: Vec<f64> = (0..3)
            .map(|c| {
                let moved: f64 = (0..CANDIDATES).map(|k| 1.5 * out[k] * state[5 + 3 * k + c]).sum();
                base[c] + moved + 0.3 * out[CANDIDATES + c]
            })
            .collect();
        close(&colors[i * 3..][..3], &color, 1e-4);
    }
}

#[test]
fn encoding_and_decoding_are_inverse() {
    let net = network(&parameters());
    let ramp: Vec<f32> = (0..=100).map(|i| i as f32 / 100.0).collect();
    let encoded = srgb_from_linear(net.table(ramp.clone(), 1));
    close(&to_vec(encoded.clone()), &ramp.iter().map(|v| encode(f64::from(*v))).collect::<Vec<_>>(), 1e-6);
    close(&to_vec(linear_from_srgb(encoded)), &ramp.iter().map(|v| f64::from(*v)).collect::<Vec<_>>(), 2e-6);
}

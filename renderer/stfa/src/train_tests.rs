//! Training on made-up samples: gradients, progress, resuming, damaged files.

use flyrig_renderer::AppearanceSettings;
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

use super::*;
use crate::{
    NetworkSize, PATCH, SHARES, SampleErrors,
    body_graph::EDGES,
    comparison::{evaluate, number},
    crops::Crops,
    inputs::STATE,
    taps::Tap,
};

const SIZE: NetworkSize = NetworkSize { channels: [3, 4, 5], node: 6, heads: 2, layers: 1, hidden: [8, 6] };

/// A wall of cloth whose true colour is what was seen, made redder.
fn sample(seed: u64) -> TrainingSample {
    let mut rng = SmallRng::seed_from_u64(seed);
    let (views, width, height, nodes, gaussians) = (2, 16, 12, 12, 60);
    let rgba = (0..views * width * height).flat_map(|_| [rng.random(), rng.random(), rng.random(), 255]).collect();
    let crops = Crops { views, width, height, origins: vec![[0, 0]; views], rgba };
    let row = |taps: &mut Taps, rng: &mut SmallRng| {
        for view in 0..views as u32 {
            let pixel = [rng.random_range(0.0..15.0), rng.random_range(0.0..11.0)];
            taps.taps.push(Tap { view, pixel, weight: rng.random_range(0.0..0.5) });
        }
        taps.end_row();
    };
    let (mut node_taps, mut taps) = (Taps::default(), Taps::default());
    (0..nodes).for_each(|_| row(&mut node_taps, &mut rng));
    (0..gaussians).for_each(|_| row(&mut taps, &mut rng));
    let state: Vec<[f32; STATE]> = (0..gaussians)
        .map(|_| std::array::from_fn(|i| if i < 5 { rng.random_range(0.2..0.6) } else { rng.random_range(-0.1..0.1) }))
        .collect();
    let pixels = PATCH * PATCH;
    let which: Vec<[u32; SHARES]> =
        (0..pixels).map(|_| std::array::from_fn(|_| rng.random_range(0..gaussians))).collect();
    let truth = which
        .iter()
        .map(|which| {
            let mean = |c: usize| which.iter().map(|&g| state[g as usize][c]).sum::<f32>() / SHARES as f32;
            let byte = |linear: f32| (flyrig_renderer::srgb_from_linear(linear) * 255.0) as u8;
            [byte(mean(0) * 1.3), byte(mean(1)), byte(mean(2)), 255]
        })
        .collect();
    let target = TargetPixels {
        taps,
        nodes: (0..gaussians).map(|_| std::array::from_fn(|_| rng.random_range(0..nodes))).collect(),
        node_weights: vec![[0.25; 4]; gaussians as usize],
        gaussians: which,
        shares: vec![[1.0 / SHARES as f32; SHARES]; pixels],
        truth,
        state,
    };
    TrainingSample {
        crops,
        node_taps,
        nodes: (0..nodes).map(|_| std::array::from_fn(|_| rng.random_range(0.0..1.0))).collect(),
        edges: (0..nodes).map(|_| std::array::from_fn::<u32, EDGES, _>(|_| rng.random_range(0..nodes))).collect(),
        place: (0..nodes).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect(),
        targets: vec![target],
    }
}

/// The contrast term has kinks, where differences tell nothing; its slopes have a test of their own (`structure.rs`).
fn settings(steps: u64) -> TrainSettings {
    TrainSettings {
        steps,
        structure: 0.02,
        contrast: 0.0,
        rate: 1e-2,
        without_space: 0.0,
        decay: 0.0,
        vary: false,
        ..TrainSettings::default()
    }
}

#[test]
fn both_tapes_together_give_the_true_gradient() {
    let sample = sample(1);
    let mut trainer = Trainer::new(Parameters::untrained(SIZE, 1), settings(10));
    let mut rng = SmallRng::seed_from_u64(2);
    for parameter in trainer.parameters.by_name.values_mut() {
        parameter.values.iter_mut().for_each(|value| *value += rng.random_range(-0.2..0.2));
    }
    let gradients = trainer.gradients(&sample, &sample.targets[0], Variation::plain(true)).unwrap().1;
    let loss = |parameters: &Parameters| -> f64 {
        let copy = Trainer { parameters: parameters.clone(), ..trainer.clone() };
        number(copy.gradients(&sample, &sample.targets[0], Variation::plain(true)).unwrap().0.total)
    };
    let mut checked = 0;
    for (name, gradient) in &gradients {
        // The largest of each parameter: small ones drown in the rounding of f32.
        let at = (0..gradient.len()).max_by(|a, b| gradient[*a].abs().total_cmp(&gradient[*b].abs())).unwrap();
        if gradient[at].abs() < 2e-3 {
            continue;
        }
        let step = 4e-3;
        let moved = |by: f32| {
            let mut parameters = trainer.parameters.clone();
            parameters.by_name.get_mut(name).unwrap().values[at] += by;
            loss(&parameters)
        };
        let expected = (moved(step) - moved(-step)) / (2.0 * f64::from(step));
        let found = f64::from(gradient[at]);
        assert!((found - expected).abs() < 0.06 * expected.abs() + 2e-4, "{name}[{at}]: {found} against {expected}");
        checked += 1;
    }
    assert!(checked >= 12, "only {checked} parameters have a gradient worth checking");
    assert!(gradients.contains_key("encoder.full.weight"), "the encoder's tape takes part");
}

#[test]
fn an_untrained_network_is_direct_appearance_and_training_beats_it() {
    let samples = [sample(1), sample(3)];
    let mut trainer = Trainer::new(Parameters::untrained(SIZE, 1), settings(200));
    let SampleErrors { learned, direct } = evaluate(&trainer.parameters, &samples[0], true).unwrap();
    assert!((learned.mse - direct.mse).abs() < 1e-9, "{learned:?} against {direct:?}");
    assert!((learned.color_mse - direct.color_mse).abs() < 1e-9, "{learned:?} against {direct:?}");
    assert!((learned.ssim - direct.ssim).abs() < 1e-6, "{learned:?} against {direct:?}");
    assert!((learned.contrast - direct.contrast).abs() < 1e-6, "{learned:?} against {direct:?}");
    while trainer.step < 200 {
        let next = trainer.next_sample(samples.len());
        trainer.step(&samples[next]).unwrap();
    }
    for sample in &samples {
        let SampleErrors { learned, direct } = evaluate(&trainer.parameters, sample, true).unwrap();
        assert!(learned.mse < 0.5 * direct.mse, "{learned:?} against {direct:?}");
    }
}

#[test]
fn a_resumed_training_is_the_same_training() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    let samples = [sample(1), sample(3), sample(4)];
    let go = |trainer: &mut Trainer, until: u64| {
        while trainer.step < until {
            trainer.step(&samples[trainer.next_sample(samples.len())]);
        }
    };
    let mut straight = Trainer::new(Parameters::untrained(SIZE, 1), settings(12));
    go(&mut straight, 12);
    let mut first = Trainer::new(Parameters::untrained(SIZE, 1), settings(12));
    go(&mut first, 5);
    first.save(&path).unwrap();
    let mut second = Trainer::load(&path).unwrap();
    assert_eq!(second, first);
    go(&mut second, 12);
    assert_eq!(second, straight);
    // A checkpoint is a weights file as well.
    assert_eq!(Parameters::load(&path).unwrap(), first.parameters);
}

#[test]
fn every_sample_has_its_turn() {
    let mut trainer = Trainer::new(Parameters::untrained(SIZE, 1), settings(100));
    let mut seen: Vec<usize> = (0..7)
        .map(|step| {
            trainer.step = step;
            trainer.next_sample(7)
        })
        .collect();
    assert_ne!(seen, [0, 1, 2, 3, 4, 5, 6]);
    seen.sort_unstable();
    assert_eq!(seen, [0, 1, 2, 3, 4, 5, 6]);
}

#[test]
fn poisoned_samples_leave_the_weights_alone() {
    let mut trainer = Trainer::new(Parameters::untrained(SIZE, 1), settings(10));
    let before = trainer.parameters.clone();
    let mut poisoned = sample(1);
    poisoned.targets[0].state[3][1] = f32::NAN;
    assert_eq!(trainer.step(&poisoned), None);
    assert_eq!(trainer.step(&TrainingSample::default()), None);
    let mut blind = sample(1);
    blind.crops.rgba.fill(0);
    blind.targets[0].taps.taps.iter_mut().for_each(|tap| tap.weight = 0.0);
    assert_eq!(trainer.parameters, before);
    assert!(trainer.step(&blind).is_some() && trainer.parameters.is_finite());
}

#[test]
fn samples_come_back_from_their_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let made = sample(5);
    made.save(&path).unwrap();
    assert_eq!(TrainingSample::load(&path).unwrap(), made);
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = TrainingSample::load(&path).unwrap_err().to_string();
    assert!(error.contains("a.safetensors") && error.contains("delete it"), "{error}");
    let mut wrong = made;
    wrong.edges[0][0] = 99;
    wrong.save(&path).unwrap();
    let error = TrainingSample::load(&path).unwrap_err().to_string();
    assert!(error.contains("an edge does not fit"), "{error}");
}

#[test]
fn damaged_weights_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("w.safetensors");
    let parameters = Parameters::untrained(SIZE, 1);
    parameters.save(&path, &serde_json::json!({ "made": "here" })).unwrap();
    assert_eq!(Parameters::load(&path).unwrap(), parameters);
    let bytes = std::fs::read(&path).unwrap();
    let error = |bytes: &[u8]| Parameters::from_bytes("w", bytes).unwrap_err().to_string();
    for cut in [0, 5, 100, bytes.len() - 1] {
        assert!(error(&bytes[..cut]).contains("not a whole file"), "cut at {cut}");
    }
    let replaced = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        let mut changed = bytes.clone();
        changed[at..at + to.len()].copy_from_slice(to.as_bytes());
        error(&changed)
    };
    let text = replaced("\"flyrig-stfa\":\"1\"", "\"flyrig-stfa\":\"9\"");
    assert!(text.contains("version 9, expected 1"), "{text}");
    let text = replaced("\\\"node\\\":6", "\\\"node\\\":8");
    assert!(text.contains("shape"), "{text}");
    let text = replaced("\\\"heads\\\":2", "\\\"heads\\\":0");
    assert!(text.contains("cannot be"), "{text}");
    let text = replaced("\"flyrig-stfa\"", "\"other-stuff\"");
    assert!(text.contains("no flyrig networks"), "{text}");
    let mut poisoned = parameters;
    poisoned.by_name.get_mut("fill.bias").unwrap().values[0] = f32::NAN;
    poisoned.save(&path, &serde_json::Value::Null).unwrap();
    let text = Parameters::load(&path).unwrap_err().to_string();
    assert!(text.contains("fill.bias holds numbers that are not finite"), "{text}");
    let text = Parameters::load(&folder.path().join("none")).unwrap_err().to_string();
    assert!(text.contains("none"), "{text}");
    // The settings that samples are gathered with are those of direct appearance.
    AppearanceSettings::default().validate().unwrap();
}

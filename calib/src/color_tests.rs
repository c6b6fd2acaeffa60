use flyrig_model::srgb;

use super::*;

/// Repeatable random numbers in 0..1.
struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * self.roll()
    }
}

fn ids(count: usize) -> Vec<CameraId> {
    (0..count).map(|slot| CameraId::from(format!("{slot:02}"))).collect()
}

/// Returns cameras whose corrections have a mean gain and a mean exponent of 1.
fn cameras(count: usize, model: ColorModel, dice: &mut Dice) -> Vec<ColorMatch> {
    let mut colors: Vec<ColorMatch> = (0..count)
        .map(|_| ColorMatch {
            gain: std::array::from_fn(|_| dice.between(-0.5, 0.5).exp()),
            exponent: if model.response { dice.between(0.85, 1.15) } else { 1.0 },
            falloff: if model.falloff { [dice.between(0.0, 0.4), dice.between(0.0, 0.5)] } else { [0.0; 2] },
        })
        .collect();
    for k in 0..3 {
        let mean = (colors.iter().map(|color| color.gain[k].ln()).sum::<f64>() / count as f64).exp();
        colors.iter_mut().for_each(|color| color.gain[k] /= mean);
    }
    let mean = colors.iter().map(|color| color.exponent).sum::<f64>() / count as f64;
    colors.iter_mut().for_each(|color| color.exponent += 1.0 - mean);
    colors
}

fn srgb(light: f64) -> f64 {
    srgb::encode(light, f64::powf)
}

#[test]
fn logarithm_form_of_srgb_agrees_with_the_curve() {
    for i in 1..=2000 {
        let code = f64::from(i) / 2000.0;
        let expected = srgb::decode(code, f64::powf).ln();
        assert!((log_light(code.ln()) - expected).abs() < 1e-12, "{code}: {expected}");
    }
}

/// Simulates points that every camera sees with probability 0.6, with relative noise, doubled in a tenth of the
/// samples.
fn points(truth: &[ColorMatch], count: usize, noise: f64, dice: &mut Dice) -> Vec<ColorPoint> {
    (0..count as u64)
        .map(|instant| {
            let light: [f64; 3] = std::array::from_fn(|_| dice.between(-4.0, -0.7).exp());
            let mut samples = Vec::new();
            for (camera, color) in truth.iter().enumerate() {
                if dice.roll() > 0.6 {
                    continue;
                }
                let r2 = dice.roll();
                let corner = (color.falloff[0] * r2 + color.falloff[1] * r2 * r2).exp();
                let shine = if noise > 0.0 && dice.roll() < 0.1 { 2.0 } else { 1.0 };
                let seen = |k: usize, dice: &mut Dice| {
                    let noisy = light[k] * shine * dice.between(-2.0 * noise, 2.0 * noise).exp();
                    srgb(noisy / (color.gain[k] * corner)).powf(1.0 / color.exponent)
                };
                let srgb = std::array::from_fn(|k| seen(k, dice));
                samples.push(ColorSample { camera, srgb, r2, weight: dice.between(0.2, 1.0) });
            }
            ColorPoint { instant, samples }
        })
        .collect()
}

#[test]
fn without_noise_every_number_is_found() {
    let mut dice = Dice(1);
    for model in ColorModel::ALL {
        let truth = cameras(5, model, &mut dice);
        let fit = match_colors(&ids(5), &points(&truth, 3000, 0.0, &mut dice)).unwrap();
        assert_eq!(fit.model, model);
        for (found, truth) in fit.cameras.iter().zip(&truth) {
            for k in 0..3 {
                assert!((found.color.gain[k] / truth.gain[k] - 1.0).abs() < 1e-3, "{:?} {truth:?}", found.color);
            }
            assert!((found.color.exponent - truth.exponent).abs() < 1e-3, "{:?} {truth:?}", found.color);
            let corner = |color: &ColorMatch| color.falloff[0] + color.falloff[1];
            assert!((corner(&found.color) - corner(truth)).abs() < 2e-3, "{:?} {truth:?}", found.color);
            assert!(found.difference.1 < 2e-3 && found.halves < 2e-3, "{found:?}");
        }
    }
}

#[test]
fn noise_and_highlights_leave_gains_within_a_percent() {
    let mut dice = Dice(2);
    for model in ColorModel::ALL {
        let truth = cameras(8, model, &mut dice);
        let seen = points(&truth, 4000, 0.05, &mut dice);
        let fit = match_colors(&ids(8), &seen).unwrap();
        // The instants that were kept back agree as well as noise allows: 0.05 of a code value is 0.11 of light.
        let before = color_difference(&[ColorMatch::NONE; 8], &seen);
        println!("kept back: {before} -> {}", fit.kept_back);
        assert!(fit.kept_back < 0.15 && fit.kept_back < 0.5 * before, "{fit:?}");
        // Of what is there, all is sought; more only where it says nothing.
        assert!(fit.model.response || !model.response);
        assert!(fit.model.falloff || !model.falloff);
        for (found, truth) in fit.cameras.iter().zip(&truth) {
            // At a middle light and halfway to the corner.
            let at = |color: &ColorMatch| color.apply([0.35; 3], 0.5);
            for (found, truth) in at(&found.color).into_iter().zip(at(truth)) {
                assert!((found / truth - 1.0).abs() < 0.015, "{found} {truth}");
            }
            assert!(found.difference.1 < found.difference.0 && found.halves < 0.05, "{found:?}");
        }
    }
}

#[test]
fn matched_cameras_stay_as_they_are() {
    let mut dice = Dice(3);
    let truth = vec![ColorMatch::NONE; 3];
    let seen = points(&truth, 2000, 0.03, &mut dice);
    let fit = match_colors(&ids(3), &seen).unwrap();
    let before = color_difference(&truth, &seen);
    assert!(fit.kept_back > 0.95 * before, "nothing is gained: {before} {}", fit.kept_back);
    assert_eq!(fit.model, ColorModel { response: false, falloff: false });
    for camera in &fit.cameras {
        assert!(camera.color.gain.iter().all(|gain| (gain - 1.0).abs() < 0.01), "{camera:?}");
        assert_eq!(ColorMatch { gain: [1.0; 3], ..camera.color }, ColorMatch::NONE);
    }
}

#[test]
fn a_camera_that_shares_nothing_is_named() {
    let mut dice = Dice(4);
    let truth = cameras(3, ColorModel::ALL[0], &mut dice);
    let mut seen = points(&truth, 1000, 0.01, &mut dice);
    seen.iter_mut().for_each(|point| point.samples.retain(|sample| sample.camera != 2));
    let error = match_colors(&ids(3), &seen).unwrap_err().to_string();
    assert!(error.contains("camera 02: 0 points"), "{error}");
    assert!(match_colors(&ids(1), &seen).unwrap_err().to_string().contains("camera 00"), "one alone");
    assert!(match_colors(&ids(2), &[]).unwrap_err().to_string().contains("camera 00"), "nothing seen");
}

#[test]
fn poisoned_samples_change_nothing() {
    let mut dice = Dice(5);
    let truth = cameras(3, ColorModel::ALL[0], &mut dice);
    let clean = points(&truth, 1000, 0.01, &mut dice);
    let good = match_colors(&ids(3), &clean).unwrap();
    let mut poisoned = clean.clone();
    let sample = ColorSample { camera: 0, srgb: [0.5; 3], r2: 0.1, weight: 1.0 };
    let bad = [
        ColorSample { srgb: [f64::NAN, 0.5, 0.5], ..sample },
        ColorSample { srgb: [0.5, 1.0, 0.5], ..sample },
        ColorSample { srgb: [0.0; 3], ..sample },
        ColorSample { r2: f64::INFINITY, ..sample },
        ColorSample { weight: f64::NAN, ..sample },
        ColorSample { weight: 0.0, ..sample },
        ColorSample { camera: 9, ..sample },
    ];
    for (point, bad) in poisoned.iter_mut().zip(bad.iter().cycle()) {
        point.samples.push(*bad);
    }
    poisoned.push(ColorPoint { instant: 7, samples: vec![sample] });
    poisoned.push(ColorPoint { instant: 8, samples: Vec::new() });
    assert_eq!(match_colors(&ids(3), &poisoned).unwrap(), good);
}

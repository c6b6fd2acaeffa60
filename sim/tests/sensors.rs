//! Sensors match their numbers, reproducibly for a seed, camera and frame.

#![allow(clippy::unwrap_used)]

mod common;

use common::{simulator, small_config};
use flyrig_sim::{SensorConfig, Shot, SimConfig, Simulator};

const NANOS: i64 = 700_000_000;

fn with_sensor(sensor: SensorConfig) -> SimConfig {
    SimConfig { sensors: vec![sensor], ..small_config(3) }
}

fn picture(config: &SimConfig, nanos: i64, slot: usize) -> Vec<u8> {
    simulator(config).capture(nanos, slot).unwrap().0.bytes().to_vec()
}

fn linear(byte: u8) -> f64 {
    let c = f64::from(byte) / 255.0;
    if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

#[test]
fn a_sensor_that_does_nothing_leaves_every_byte() {
    let plain = picture(&small_config(3), NANOS, 1);
    assert_eq!(plain, picture(&with_sensor(SensorConfig::default()), NANOS, 1));
}

#[test]
fn noise_is_the_same_for_a_seed_camera_and_frame_and_another_for_others() {
    let noisy =
        SensorConfig { full_well_electrons: Some(2000.0), read_noise_electrons: 5.0, ..SensorConfig::default() };
    let config = with_sensor(noisy);
    let mut first = simulator(&config);
    let plate = |simulator: &Simulator, slot| simulator.plate(slot).unwrap().bytes().to_vec();
    let a = first.capture(NANOS, 0).unwrap().0.bytes().to_vec();
    assert_eq!(a, picture(&config, NANOS, 0));
    assert_eq!(a, first.capture(NANOS, 0).unwrap().0.bytes(), "the second look at an instant differs");
    // The wall behind the person shows the same thing at all times: what differs there is noise.
    let b = first.capture(NANOS + 1, 0).unwrap().0.bytes().to_vec();
    let differing = a[..128 * 3 * 8].iter().zip(&b).filter(|(a, b)| a != b).count();
    assert!(differing > 128 * 3 * 4, "{differing} bytes of the wall differ between frames");
    assert_ne!(plate(&first, 0)[..3072], a[..3072]);
}

/// Compares the variance of the sensor's reading with its electrons, in bins of brightness, over the wall of many
/// frames.
#[test]
fn the_noise_has_the_variance_of_its_electrons() {
    const FULL: f64 = 1500.0;
    const READ: f64 = 12.0;
    const GAIN: f64 = 0.8;
    let clean = SensorConfig { gain: GAIN, ..SensorConfig::default() };
    let noisy = SensorConfig { full_well_electrons: Some(FULL), read_noise_electrons: READ, ..clean };
    let light = picture(&small_config(3), 0, 0);
    let mut simulator = simulator(&with_sensor(noisy));
    // Rows above the person.
    const BYTES: usize = 128 * 3 * 10;
    const FRAMES: i64 = 40;
    let (mut measured, mut expected, mut bias, mut count) = (0.0, 0.0, 0.0, 0.0);
    for frame in 0..FRAMES {
        let (read, _) = simulator.capture(frame * 1000, 0).unwrap();
        for (from, to) in light[..BYTES].iter().zip(read.bytes()) {
            let electrons = linear(*from) * FULL;
            let error = linear(*to) - linear(*from) * GAIN;
            // Coding in 8 bits adds a twelfth of a step's square.
            let step = linear(to.saturating_add(1)) - linear(*to);
            measured += error * error - step * step / 12.0;
            expected += (electrons + READ * READ) / (FULL * FULL) * GAIN * GAIN;
            bias += error;
            count += 1.0;
        }
    }
    let ratio: f64 = measured / expected;
    let (sigma, mean): (f64, f64) = ((expected / count).sqrt(), bias / count);
    println!("{count} readings: variance {ratio:.4} of the expected one, mean off by {mean:.2e} of sigma {sigma:.2e}");
    assert!((ratio - 1.0).abs() < 0.03, "variance is {ratio} of the expected one");
    assert!(mean.abs() < 0.03 * sigma, "mean is off by {mean}, sigma is {sigma}");
}

#[test]
fn exposure_gain_gamma_balance_and_vignetting_change_light_by_their_numbers() {
    let light = simulator(&small_config(3)).light(&Shot::new(NANOS, 0)).unwrap();
    let light = light.as_flattened();
    let compare = |sensor: SensorConfig, expected: &dyn Fn(f64, usize, usize, usize) -> f64| {
        let changed = picture(&with_sensor(sensor.clone()), NANOS, 0);
        let mut worst = 0.0f64;
        for (i, (from, to)) in light.iter().zip(&changed).enumerate() {
            let (x, y, channel) = (i / 3 % 128, i / 384, i % 3);
            let level = expected(f64::from(*from), x, y, channel).clamp(0.0, 1.0);
            let coded = if level <= 0.003_130_8 { 12.92 * level } else { 1.055 * level.powf(1.0 / 2.4) - 0.055 };
            worst = worst.max((coded.powf(sensor.gamma) * 255.0 - f64::from(*to)).abs());
        }
        assert!(worst < 0.51, "{sensor:?}: off by {worst} of 255");
    };
    let plain = SensorConfig::default;
    compare(SensorConfig { exposure: 0.5, gain: 1.6, ..plain() }, &|light, _, _, _| light * 0.8);
    compare(SensorConfig { gamma: 1.3, ..plain() }, &|light, _, _, _| light);
    let balance = [1.1, 1.0, 0.8];
    compare(SensorConfig { white_balance: balance, ..plain() }, &|light, _, _, c| light * balance[c]);
    compare(SensorConfig { vignetting: 0.4, ..plain() }, &|light, x, y, _| {
        let from_middle = |at: usize| (at as f64 + 0.5 - 64.0) / 64.0;
        let r2 = (from_middle(x).powi(2) + from_middle(y).powi(2)) / 2.0;
        light * (1.0 - 0.4 * r2 * r2)
    });
}

#[test]
fn each_camera_has_its_own_sensor_and_jpeg_leaves_its_traces() {
    let dark = SensorConfig { exposure: 0.3, ..SensorConfig::default() };
    let config = SimConfig { sensors: vec![SensorConfig::default(), dark], ..small_config(3) };
    let mean = |bytes: &[u8]| bytes.iter().map(|b| f64::from(*b)).sum::<f64>() / bytes.len() as f64;
    let plain = simulator(&small_config(3)).capture(NANOS, 1).unwrap().0;
    assert_eq!(picture(&config, NANOS, 0), picture(&small_config(3), NANOS, 0));
    assert!(mean(&picture(&config, NANOS, 1)) < 0.7 * mean(plain.bytes()));
    let errors = [10, 90].map(|quality| {
        let coded = with_sensor(SensorConfig { jpeg_quality: Some(quality), ..SensorConfig::default() });
        let coded = picture(&coded, NANOS, 1);
        coded.iter().zip(plain.bytes()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / coded.len() as f64
    });
    println!("mean error of JPEG at quality 10 and 90: {errors:.2?} of 255");
    assert!(errors[0] > 1.5 * errors[1] && errors[1] > 0.1, "{errors:?}");
}

#[test]
fn numbers_out_of_range_are_refused_by_name() {
    let refusal = |sensor| with_sensor(sensor).validate().unwrap_err().to_string();
    assert!(refusal(SensorConfig { gain: f64::NAN, ..SensorConfig::default() }).contains("sensors.gain is NaN"));
    assert!(
        refusal(SensorConfig { jpeg_quality: Some(0), ..SensorConfig::default() }).contains("sensors.jpeg_quality")
    );
    let lone = SensorConfig { read_noise_electrons: 2.0, ..SensorConfig::default() };
    assert!(refusal(lone).contains("full_well_electrons"));
    assert!(toml::from_str::<SimConfig>("[[sensors]]\nexposre = 2.0\n").unwrap_err().to_string().contains("exposre"));
}

//! Prints the errors of matched colours against the sensors of a simulation.
//!
//!     cargo run --release -p flyrig-calib --example color_errors -- SIM.toml CALIBRATION
//!
//! SIM.toml has one table of `sim.sensors` per camera; CALIBRATION is the folder written by `flyrig calibrate color`.
//! For light of three intensities and each channel, prints the deviation of each camera's light from the geometric mean
//! of all, before and after correction.

use std::{error::Error, path::Path};

use flyrig_calib::load_calibration;
use flyrig_types::ColorMatch;

const LIGHTS: [f64; 3] = [0.05, 0.15, 0.4];
/// Squared distances from the centre, relative to half the diagonal.
const PLACES: [f64; 3] = [0.02, 0.2, 0.5];

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (sim, folder) = arguments.next().zip(arguments.next()).ok_or("which simulation and calibration?")?;
    let file: toml::Table = std::fs::read_to_string(sim)?.parse()?;
    let sensors =
        file.get("sim").and_then(|sim| sim.get("sensors")).and_then(toml::Value::as_array).ok_or("no sensors")?;
    let rig = load_calibration(Path::new(&folder), &|_| None)?;
    if sensors.len() != rig.cameras.len() {
        return Err(format!("{} sensors for {} cameras", sensors.len(), rig.cameras.len()).into());
    }
    for r2 in PLACES {
        let (mut before, mut after) = (Vec::new(), Vec::new());
        for (light, channel) in LIGHTS.iter().flat_map(|light| (0..3).map(move |channel| (light, channel))) {
            let codes: Vec<f64> = sensors.iter().map(|sensor| code(sensor, *light, channel, r2)).collect();
            let corrected = |of: &dyn Fn(usize) -> ColorMatch| -> Vec<f64> {
                let lights = codes.iter().enumerate().map(|(slot, code)| of(slot).apply([*code; 3], r2)[channel].ln());
                let lights: Vec<f64> = lights.collect();
                let mean = lights.iter().sum::<f64>() / lights.len() as f64;
                lights.into_iter().map(|light| 100.0 * (light - mean).abs()).collect()
            };
            before.extend(corrected(&|_| ColorMatch::NONE));
            after.extend(corrected(&|slot| rig.cameras[slot].color));
        }
        let of = |errors: &[f64]| {
            let mean = errors.iter().sum::<f64>() / errors.len() as f64;
            format!("mean {mean:.1} %, worst {:.1} %", errors.iter().copied().fold(0.0, f64::max))
        };
        println!("r2 {r2}: before {}; after {}", of(&before), of(&after));
    }
    Ok(())
}

/// Returns the sRGB value, in 0..=1, of a noiseless simulated sensor for an intensity.
fn code(sensor: &toml::Value, light: f64, channel: usize, r2: f64) -> f64 {
    let number = |value: &toml::Value| value.as_float().or(value.as_integer().map(|i| i as f64));
    let of = |key: &str, default: f64| sensor.get(key).and_then(number).unwrap_or(default);
    let balance = sensor.get("white_balance").and_then(|balance| number(balance.get(channel)?)).unwrap_or(1.0);
    let seen = light * of("exposure", 1.0) * of("gain", 1.0) * balance * (1.0 - of("vignetting", 0.0) * r2 * r2);
    let seen = seen.clamp(0.0, 1.0);
    let srgb = if seen <= 0.003_130_8 { 12.92 * seen } else { 1.055 * seen.powf(1.0 / 2.4) - 0.055 };
    srgb.powf(of("gamma", 1.0))
}

//! Shutters, apertures and switching lamps match their numbers.

#![allow(clippy::unwrap_used)]

mod common;

use common::{cast, simulator, small_config};
use flyrig_sim::{LightConfig, LightSwitch, MotionKind, OpticsConfig, Shot, SimConfig, Simulator};
use glam::{DVec2, DVec3};

const NANOS: i64 = 1_400_000_000;

fn with_optics(config: &SimConfig, optics: OpticsConfig) -> Simulator {
    simulator(&SimConfig { optics: vec![optics], ..config.clone() })
}

fn light(simulator: &mut Simulator, nanos: i64) -> Vec<[f32; 3]> {
    simulator.light(&Shot::new(nanos, 0)).unwrap()
}

fn differences(a: &[[f32; 3]], b: &[[f32; 3]]) -> Vec<f64> {
    let mut all: Vec<f64> = a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| f64::from((a - b).abs())).collect();
    all.sort_by(f64::total_cmp);
    all
}

#[test]
fn motion_blur_is_the_mean_of_sharp_images_in_linear_light() {
    let mut config = small_config(3);
    config.motion.turn_secs = 2.0;
    let optics = OpticsConfig { exposure_ms: 40.0, samples: 8, ..OpticsConfig::default() };
    let blurred = light(&mut with_optics(&config, optics), NANOS);
    let mut sharp = simulator(&config);
    let mut mean = vec![[0.0f32; 3]; blurred.len()];
    for k in 0..8 {
        let nanos = NANOS + ((f64::from(k) + 0.5) / 8.0 * 40e6 - 20e6).round() as i64;
        for (sum, pixel) in mean.iter_mut().zip(light(&mut sharp, nanos)) {
            *sum = std::array::from_fn(|c| sum[c] + pixel[c] / 8.0);
        }
    }
    let average = |all: &[f64]| all.iter().sum::<f64>() / all.len() as f64;
    let off = differences(&blurred, &mean);
    let unblurred = average(&differences(&light(&mut sharp, NANOS), &mean));
    let at = |share: f64| off[(share * (off.len() - 1) as f64) as usize];
    println!(
        "off by {:.2e} on average, 99.5 of 100 within {:.2e}; unblurred {unblurred:.2e}",
        average(&off),
        at(0.995)
    );
    // The lamps' images are fitted to all of the exposure, so that edges of shadows fall a texel beside.
    assert!(average(&off) < 1.5e-3 && at(0.995) < 0.03, "{} {}", average(&off), at(0.995));
    assert!(unblurred > 4.0 * average(&off), "{unblurred}");
}

#[test]
fn blur_of_somebody_who_stands_still_changes_nothing() {
    let mut config = small_config(3);
    config.motion.kind = MotionKind::Still;
    let optics = OpticsConfig { exposure_ms: 30.0, readout_ms: 20.0, samples: 5, ..OpticsConfig::default() };
    let a = light(&mut with_optics(&config, optics), 0);
    let b = light(&mut simulator(&config), 0);
    let worst = differences(&a, &b).pop().unwrap();
    println!("worst difference {worst:.2e}");
    assert!(worst < 0.012, "{worst}");
}

/// Compares the truth under a rolling shutter with rays cast, in f64, into the surface at each row's own time.
#[test]
fn a_rolling_shutter_sees_each_row_at_its_own_time() {
    let mut config = small_config(3);
    config.motion.turn_secs = 1.0;
    const READOUT_MS: f64 = 60.0;
    let optics = OpticsConfig { readout_ms: READOUT_MS, ..OpticsConfig::default() };
    let mut rolling = with_optics(&config, optics);
    let frame = rolling.render(NANOS, 0).unwrap();
    let mut global = simulator(&config);
    let still = global.render(NANOS, 0).unwrap();
    let camera = rolling.rig().cameras[0].clone();
    let forward = camera.camera_from_world.rotation.inverse() * DVec3::Z;
    let (mut off, mut off_still, mut rows) = (Vec::new(), Vec::new(), 0);
    for row in (8..120).step_by(7) {
        let secs = (f64::from(row) - 63.5) / 127.0 * READOUT_MS * 1e-3;
        let mesh = rolling.clothed_surface(NANOS + (secs * 1e9).round() as i64);
        let pixels: Vec<usize> =
            (row as usize * 128..(row as usize + 1) * 128).filter(|&i| frame.depth[i] > 0.0).collect();
        rows += usize::from(!pixels.is_empty());
        for &i in pixels.iter().step_by(2) {
            let ray = camera.ray(DVec2::new((i % 128) as f64, f64::from(row))).unwrap();
            let Some((t, point)) = cast(&mesh, camera.position(), ray) else {
                off.push(f64::INFINITY);
                continue;
            };
            let place = |canonical: [f32; 4]| DVec3::from_slice(&canonical.map(f64::from)[..3]);
            off.push(
                (f64::from(frame.depth[i]) - t * ray.dot(forward)).abs().max(place(frame.canonical[i]).distance(point)),
            );
            off_still.push(place(still.canonical[i]).distance(point));
        }
    }
    off.sort_by(f64::total_cmp);
    off_still.sort_by(f64::total_cmp);
    let (high, middle) = (off[off.len() * 95 / 100], off_still[off_still.len() / 2]);
    println!(
        "{} pixels of {rows} rows: 95 of 100 within {high:.2e} m; the global shutter's median is {middle:.2e} m off",
        off.len()
    );
    assert!(rows > 7 && off.len() > 60);
    assert!(high < 1e-3, "{high}");
    assert!(middle > 3e-3, "nothing moved: {middle}");
}

#[test]
fn a_wide_aperture_blurs_what_is_far_from_its_plane() {
    let config = small_config(3);
    let sharp = light(&mut simulator(&config), NANOS);
    let contrast = |light: &[[f32; 3]], rows: std::ops::Range<usize>| -> f64 {
        rows.flat_map(|y| (1..128).map(move |x| y * 128 + x))
            .map(|i| f64::from((light[i][1] - light[i - 1][1]).powi(2)))
            .sum()
    };
    let of = |focus_m: f64| {
        let optics = OpticsConfig { aperture_mm: 60.0, focus_m, samples: 12, ..OpticsConfig::default() };
        light(&mut with_optics(&config, optics), NANOS)
    };
    let (near, far) = (of(2.9), of(7.0));
    // The person fills the middle rows, the wall the top ones.
    let ratio =
        |light: &[[f32; 3]], rows: std::ops::Range<usize>| contrast(light, rows.clone()) / contrast(&sharp, rows);
    let (person_near, person_far) = (ratio(&near, 45..75), ratio(&far, 45..75));
    println!("contrast kept on the person: {person_near:.3} in focus, {person_far:.3} out of it");
    assert!(person_near > 1.5 * person_far && person_near > 0.6, "{person_near} {person_far}");
    // No light is lost.
    let total = |light: &[[f32; 3]]| light.iter().flatten().map(|c| f64::from(*c)).sum::<f64>();
    assert!((total(&near) / total(&sharp) - 1.0).abs() < 0.02);
}

#[test]
fn a_lamp_that_switches_darkens_the_rows_read_after_it() {
    let lamp = LightConfig { switch: vec![LightSwitch { secs: 0.5, level: 0.1 }], ..LightConfig::default() };
    let mut config = SimConfig { lights: vec![lamp], ..small_config(3) };
    config.motion.kind = MotionKind::Still;
    let mean =
        |light: &[[f32; 3]]| light.iter().flatten().map(|c| f64::from(*c)).sum::<f64>() / (3 * light.len()) as f64;
    let mut sharp = simulator(&config);
    let (before, after) = (light(&mut sharp, 499_000_000), light(&mut sharp, 501_000_000));
    assert!(mean(&after) < 0.4 * mean(&before), "{} {}", mean(&after), mean(&before));
    let optics = OpticsConfig { readout_ms: 20.0, ..OpticsConfig::default() };
    let both = light(&mut with_optics(&config, optics), 500_000_000);
    // The switch falls on the middle row: above it the room as before, below as after.
    for (rows, expected) in [(0..60 * 128, &before), (68 * 128..128 * 128, &after)] {
        let off = differences(&both[rows.clone()], &expected[rows]);
        assert!(off[off.len() * 999 / 1000] < 0.02, "{}", off[off.len() * 999 / 1000]);
    }
    // The plate is the room at the start.
    assert!(sharp.plate(0).unwrap().bytes().iter().map(|&b| f64::from(b)).sum::<f64>() > 0.0);
}

#[test]
fn sub_frames_and_lenses_out_of_range_are_refused_by_name() {
    let refusal = |optics: OpticsConfig| {
        SimConfig { optics: vec![optics], ..small_config(3) }.validate().unwrap_err().to_string()
    };
    let plain = OpticsConfig::default;
    assert!(refusal(OpticsConfig { exposure_ms: f64::NAN, ..plain() }).contains("optics.exposure_ms is NaN"));
    assert!(refusal(OpticsConfig { samples: 0, ..plain() }).contains("optics.samples is 0"));
    assert!(refusal(OpticsConfig { focus_m: 0.0, ..plain() }).contains("optics.focus_m"));
    assert!(refusal(OpticsConfig { aperture_mm: f64::INFINITY, ..plain() }).contains("optics.aperture_mm"));
    assert!(refusal(OpticsConfig { readout_ms: -1.0, ..plain() }).contains("optics.readout_ms"));
}

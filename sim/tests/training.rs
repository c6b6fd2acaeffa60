//! Endless training data: random, valid, and reproducible.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeSet;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SceneKind, TrainingConfig, TrainingSamples, random_config};

fn small() -> TrainingConfig {
    TrainingConfig {
        cameras: 2,
        size: [96, 64],
        texture_px: 64,
        instants: 2,
        samples_a_person: 2,
        ..Default::default()
    }
}

#[test]
fn a_thousand_random_captures_are_valid_and_none_is_another() {
    let mut seen = BTreeSet::new();
    let (mut fisheyes, mut blurred, mut lagging, mut passed_by) = (0, 0, 0, 0);
    for person in 0..1000 {
        let config = random_config(&small(), person);
        config.validate().unwrap();
        assert_eq!(config, random_config(&small(), person));
        assert_eq!(config.scene.kind, SceneKind::BySeed);
        seen.insert(toml::to_string(&config).unwrap());
        fisheyes += u32::from(config.cameras.fisheye.is_some());
        blurred += u32::from(config.optics[0].exposure_ms > 0.0);
        lagging += u32::from(!config.faults.faults.is_empty());
        passed_by += u32::from(config.scene.passer_by);
    }
    assert_eq!(seen.len(), 1000);
    for (what, count) in [("fisheye", fisheyes), ("blur", blurred), ("lag", lagging), ("passer-by", passed_by)] {
        assert!((80..800).contains(&count), "{what}: {count} of 1000");
    }
}

#[test]
fn samples_go_on_without_a_disk_and_repeat_exactly() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let make = || TrainingSamples::new(&gpu, small()).unwrap();
    let samples: Vec<_> = make().take(3).map(Result::unwrap).collect();
    // Two samples of the first person at other instants, then another person.
    assert_eq!(samples[0].config, samples[1].config);
    assert_ne!(samples[0].first, samples[1].first);
    assert_ne!(samples[1].config.seed, samples[2].config.seed);
    for sample in &samples {
        assert_eq!((sample.instants.len(), sample.rig.cameras.len()), (2, 2));
        assert_ne!(sample.rig, sample.reported_rig, "calibration is never perfect");
        for frame in sample.instants.iter().flatten() {
            assert_eq!((frame.color.width(), frame.color.height(), frame.depth.len()), (96, 64, 96 * 64));
        }
        let covered = sample.instants.iter().flatten().filter(|f| f.depth.iter().any(|&z| z > 0.0)).count();
        assert!(covered >= 3, "the person is seen in {covered} of 4 images");
    }
    for (a, b) in samples.iter().zip(make()) {
        let b = b.unwrap();
        assert_eq!(a.instants[1][1].color.bytes(), b.instants[1][1].color.bytes());
        assert_eq!(a.instants[1][1].depth, b.instants[1][1].depth);
    }
}

#[test]
fn settings_out_of_range_are_refused_by_name() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let refused = |config| TrainingSamples::new(&gpu, config).unwrap_err().to_string();
    assert!(refused(TrainingConfig { cameras: 0, ..small() }).contains("cameras.count is 0"));
    assert!(refused(TrainingConfig { instants: 0, ..small() }).contains("training.instants is 0"));
    assert!(refused(TrainingConfig { samples_a_person: 0, ..small() }).contains("training.samples_a_person is 0"));
    assert!(refused(TrainingConfig { size: [4, 64], ..small() }).contains("width is 4"));
}

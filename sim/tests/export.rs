//! An exported capture equals the simulator's images and truth.

#![allow(clippy::unwrap_used)]

mod common;

use std::fs;
use std::path::Path;

use common::{simulator, small_config};
use exr::prelude::{ReadChannels as _, ReadLayers as _, read};
use flyrig_calib::load_easymocap;
use flyrig_sim::{ExportOptions, FaultScript, SimConfig, SimError, export};

fn config() -> SimConfig {
    let mut config = small_config(3);
    let script = "[[fault]]\nkind = \"drop\"\ncamera = \"01\"\nfrom_frame = 1\nframes = 1\n\
                  [[fault]]\nkind = \"lag\"\ncamera = \"00\"\nms = 7.0\n\
                  [[fault]]\nkind = \"offset\"\ncamera = \"00\"\nms = 3.0\n";
    config.faults = FaultScript::parse(script).unwrap();
    config
}

fn png(path: &Path) -> Vec<u8> {
    image::open(path).unwrap().into_bytes()
}

/// Reads the samples of a channel of an EXR file by name.
fn channel(path: &Path, name: &str) -> Vec<f32> {
    let image = read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer().all_attributes();
    let image = image.from_file(path).unwrap();
    let channel = image.layer_data.channel_data.list.iter().find(|channel| channel.name.to_string() == name).unwrap();
    channel.sample_data.values_as_f32().collect()
}

#[test]
fn images_calibration_and_truth_lie_in_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("take");
    let mut simulator = simulator(&config());
    let mut progress = Vec::new();
    let options = ExportOptions { frames: 3, truth: true };
    let exported = export(&mut simulator, &out, options, &mut |frames| {
        progress.push(frames);
        true
    });
    let exported = exported.unwrap();
    assert_eq!((exported.pictures, exported.lost), (5, 1));
    assert_eq!(progress, [0, 1, 2, 3]);
    assert!(!out.join("images/01/000001.png").exists());

    let nanos = simulator.frame_nanos(2) + 7_000_000;
    let seen = simulator.render(nanos, 0).unwrap();
    assert_eq!(png(&out.join("images/00/000002.png")), seen.color.bytes());
    assert_eq!(png(&out.join("mask/00/000002.png")), seen.mask.coverage());
    assert_eq!(png(&out.join("background/01.png")), simulator.plate(1).unwrap().bytes());
    let truth = out.join("truth/00/000002.exr");
    assert_eq!(channel(&truth, "Z"), seen.depth);
    for (axis, name) in ["canonical.X", "canonical.Y", "canonical.Z"].into_iter().enumerate() {
        assert_eq!(channel(&truth, name), seen.canonical.iter().map(|p| p[axis]).collect::<Vec<_>>());
    }
    let parts: Vec<f32> = seen.part.iter().map(|part| part.map_or(0.0, |part| part as u8 as f32 + 1.0)).collect();
    assert_eq!(channel(&truth, "part"), parts);

    let rig = load_easymocap(&out, &|_| None).unwrap();
    let (a, b) = (&rig.cameras[1], &simulator.rig().cameras[1]);
    let point = glam::DVec3::new(0.1, 0.2, 1.1);
    assert!(a.project(point).unwrap().distance(b.project(point).unwrap()) < 1e-6);
    let subject = flyrig_body::load_gltf(&out.join("subject.glb")).unwrap();
    assert!(subject.track.unwrap().span_nanos().1 >= simulator.frame_nanos(2));
    let again: SimConfig = toml::from_str(&fs::read_to_string(out.join("simulation.toml")).unwrap()).unwrap();
    assert_eq!(&again, simulator.config());

    let times = fs::read_to_string(out.join("truth/frames.csv")).unwrap();
    let line = format!("2,00,frame,{nanos},{},1", nanos + 3_000_000);
    assert!(times.lines().any(|found| found == line), "no line {line} in\n{times}");
    assert!(times.contains("\n1,01,dropped,"), "{times}");
    let poses = fs::read_to_string(out.join("truth/poses.jsonl")).unwrap();
    let pose: serde_json::Value = serde_json::from_str(poses.lines().nth(2).unwrap()).unwrap();
    let root = simulator.pose(simulator.frame_nanos(2)).root_translation;
    assert!((pose["root_translation_m"][2].as_f64().unwrap() - root.z).abs() < 1e-12);
    assert!(fs::read(out.join("truth/surface/000002.ply")).unwrap().starts_with(b"ply"));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing half-written stays");
}

#[test]
fn an_export_that_cannot_end_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("take");
    let mut simulator = simulator(&config());
    let options = ExportOptions { frames: 9, truth: false };
    let stopped = export(&mut simulator, &out, options, &mut |frames| frames < 2).unwrap_err();
    assert!(matches!(stopped, SimError::Stopped), "{stopped}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);

    fs::create_dir(&out).unwrap();
    fs::write(out.join("mine.txt"), "of the user").unwrap();
    let refusal = export(&mut simulator, &out, options, &mut |_| true).unwrap_err().to_string();
    assert!(refusal.contains("take is there already"), "{refusal}");
    assert_eq!(fs::read(out.join("mine.txt")).unwrap(), b"of the user");

    let inside_a_file = out.join("mine.txt/take");
    let refusal = export(&mut simulator, &inside_a_file, options, &mut |_| true).unwrap_err().to_string();
    assert!(refusal.contains("mine.txt/take.partial") && refusal.contains("cannot be written"), "{refusal}");
}

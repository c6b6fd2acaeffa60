//! Validation of settings: bad ones are rejected by name; good ones survive a round trip.

#![allow(clippy::unwrap_used)]

use std::path::PathBuf;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{MotionKind, SimConfig, Simulator, camera_ring};

fn refusal(change: impl Fn(&mut SimConfig)) -> String {
    let mut config = SimConfig::default();
    change(&mut config);
    camera_ring(&config).unwrap_err().to_string()
}

#[test]
fn numbers_out_of_range_are_named_with_their_range() {
    assert_eq!(refusal(|c| c.cameras.count = 0), "simulation: cameras.count is 0, expected 1 to 128 cameras");
    assert!(refusal(|c| c.width = 100_000).contains("width is 100000, expected 16 to 4096 pixels"));
    assert!(refusal(|c| c.height = 0).contains("height is 0"));
    assert!(refusal(|c| c.fps = f64::NAN).contains("fps is NaN"));
    assert!(refusal(|c| c.fps = 0.0).contains("fps is 0"));
    assert!(refusal(|c| c.cameras.radial = [f64::INFINITY, 0.0]).contains("cameras.radial"));
    assert!(refusal(|c| c.cameras.radius_m = -1.0).contains("cameras.radius_m"));
    assert!(refusal(|c| c.motion.turn_secs = f64::NAN).contains("motion.turn_secs"));
    let shape = |name: &str, weight| {
        let name = name.to_owned();
        refusal(move |c| c.person.shape.0.extend([(name.clone(), weight)]))
    };
    let unknown = shape("hight", 0.5);
    assert!(unknown.starts_with("simulation: person.shape: ") && unknown.contains("did you mean height"), "{unknown}");
    assert!(shape("weight", 1.5).contains("'weight' has the weight 1.5; it must lie in 0..=1"));
    assert!(shape("weight", f32::NAN).contains("person.shape"));
}

#[test]
fn unknown_keys_are_refused_and_defaults_fill_the_rest() {
    let error = toml::from_str::<SimConfig>("seed = 3\nwidht = 640\n").unwrap_err().to_string();
    assert!(error.contains("widht") && error.contains("width"), "{error}");
    assert!(toml::from_str::<SimConfig>("[cameras]\nnumber = 4\n").unwrap_err().to_string().contains("number"));
    let config: SimConfig = toml::from_str(
        "seed = 3\n[person]\nbuild = \"heavy-man\"\nshape = { weight = 0.9 }\n[motion]\nkind = \"bvh\"\n",
    )
    .unwrap();
    assert_eq!((config.seed, config.width, config.motion.kind), (3, 512, MotionKind::Bvh));
    let text = toml::to_string(&config).unwrap();
    assert_eq!(toml::from_str::<SimConfig>(&text).unwrap(), config);
}

#[test]
fn a_missing_clip_is_an_error_that_says_what_to_do() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let mut config = SimConfig::default();
    config.motion.kind = MotionKind::Bvh;
    config.motion.bvh = Some(PathBuf::from("/nowhere/walk.bvh"));
    let error = Simulator::new(&gpu, &config).unwrap_err().to_string();
    assert!(error.starts_with("motion clip /nowhere/walk.bvh not found; "), "{error}");
}

/// Checks that results are not judged by images of the renderer under test.
#[test]
fn the_simulation_does_not_depend_on_our_renderer() {
    let manifest: toml::Table = toml::from_str(include_str!("../Cargo.toml")).unwrap();
    for section in ["dependencies", "dev-dependencies", "build-dependencies"] {
        let names = manifest.get(section).and_then(|table| table.as_table());
        assert!(names.is_none_or(|table| !table.contains_key("flyrig-renderer")), "{section}");
    }
}

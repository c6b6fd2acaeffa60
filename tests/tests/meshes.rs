//! Meshes: a take, or an avatar, becomes a closed mesh with bones, in files that other programs read; unsupported input has a named error and
//! leaves nothing behind.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::{fs, path::Path};

use flyrig_body::{load_gltf, skin_mesh};
use flyrig_tests::{run, write_dataset, write_dataset_with_truth};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
const GIVEN: [&str; 4] = ["--pose", "given", "--masks", "given"];
const SMALL: [&str; 6] = ["--triangles", "4000", "--texture", "512", "--voxel", "20"];

fn number(metrics: &serde_json::Value, name: &str) -> f64 {
    metrics[name].as_f64().unwrap_or_else(|| panic!("no {name} in {metrics}"))
}

#[test]
fn a_take_becomes_a_closed_mesh_that_moves_as_the_person_does() {
    let data = write_dataset().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let take = data.root.to_string_lossy().into_owned();
    let mesh = |args: &[&str]| run(PROGRAM, &[&["mesh"], args, &SMALL].concat(), folder.path()).unwrap();
    let of_take = |out: &str, more: &[&str]| {
        let args =
            [&take, "--inputs", "00,02,04", "--frames", "0..4", "--gaussians", "4000", "--steps", "5", "--out", out];
        mesh(&[&args[..], &GIVEN, more].concat())
    };
    let made = of_take("m", &["--sequence", "--holdout", "01,03"]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let at = |name: &str| folder.path().join("m").join(name);
    let metrics: serde_json::Value = serde_json::from_slice(&fs::read(at("metrics.json")).unwrap()).unwrap();
    assert_eq!((&metrics["closed_manifold"], &metrics["components"]), (&true.into(), &1.into()), "{metrics}");
    assert!(number(&metrics, "triangles") <= 4000.0 && number(&metrics, "volume_m3") > 0.03, "{metrics}");
    // Photographs make most of the texture, and the textured mesh looks like the person from cameras that were left out.
    let seen = number(&metrics, "texture_from_photographs");
    assert!((0.3..1.0).contains(&seen), "{seen}");
    let held_out = |what: &str| number(&metrics["held_out"][what], "psnr_db");
    let (mesh_db, gaussians_db) = (held_out("mesh"), held_out("gaussians"));
    assert!(mesh_db > 15.0 && mesh_db > gaussians_db - 2.0, "{mesh_db} {gaussians_db}");

    // Skin and motion bring the mesh to where its surface was written.
    let human = load_gltf(&at("mesh.glb")).unwrap();
    let track = human.track.unwrap();
    assert_eq!(track.keys().len(), 4);
    let (posed, _) = skin_mesh(&human.template, &track.at(track.keys()[0].0));
    let height = |y: &dyn Fn(usize) -> f32, count: usize| {
        (0..count).map(y).fold(f32::NEG_INFINITY, f32::max) - (0..count).map(y).fold(f32::INFINITY, f32::min)
    };
    let tall = height(&|i| posed[i].y, posed.len());
    assert!((1.2..2.2).contains(&tall), "{tall} m, y up");
    let surfaces: Vec<_> = fs::read_dir(at("surface")).unwrap().collect();
    assert_eq!(surfaces.len(), 4);
    assert!(at("surface/000003.ply").exists());
    for name in ["mesh.obj", "mesh.mtl", "mesh.png", "mesh.usdz", "mesh.3mf", "sequence.usda"] {
        assert!(fs::metadata(at(name)).unwrap().len() > 60, "{name}");
    }
    // The same take gives the same mesh, with or without cameras to compare with.
    assert_eq!(of_take("again", &[]).code, Some(0));
    let bytes = |folder: &Path| fs::read(folder.join("mesh.glb")).unwrap();
    assert!(bytes(&folder.path().join("m")) == bytes(&folder.path().join("again")), "reruns differ");
    // Light in the texture changes its colours alone.
    assert_eq!(of_take("lit", &["--light", "baked"]).code, Some(0));
    let file = |out: &str, name: &str| fs::read(folder.path().join(out).join(name)).unwrap();
    assert!(file("lit", "mesh.png") != file("m", "mesh.png") && file("lit", "mesh.3mf") == file("m", "mesh.3mf"));

    // From an avatar, in the rest pose and without a motion.
    let build = ["avatar", "build", &take, "--inputs", "00,02,04", "--frames", "0..4", "--gaussians", "4000"];
    let built = run(PROGRAM, &[&build[..], &["--steps", "5", "--out", "a.flyavatar"], &GIVEN].concat(), folder.path());
    assert_eq!(built.unwrap().code, Some(0));
    let from_avatar = mesh(&["a.flyavatar", "--out", "avatar"]);
    assert_eq!(from_avatar.code, Some(0), "{from_avatar:?}");
    assert!(load_gltf(&folder.path().join("avatar/mesh.glb")).unwrap().track.is_none());
    assert_eq!(mesh(&["a.flyavatar", "--out", "avatar-lit", "--light", "baked"]).code, Some(0));
    assert!(file("avatar-lit", "mesh.png") != file("avatar", "mesh.png"));

    let refused = |args: &[&str], text: &str| {
        let before = fs::read_dir(folder.path()).unwrap().count();
        let failed = mesh(args);
        assert_eq!(failed.code, Some(1), "{failed:?}");
        assert!(failed.stderr.contains(text), "{}", failed.stderr);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), before, "{args:?} left a file");
    };
    refused(&["a.flyavatar", "--out", "m"], "m exists already");
    refused(&["a.flyavatar", "--out", "none/m"], "the folder none does not exist");
    let of_takes = ["a.flyavatar", "--out", "x", "--inputs", "00", "--holdout", "01", "--steps", "7"];
    refused(&of_takes, "a.flyavatar is an avatar and not a take: leave out --inputs and --holdout and --steps");
    refused(&[&take, "--out", "x", "--inputs", "00,02", "--holdout", "02"], "both an input and held out");
    refused(&["a.flyavatar", "--out", "."], "names no folder");
    fs::create_dir(folder.path().join("x.partial")).unwrap();
    fs::write(folder.path().join("x.partial/mine"), b"kept").unwrap();
    refused(&["a.flyavatar", "--out", "x"], "x.partial is left over");
    assert!(folder.path().join("x.partial/mine").exists());
    fs::remove_dir_all(folder.path().join("x.partial")).unwrap();
    refused(&["missing.flyavatar", "--out", "x"], "missing.flyavatar does not exist");
    fs::write(folder.path().join("broken.flyavatar"), b"nothing").unwrap();
    refused(&["broken.flyavatar", "--out", "x"], "broken.flyavatar");
}

#[test]
fn depth_images_pull_the_surface_and_wrong_ones_are_named() {
    let data = write_dataset_with_truth(1, 4).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let take = data.root.to_string_lossy().into_owned();
    let with = |depth: &Path, more: &[&str]| {
        let depth = depth.to_string_lossy().into_owned();
        let inputs = ["mesh", &take, "--inputs", "00,02,04", "--gaussians", "4000", "--out", "m", "--depth", &depth];
        run(PROGRAM, &[&inputs[..], &GIVEN, &SMALL, more].concat(), folder.path()).unwrap()
    };
    let refused = |depth: &Path, more: &[&str], text: &str| {
        let failed = with(depth, more);
        assert_eq!(failed.code, Some(1), "{failed:?}");
        assert!(failed.stderr.contains(text), "{}", failed.stderr);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "a file is left");
    };
    let truth = data.root.join("truth");
    refused(&truth, &["--steps", "0"], "--steps 0 fits nothing, and --depth is for the fit");
    refused(&data.root.join("truth/surface"), &[], "has no folder of an input camera (00, 02, 04)");
    let short = data.root.join("short");
    fs::create_dir_all(short.join("02")).unwrap();
    refused(&short, &["--steps", "5"], "no depth image shows the person");
    fs::write(short.join("02/000001.exr"), b"nothing").unwrap();
    refused(&short, &["--steps", "5"], "000001.exr is no depth image: it is damaged or cut off");

    let made = with(&truth, &["--steps", "60"]);
    assert_eq!(made.code, Some(0), "{made:?}");
    assert!(made.stdout.contains("depth images show the person in 12 of 12 images"), "{}", made.stdout);
    let metrics: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.path().join("m/metrics.json")).unwrap()).unwrap();
    let [first, last] = ["first", "last"].map(|name| number(&metrics["depth_images_mm"], name));
    assert!(last > 0.0 && last < 0.8 * first, "{first} to {last} mm");
}

#[test]
fn absurd_sizes_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (option, value) in
        [("--voxel", "0"), ("--voxel", "nan"), ("--texture", "9"), ("--triangles", "1"), ("--gaussians", "3")]
    {
        let failed = run(PROGRAM, &["mesh", "a.flyavatar", "--out", "m", option, value], folder.path()).unwrap();
        assert_eq!(failed.code, Some(2), "{option} {value}: {failed:?}");
        assert!(failed.stderr.contains(option), "{}", failed.stderr);
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

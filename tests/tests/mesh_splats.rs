//! Meshes of splat files: another tool's Gaussians become a closed, textured mesh; unsupported input has one line of error and leaves
//! nothing behind.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::{fs, path::Path};

use flyrig_renderer::{AnisotropicSplats, HarmonicOrder, SH_DEGREE_0, write_anisotropic_ply};
use flyrig_tests::run;
use glam::{Quat, Vec3};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
const SMALL: [&str; 4] = ["--triangles", "4000", "--texture", "256"];
/// Half axes of an ellipsoid as tall as a child, metres.
const AXES: Vec3 = Vec3::new(0.2, 0.6, 0.15);

/// Writes flat Gaussians on ellipsoids around these places, in units of `unit` metres.
fn write(path: &Path, places: &[f32], count: usize, unit: f32) {
    let mut splats = AnisotropicSplats::empty(HarmonicOrder::Zero);
    for x in places {
        for i in 0..count {
            let y = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
            let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
            let place = Vec3::new((1.0 - y * y).sqrt() * cos, y, (1.0 - y * y).sqrt() * sin) * AXES;
            let normal = (place / (AXES * AXES)).normalize();
            splats.center.push(((place + Vec3::X * *x) / unit).extend(0.0).to_array());
            splats.scale_opacity.push([0.015 / unit, 0.015 / unit, 0.001 / unit, 0.95]);
            splats.rotation.push(Quat::from_rotation_arc(Vec3::Z, normal).to_array());
            splats.harmonics.push([0.5 / SH_DEGREE_0, 0.1 / SH_DEGREE_0, 0.1 / SH_DEGREE_0, 0.0]);
        }
    }
    write_anisotropic_ply(path, &splats).unwrap();
}

/// Overwrites the first property of some rows by NaN.
fn poison(path: &Path, rows: &[usize]) {
    let mut bytes = fs::read(path).unwrap();
    let start = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    for row in rows {
        let at = start + row * 17 * 4;
        bytes[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    }
    fs::write(path, bytes).unwrap();
}

#[test]
fn a_splat_file_becomes_a_closed_mesh_and_faults_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mesh = |args: &[&str]| run(PROGRAM, &[&["mesh"], args, &SMALL].concat(), folder.path()).unwrap();
    write(&at("a.ply"), &[0.0], 4000, 1.0);
    poison(&at("a.ply"), &[3, 500, 3999]);
    let made = mesh(&["a.ply", "--out", "m"]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let metrics: serde_json::Value = serde_json::from_slice(&fs::read(at("m/metrics.json")).unwrap()).unwrap();
    let expected: [(&str, serde_json::Value); 3] =
        [("closed_manifold", true.into()), ("components", 1.into()), ("rows_left_out", 3.into())];
    for (name, value) in expected {
        assert_eq!(metrics[name], value, "{metrics}");
    }
    assert_eq!((&metrics["gaussians"], &metrics["filter"]), (&3997.into(), &"mip".into()), "{metrics}");
    for name in ["mesh.glb", "mesh.obj", "mesh.mtl", "mesh.png", "mesh.usdz", "mesh.3mf", "surface/000000.ply"] {
        assert!(fs::metadata(at("m").join(name)).unwrap().len() > 60, "{name}");
    }
    let tall = |folder: &str| {
        let text = fs::read_to_string(at(folder).join("mesh.obj")).unwrap();
        let rows = text.lines().filter_map(|line| line.strip_prefix("v "));
        let y: Vec<f32> = rows.map(|row| row.split(' ').nth(1).unwrap().parse().unwrap()).collect();
        y.iter().copied().fold(f32::MIN, f32::max) - y.iter().copied().fold(f32::MAX, f32::min)
    };
    // Discs on the ellipsoid draw a surface outside of it; their planes stand out where it bends most.
    let metres = |name: &str| 1e-3 * metrics[name].as_f64().unwrap() as f32;
    let (drawn, voxel) = (2.0 * metres("drawn_beyond_mm"), metres("voxel_mm"));
    assert!(drawn < 0.02 && (tall("m") - 1.2 - drawn).abs() < voxel, "{} m, {drawn} m drawn", tall("m"));

    // The same mesh from millimetres, and with another axis upwards.
    write(&at("mm.ply"), &[0.0], 4000, 0.001);
    let made = mesh(&["mm.ply", "--unit", "mm", "--up", "-z", "--out", "turned"]);
    assert_eq!(made.code, Some(0), "{made:?}");
    assert!((tall("turned") - 0.3 - drawn).abs() < voxel, "{} m", tall("turned"));

    write(&at("ten.ply"), &[0.0], 10, 1.0);
    write(&at("two.ply"), &[0.0, 1.0], 2000, 1.0);
    fs::write(at("a.spz"), b"packed").unwrap();
    let whole = fs::read(at("a.ply")).unwrap();
    fs::write(at("cut.ply"), &whole[..whole.len() - 5]).unwrap();
    let text = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
                property float z\nend_header\n";
    fs::write(at("surface.ply"), [text.as_bytes(), &[0; 12]].concat()).unwrap();
    let absurd = text.replace("vertex 1", "vertex 18446744073709551615");
    fs::write(at("absurd.ply"), absurd.replace("float z", "float z\nproperty double q")).unwrap();
    let refused = |args: &[&str], text: &str| {
        let before = fs::read_dir(folder.path()).unwrap().count();
        let failed = mesh(&[args, &["--out", "x"]].concat());
        assert_eq!(failed.code, Some(1), "{failed:?}");
        assert!(failed.stderr.contains(text), "{}", failed.stderr);
        let errors = failed.stderr.lines().filter(|line| !line.starts_with("mesh: opening")).count();
        assert_eq!(errors, 1, "{}", failed.stderr);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), before, "{args:?} left a file");
    };
    refused(&["ten.ply"], "10 Gaussians; at least 1000 are needed");
    refused(&["mm.ply"], "m tall; give --unit mm");
    refused(&["a.ply", "--unit", "mm"], "m tall; give --unit m");
    refused(&["two.ply"], "2 separate bodies");
    refused(&["a.spz"], "splat-transform a.spz a.ply");
    refused(&["cut.ply"], "the file is cut off");
    refused(&["surface.ply"], "it does not hold Gaussians");
    refused(&["absurd.ply"], "it does not hold Gaussians");
    refused(&["none.ply"], "cannot read none.ply");
    refused(&["a.ply", "--inputs", "00", "--sequence"], "leave out --inputs and --sequence");
    refused(&["a.ply", "--steps", "7"], "leave out --steps");
    refused(&["take", "--unit", "mm"], "leave out --unit and --up");
}

/// Limits on the size of files stand for a full disk: the system refuses the same writes.
#[cfg(unix)]
#[test]
fn a_full_disk_is_named_and_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    write(&folder.path().join("a.ply"), &[0.0], 3000, 1.0);
    // Blocks of 512 or 1024 bytes, as the shell counts.
    for (blocks, name) in [(80, "surface/000000.ply"), (300, "mesh.obj")] {
        let script =
            format!("trap '' XFSZ; ulimit -f {blocks}; exec '{PROGRAM}' mesh a.ply --out full {}", SMALL.join(" "));
        let failed = run("sh", &["-c", &script], folder.path()).unwrap();
        assert_eq!(failed.code, Some(1), "{name}: {failed:?}");
        let errors: Vec<&str> = failed.stderr.lines().filter(|line| !line.starts_with("mesh: opening")).collect();
        assert!(errors.len() == 1 && errors[0].contains(name), "{name}: {}", failed.stderr);
        assert!(errors[0].contains("File too large"), "{}", failed.stderr);
        let left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(left, ["a.ply"], "{name}");
    }
}

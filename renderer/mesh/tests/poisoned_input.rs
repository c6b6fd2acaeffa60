//! Malformed points and settings are errors or counted rows, never a panic or a huge allocation.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_mesh::{
    Fusion, FusionSettings, MeshError, MeshOptions, OrientedPoint, OrientedPoints, fuse, mesh_from_points,
};
use glam::Vec3;
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};
use support::{row, sphere};

fn run(rows: Vec<OrientedPoint>, options: &MeshOptions) -> Result<usize, MeshError> {
    mesh_from_points(OrientedPoints::from_rows(rows), options).map(|(mesh, _)| mesh.triangles.len())
}

#[test]
fn too_few_points_are_an_error() {
    let options = MeshOptions::default();
    for count in [0, 1, 10, 999] {
        let error = run(sphere(count, Vec3::ZERO, 0.3), &options).unwrap_err();
        assert_eq!(error, MeshError::TooFewPoints { count, needed: 1000 });
        assert_eq!(error.to_string(), format!("{count} Gaussians; at least 1000 are needed"));
    }
    let same = vec![row(Vec3::ONE, Vec3::X); 3000];
    assert_eq!(run(same, &options).unwrap_err(), MeshError::Coincident { count: 3000 });
}

#[test]
fn malformed_rows_are_dropped() {
    let mut rows = sphere(5000, Vec3::ZERO, 0.3);
    let good = rows[0];
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        rows.push(OrientedPoint { position: Vec3::new(value, 0.0, 0.0), ..good });
        rows.push(OrientedPoint { normal: Vec3::new(0.0, value, 0.0), ..good });
        rows.push(OrientedPoint { weight: value, ..good });
        rows.push(OrientedPoint { uncertainty_m: value, ..good });
    }
    rows.push(OrientedPoint { normal: Vec3::ZERO, ..good });
    rows.push(OrientedPoint { weight: 0.0, ..good });
    rows.push(OrientedPoint { position: Vec3::splat(1e30), ..good });
    let (_, report) = mesh_from_points(OrientedPoints::from_rows(rows), &MeshOptions::default()).unwrap();
    assert_eq!((report.points, report.dropped.total()), (5000, 15));
}

#[test]
fn weights_of_any_size_work() {
    let mut rows = sphere(5000, Vec3::ZERO, 0.3);
    for (i, row) in rows.iter_mut().enumerate() {
        row.weight = [1e-38, 1e38, 1.0][i % 3];
    }
    assert!(run(rows, &MeshOptions::default()).unwrap() > 1000);
}

#[test]
fn impossible_voxels_are_errors() {
    let rows = sphere(5000, Vec3::ZERO, 0.3);
    for voxel_m in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-9, 1e9] {
        let options = MeshOptions { voxel_m: Some(voxel_m), ..MeshOptions::default() };
        assert!(matches!(run(rows.clone(), &options), Err(MeshError::Setting { .. })), "{voxel_m}");
    }
    // Valid by itself, too fine for this extent.
    let tall = sphere(5000, Vec3::ZERO, 40.0);
    let points = OrientedPoints::from_rows(tall);
    let settings = FusionSettings::from_points(&points).unwrap();
    let fine = FusionSettings { voxel_m: 0.01, truncation_m: 0.03, decay_m: 0.01, ..settings };
    let error = fuse(&points, &fine, Fusion::Hgm).unwrap_err();
    assert!(matches!(error, MeshError::Extent { .. }), "{error}");
    let text = error.to_string();
    assert!(text.starts_with("voxels of 0.01 m over 80.") && text.contains("use larger voxels"), "{text}");
    // A voxel as large as the body leaves little, but fails cleanly.
    let _ = run(sphere(5000, Vec3::ZERO, 0.3), &MeshOptions { voxel_m: Some(0.9), ..MeshOptions::default() });
}

#[test]
fn huge_coordinates_are_errors() {
    for scale in [1e10, 1e30, 3e38] {
        let mut random = StdRng::seed_from_u64(8);
        let rows = (0..2000).map(|_| row((Vec3::from_array(random.random::<[f32; 3]>()) - 0.5) * scale, Vec3::X));
        let result = run(rows.collect(), &MeshOptions::default());
        assert!(result.is_err(), "{scale}");
    }
    let points = OrientedPoints::from_rows([row(Vec3::splat(1e30), Vec3::X), row(Vec3::splat(-3e38), Vec3::X)]);
    let settings = FusionSettings {
        voxel_m: 0.01,
        truncation_m: 0.03,
        angle_rad: 1.0,
        decay_m: 0.01,
        spacing_m: 0.005,
        uncertainty_m: 0.001,
    };
    assert!(matches!(fuse(&points, &settings, Fusion::Hgm), Err(MeshError::Extent { .. })));
    let none = OrientedPoints::default();
    assert!(matches!(fuse(&none, &settings, Fusion::Hgm), Err(MeshError::TooFewPoints { .. })));
    assert!(FusionSettings::from_points(&none).is_err());
}

#[test]
fn random_soup_ends_in_a_closed_mesh_or_an_error() {
    for seed in 0..6 {
        let mut random = StdRng::seed_from_u64(seed);
        let rows = (0..3000).map(|_| {
            let mut vector = || Vec3::from_array(random.random::<[f32; 3]>()) - 0.5;
            row(vector() * 0.5, vector())
        });
        let points = OrientedPoints::from_rows(rows.collect::<Vec<_>>());
        for fusion in [Fusion::Hgm, Fusion::Naive] {
            let options = MeshOptions { fusion, bodies: 1000, voxel_m: Some(0.02), ..MeshOptions::default() };
            match mesh_from_points(points.clone(), &options) {
                Ok((_, report)) => assert!(report.topology.is_closed_manifold(), "{seed} {report:?}"),
                Err(error) => assert_eq!(error, MeshError::NoSurface),
            }
        }
    }
}

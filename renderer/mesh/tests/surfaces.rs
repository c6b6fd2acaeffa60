//! Meshes of analytic surfaces: accuracy, separation, noise, holes, carving.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_mesh::{
    Evidence, Fusion, FusionSettings, MeshError, MeshOptions, MeshReport, OrientedPoint, OrientedPoints, TriMesh, fuse,
    mesh_from_points,
};
use glam::Vec3;
use support::{add_noise, mean_abs, row, sphere, torus};

fn mesh(rows: Vec<OrientedPoint>, options: &MeshOptions) -> (TriMesh, MeshReport) {
    let (mesh, report) = mesh_from_points(OrientedPoints::from_rows(rows), options).unwrap();
    assert!(report.topology.is_closed_manifold(), "{report:?}");
    assert_eq!((report.topology.degenerate_triangles, report.topology.components), (0, 1), "{report:?}");
    assert!(report.topology.volume_m3 > 0.0, "{report:?}");
    (mesh, report)
}

fn voxel(voxel_m: f32) -> MeshOptions<'static> {
    MeshOptions { voxel_m: Some(voxel_m), ..MeshOptions::default() }
}

#[test]
fn spheres_are_accurate_at_any_voxel_size() {
    // Points 4.7 mm apart.
    for (voxel_m, bound) in [(0.005, 0.0005), (0.01, 0.0007), (0.02, 0.0015)] {
        let (mesh, report) = mesh(sphere(50_000, Vec3::new(0.1, 1.0, 0.0), 0.3), &voxel(voxel_m));
        let error = mean_abs(mesh.positions.iter().map(|place| place.distance(Vec3::new(0.1, 1.0, 0.0)) - 0.3));
        assert!(error < bound, "{voxel_m}: {error} {:?}", report.settings);
        assert_eq!((report.topology.genus(), report.topology.self_intersections), (Some(0), 0));
        assert!(report.hole_share < 1e-3 && report.removed.volumes_m3.is_empty(), "{report:?}");
    }
}

#[test]
fn a_torus_has_one_handle() {
    let (mesh, report) = mesh(torus(60_000, 0.3, 0.1), &voxel(0.008));
    assert_eq!(report.topology.genus(), Some(1));
    let error = mean_abs(mesh.positions.iter().map(|place| {
        let ring = Vec3::new(place.x, place.y, 0.0).length() - 0.3;
        Vec3::new(ring, 0.0, place.z).length() - 0.1
    }));
    assert!(error < 0.0008, "{error}");
}

#[test]
fn noise_averages_out() {
    let mut rows = sphere(90_000, Vec3::ZERO, 0.2);
    add_noise(&mut rows, 0.003, 6);
    let (mesh, report) = mesh(rows, &voxel(0.006));
    let error = mean_abs(mesh.positions.iter().map(|place| place.length() - 0.2));
    assert!(error < 0.0007, "{error} {:?}", report.settings);
    assert_eq!(report.topology.genus(), Some(0));
}

/// Two plates 12 mm apart that face each other, as the sides of a hand and a hip.
fn facing_plates() -> Vec<OrientedPoint> {
    let place = |i: usize| Vec3::new((i % 100) as f32, (i / 100) as f32, 0.0) * 0.003;
    let low = (0..10_000).map(|i| row(place(i), Vec3::Z));
    let high = (0..10_000).map(|i| row(place(i) + Vec3::new(0.001, 0.001, 0.012), -Vec3::Z));
    low.chain(high).collect()
}

#[test]
fn facing_surfaces_stay_separate() {
    let points = OrientedPoints::from_rows(facing_plates());
    let settings = FusionSettings::from_points(&points).unwrap().with_voxel(0.006);
    let error = |fusion: Fusion| {
        let field = fuse(&points, &settings, fusion).unwrap();
        let inner = field.voxels().filter(|voxel| {
            let place = voxel.center;
            (0.03..0.27).contains(&place.x) && (0.03..0.27).contains(&place.y) && (-0.005..0.017).contains(&place.z)
        });
        mean_abs(inner.map(|voxel| {
            assert_eq!(voxel.evidence, Evidence::Points);
            voxel.distance_m - voxel.center.z.min(0.012 - voxel.center.z)
        }))
    };
    let (hgm, naive) = (error(Fusion::Hgm), error(Fusion::Naive));
    assert!(hgm < 0.0003 && naive > 0.002, "{hgm} {naive}");
}

#[test]
fn two_boxes_12_mm_apart_are_two_bodies() {
    let slab = |low: f32, high: f32| {
        let plate = |z: f32, normal: Vec3| {
            (0..10_000).map(move |i| row(Vec3::new((i % 100) as f32 * 0.003, (i / 100) as f32 * 0.003, z), normal))
        };
        let wall = move |at: usize, side: f32| {
            let rows = ((high - low) / 0.003) as usize;
            (0..rows * 100).map(move |i| {
                let mut place = Vec3::new(0.0, 0.0, low + (i / 100) as f32 * 0.003);
                let mut normal = Vec3::ZERO;
                place[1 - at] = (i % 100) as f32 * 0.003;
                place[at] = if side > 0.0 { 0.299 } else { -0.002 };
                normal[at] = side;
                row(place, normal)
            })
        };
        plate(low, -Vec3::Z)
            .chain(plate(high, Vec3::Z))
            .chain(wall(0, -1.0))
            .chain(wall(0, 1.0))
            .chain(wall(1, -1.0))
            .chain(wall(1, 1.0))
            .collect::<Vec<_>>()
    };
    let rows = [slab(-0.1, 0.0), slab(0.012, 0.112)].concat();
    let points = OrientedPoints::from_rows(rows);
    let error = mesh_from_points(points.clone(), &voxel(0.006)).unwrap_err();
    assert_eq!(error, MeshError::SeveralBodies { count: 2 });
    let (mesh, report) = mesh_from_points(points, &MeshOptions { bodies: 2, ..voxel(0.006) }).unwrap();
    assert_eq!((report.topology.components, report.topology.genus()), (2, Some(0)));
    let between: Vec<_> = mesh.positions.iter().filter(|place| (0.002..0.01).contains(&place.z)).collect();
    assert!(between.is_empty(), "{between:?}");
}

#[test]
fn holes_are_closed_and_reported() {
    let all = sphere(40_000, Vec3::ZERO, 0.3);
    for hole_m in [0.03, 0.08] {
        let rows = all.iter().filter(|row| row.position.distance(Vec3::Y * -0.3) > hole_m).copied().collect();
        let (mesh, report) = mesh(rows, &voxel(0.008));
        assert_eq!(report.topology.genus(), Some(0));
        assert!(report.topology.self_intersections < 5, "{report:?}");
        let expected = std::f64::consts::PI * f64::from(hole_m).powi(2);
        let ratio = report.hole_area_m2 / expected;
        assert!((0.2..1.3).contains(&ratio), "{ratio}");
        assert!((report.hole_share * report.topology.area_m2 / report.hole_area_m2 - 1.0).abs() < 1e-9);
        // The cover lies between the sphere and the plane through the rim.
        let depth = 0.3 - (0.3f32 * 0.3 - hole_m * hole_m).sqrt();
        for (place, closes) in mesh.positions.iter().zip(&mesh.from_hole) {
            if *closes {
                assert!(place.length() < 0.303 && place.y < -0.3 + depth + 0.012, "{place}");
            }
        }
    }
}

#[test]
fn open_soles_are_closed_by_a_nearly_flat_surface() {
    // A leg without a sole: a cylinder of 12 cm, closed above by half a sphere.
    let wall = (0..40_000).map(|i| {
        let (sin, cos) = (i as f32 * 2.399_963_1).sin_cos();
        row(Vec3::new(cos * 0.06, i as f32 * 1e-5, sin * 0.06), Vec3::new(cos, 0.0, sin))
    });
    let top = sphere(12_000, Vec3::Y * 0.4, 0.06).into_iter().filter(|row| row.normal.y > 0.0);
    let (mesh, report) = mesh(wall.chain(top).collect(), &voxel(0.006));
    assert_eq!(report.topology.genus(), Some(0));
    let lowest = mesh.positions.iter().map(|place| place.y).fold(f32::MAX, f32::min);
    let middle =
        mesh.positions.iter().filter(|place| place.y < 0.2 && Vec3::new(place.x, 0.0, place.z).length() < 0.03);
    let (low, high) = middle.fold((f32::MAX, f32::MIN), |(low, high), place| (low.min(place.y), high.max(place.y)));
    assert!(lowest > -0.015 && low > -0.01 && high < 0.02, "{lowest} {low} {high}");
}

#[test]
fn thin_shells_of_points_are_filled() {
    let (mesh, report) = mesh(sphere(30_000, Vec3::ZERO, 0.2), &voxel(0.005));
    assert!(mesh.positions.iter().all(|place| place.length() > 0.197));
    assert!(report.removed.volumes_m3.is_empty());
    assert!(report.skipped_blocks > 10 && report.signed_voxels > 0);
}

/// Blocks without points are skipped; the mesh is that of a field with all of them, byte by byte.
#[test]
fn skipped_blocks_change_nothing() {
    let rows = [sphere(20_000, Vec3::ZERO, 0.2), torus(20_000, 0.3, 0.05)].concat();
    for voxel_m in [0.006, 0.012] {
        let run = |dense| {
            let points = OrientedPoints::from_rows(rows.clone());
            mesh_from_points(points, &MeshOptions { dense, bodies: 2, ..voxel(voxel_m) }).unwrap()
        };
        let ((sparse, skipping), (all, report)) = (run(false), run(true));
        assert_eq!(sparse, all);
        assert!(skipping.skipped_blocks > report.blocks / 3, "{skipping:?}");
        assert_eq!((report.skipped_blocks, report.blocks), (0, skipping.blocks + skipping.skipped_blocks));
    }
}

#[test]
fn floaters_and_distant_points_are_removed() {
    let mut rows = sphere(50_000, Vec3::ZERO, 0.3);
    rows.extend(sphere(300, Vec3::new(0.5, 0.0, 0.0), 0.02));
    rows.push(row(Vec3::splat(1e30), Vec3::X));
    let (mesh, report) = mesh(rows, &voxel(0.008));
    assert!(mesh.positions.iter().all(|place| place.length() < 0.31));
    assert_eq!((report.removed.volumes_m3.len(), report.dropped.distant), (1, 1), "{report:?}");
}

#[test]
fn carving_removes_a_bump_with_a_smooth_cut() {
    let mut rows = sphere(50_000, Vec3::ZERO, 0.3);
    rows.retain(|row| row.position.distance(Vec3::X * 0.3) > 0.1);
    rows.extend(sphere(10_000, Vec3::X * 0.3, 0.1).into_iter().filter(|row| row.position.length() > 0.3));
    let (bumpy, _) = mesh(rows.clone(), &voxel(0.008));
    assert!(bumpy.positions.iter().any(|place| place.x > 0.39));
    let limit = |place: Vec3| place.x * 0.96 + place.y * 0.28;
    let empty = |place: Vec3| limit(place) > 0.25;
    let (carved, report) = mesh(rows, &MeshOptions { empty: Some(&empty), ..voxel(0.008) });
    assert!(report.emptied_voxels > 100);
    assert!(carved.positions.iter().all(|place| limit(*place) < 0.2505));
    // The cut is a plane, well below the size of a voxel.
    let cut =
        carved.positions.iter().filter(|place| Vec3::new(0.0, place.y - 0.07, place.z).length() < 0.1 && place.x > 0.0);
    let error = mean_abs(cut.map(|place| limit(*place) - 0.25));
    assert!(error < 0.0004, "{error}");
    assert_eq!(report.topology.genus(), Some(0));
}

#[test]
fn carving_reaches_interiors_that_are_not_stored() {
    let empty = |place: Vec3| Vec3::new(place.x, place.y, 0.0).length() < 0.1;
    let (drilled, report) = mesh(sphere(50_000, Vec3::ZERO, 0.3), &MeshOptions { empty: Some(&empty), ..voxel(0.008) });
    assert_eq!(report.topology.genus(), Some(1));
    assert!(drilled.positions.iter().all(|place| Vec3::new(place.x, place.y, 0.0).length() > 0.099));
    let all = |_: Vec3| true;
    let nothing = mesh_from_points(
        OrientedPoints::from_rows(sphere(2000, Vec3::ZERO, 0.3)),
        &MeshOptions { empty: Some(&all), ..MeshOptions::default() },
    );
    assert_eq!(nothing.unwrap_err(), MeshError::NoSurface);
}

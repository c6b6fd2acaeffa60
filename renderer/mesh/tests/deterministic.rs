//! The mesh does not depend on the number of threads.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_mesh::{MeshOptions, OrientedPoints, TriMesh, mesh_from_points};
use glam::Vec3;

fn with_threads(threads: usize) -> TriMesh {
    let mut rows = support::sphere(40_000, Vec3::ZERO, 0.3);
    support::add_noise(&mut rows, 0.003, 2);
    rows.retain(|row| row.position.distance(Vec3::Y * -0.3) > 0.05);
    let empty = |place: Vec3| place.x + 0.3 * place.z > 0.28;
    let options = MeshOptions { voxel_m: Some(0.008), empty: Some(&empty), ..MeshOptions::default() };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| mesh_from_points(OrientedPoints::from_rows(rows), &options).unwrap().0)
}

#[test]
fn one_and_four_threads_give_equal_bytes() {
    let (one, four) = (with_threads(1), with_threads(4));
    let bits = |mesh: &TriMesh| -> Vec<[u32; 3]> {
        mesh.positions.iter().map(|position| position.to_array().map(f32::to_bits)).collect()
    };
    assert!(bits(&one) == bits(&four) && one.triangles == four.triangles && one.from_hole == four.from_hole);
    assert!(one.triangles.len() > 10_000 && one.from_hole.contains(&true));
}

//! Simplification of a mesh to a number of triangles.

use glam::Vec3;
use rayon::prelude::*;

use crate::finish::collapse::collapse;
use crate::nearest::Surface;
use crate::{MeshFault, TriMesh};

/// Vertices that the simplification can address.
const MAX_VERTICES: usize = 1 << 28;

/// Reason why a mesh cannot be simplified.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecimateError {
    /// The mesh is faulty.
    #[error(transparent)]
    Mesh(#[from] MeshFault),
    /// The mesh has too many vertices.
    #[error("{0} vertices are too many; simplify parts of at most {MAX_VERTICES}")]
    TooLarge(usize),
}

/// Simplified mesh and its distance from the original.
#[derive(Debug, Clone, PartialEq)]
pub struct Decimated {
    /// Simplified mesh; it has more triangles than the target where the topology requires them.
    pub mesh: TriMesh,
    /// Index of the original vertex of each vertex.
    pub source: Vec<u32>,
    /// Largest distance between both surfaces, metres: from original vertices and from new triangles' centres.
    pub max_distance_m: f32,
    /// Mean distance of original vertices from the new surface, metres.
    pub mean_distance_m: f32,
}

/// Simplifies a mesh to about `target` triangles without making its topology worse: closed manifold meshes stay closed,
/// manifold, oriented, in as many parts and with as many handles. Returns the mesh unchanged when it has no more than
/// `target` triangles, and with more triangles than `target` where fewer would break it. Equal input gives equal output.
///
/// # Errors
/// [`DecimateError`] for a faulty mesh and for one with more than 2^28 vertices.
pub fn decimate(mesh: &TriMesh, target: usize) -> Result<Decimated, DecimateError> {
    MeshFault::check(mesh)?;
    if mesh.positions.len() > MAX_VERTICES {
        return Err(DecimateError::TooLarge(mesh.positions.len()));
    }
    let is_small = mesh.triangles.len() <= target;
    let triangles = if is_small { mesh.triangles.clone() } else { collapse(&mesh.positions, &mesh.triangles, target) };
    let mut index = vec![u32::MAX; mesh.positions.len()];
    triangles.as_flattened().iter().for_each(|i| index[*i as usize] = 0);
    let source: Vec<u32> = (0u32..).zip(&index).filter(|(_, used)| **used == 0).map(|(i, _)| i).collect();
    for (new, old) in (0u32..).zip(&source) {
        index[*old as usize] = new;
    }
    let simple = TriMesh {
        positions: source.iter().map(|i| mesh.positions[*i as usize]).collect(),
        triangles: triangles.iter().map(|t| t.map(|i| index[i as usize])).collect(),
        from_hole: source.iter().filter_map(|i| mesh.from_hole.get(*i as usize).copied()).collect(),
    };
    let (max_distance_m, mean_distance_m) = if is_small { (0.0, 0.0) } else { distances(mesh, &simple) };
    Ok(Decimated { mesh: simple, source, max_distance_m, mean_distance_m })
}

/// Returns the largest distance of both surfaces, and the mean one of original vertices in use, metres.
fn distances(mesh: &TriMesh, simple: &TriMesh) -> (f32, f32) {
    let mut is_used = vec![false; mesh.positions.len()];
    mesh.triangles.as_flattened().iter().for_each(|i| is_used[*i as usize] = true);
    let used: Vec<Vec3> = mesh.positions.iter().zip(is_used).filter(|(_, used)| *used).map(|(p, _)| *p).collect();
    let centers: Vec<Vec3> =
        simple.triangles.iter().map(|t| t.iter().map(|i| simple.positions[*i as usize] / 3.0).sum()).collect();
    let measure = |points: &[Vec3], surface: &Surface| -> Vec<f32> {
        points.par_iter().with_min_len(256).map(|p| surface.distance_m(*p)).collect()
    };
    let there = measure(&used, &Surface::new(simple));
    let back = measure(&centers, &Surface::new(mesh));
    let mean = there.iter().map(|d| f64::from(*d)).sum::<f64>() / there.len().max(1) as f64;
    (there.into_iter().chain(back).fold(0.0, f32::max), mean as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Connectivity, shapes};

    fn with_flags(mut mesh: TriMesh) -> TriMesh {
        mesh.from_hole = mesh.positions.iter().map(|p| p.x > 0.2).collect();
        mesh
    }

    #[test]
    fn closed_shapes_stay_closed_and_near() {
        for (mesh, targets) in [
            (shapes::bumpy_sphere(40), [(16_000, 2e-3), (4_000, 8e-3), (200, 0.05)]),
            (shapes::two_tori(300, 60), [(36_000, 2e-3), (4_000, 8e-3), (600, 0.05)]),
        ] {
            let mesh = with_flags(mesh);
            let before = Connectivity::new(&mesh.triangles);
            for (target, limit) in targets {
                let simple = decimate(&mesh, target).unwrap();
                let topology = Connectivity::new(&simple.mesh.triangles);
                let reached = simple.mesh.triangles.len();
                assert!(topology.is_closed_manifold() && topology.euler == before.euler, "{topology:?}");
                assert!(reached <= target && reached + 8 > target, "{reached}");
                assert!(simple.max_distance_m < limit && simple.mean_distance_m < 0.4 * simple.max_distance_m);
                assert!(shapes::volume(&simple.mesh) > 0.8 * shapes::volume(&mesh));
                for (i, old) in simple.source.iter().enumerate() {
                    assert_eq!(simple.mesh.positions[i], mesh.positions[*old as usize]);
                    assert_eq!(simple.mesh.from_hole[i], mesh.from_hole[*old as usize]);
                }
                assert_eq!(simple, decimate(&mesh, target).unwrap());
            }
        }
    }

    /// A target below the least closed surface ends at a surface that still has its handles.
    #[test]
    fn absurd_targets_do_not_break_the_surface() {
        for mesh in [shapes::bumpy_sphere(12), shapes::two_tori(40, 8)] {
            let before = Connectivity::new(&mesh.triangles);
            for target in [0, 1, 4, 14, 28, 60] {
                let simple = decimate(&mesh, target).unwrap();
                assert!(Connectivity::new(&simple.mesh.triangles).is_no_worse_than(&before), "{target}");
                assert!(simple.mesh.triangles.len() < mesh.triangles.len(), "{target}");
            }
        }
    }

    /// Tori of a few millimetres with as much noise, whose collapses fold and pinch.
    #[test]
    fn thin_noisy_shapes_reach_their_targets() {
        let mut mesh = shapes::two_tori(300, 60);
        for (i, p) in mesh.positions.iter_mut().enumerate() {
            let noise = |k: usize| ((12.9898 * i as f32 + 78.233 * k as f32).sin() * 43758.547).fract();
            *p = Vec3::new(p.x, p.y, 0.02 * p.z) + 0.004 * Vec3::new(noise(1), noise(2), noise(3));
        }
        let before = Connectivity::new(&mesh.triangles);
        for target in [36_000, 12_000, 2_000] {
            let simple = decimate(&mesh, target).unwrap();
            let after = Connectivity::new(&simple.mesh.triangles);
            let reached = simple.mesh.triangles.len();
            assert!(after.is_closed_manifold() && after.is_no_worse_than(&before), "{target}: {after:?}");
            assert!(reached <= target && reached * 100 >= target * 95, "{target} -> {reached}");
        }
    }

    #[test]
    fn open_meshes_do_not_get_more_defects() {
        let mut mesh = shapes::bumpy_sphere(20);
        mesh.triangles.retain(|t| mesh.positions[t[0] as usize].y < 1.1);
        let simple = decimate(&mesh, 1000).unwrap();
        assert!(simple.mesh.triangles.len() <= 1000);
        let after = Connectivity::new(&simple.mesh.triangles);
        assert!(after.is_no_worse_than(&Connectivity::new(&mesh.triangles)), "{after:?}");
    }

    #[test]
    fn small_meshes_are_unchanged_and_faulty_ones_refused() {
        let mesh = shapes::bumpy_sphere(4);
        let same = decimate(&mesh, 320).unwrap();
        assert_eq!((&same.mesh, same.max_distance_m.to_bits()), (&mesh, 0));
        assert!(decimate(&TriMesh::default(), 0).unwrap().mesh.triangles.is_empty());
        let count = mesh.positions.len();
        let message = |change: fn(&mut TriMesh)| {
            let mut mesh = shapes::bumpy_sphere(4);
            change(&mut mesh);
            decimate(&mesh, 100).unwrap_err()
        };
        assert_eq!(message(|m| m.positions[3].y = f32::NAN), MeshFault::NotFinite(3).into());
        assert_eq!(message(|m| m.triangles[3][2] = 9999), MeshFault::Index { index: 9999, count }.into());
        assert_eq!(message(|m| m.from_hole = vec![true]), MeshFault::Flags { count, flags: 1 }.into());
    }
}

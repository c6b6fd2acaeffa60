//! Even triangles on a given surface.

use glam::Vec3;
use rayon::prelude::*;

use super::around::triangles_around;
use crate::TriMesh;
use crate::nearest::Surface;

/// Rounds of moves, and the share of the way to the middle of its neighbours that a vertex goes in each.
const ROUNDS: usize = 5;
const SHARE: f32 = 0.5;
/// Largest distance between a moved vertex and the surface, in its ways from its neighbours: beyond, it would jump onto another part.
const REACH: f32 = 0.5;

/// Moves the vertices of a simplified mesh along its surface towards the middle of their neighbours and back onto the nearest place of
/// `original`: triangles become even, and nothing shrinks. Triangles stay, and so do vertices that would turn one of them over. Equal input
/// gives equal output. Indices must be in range.
pub(crate) fn relax(mesh: &mut TriMesh, original: &TriMesh) {
    if original.triangles.is_empty() {
        return;
    }
    let surface = Surface::new(original);
    let neighbors = neighbors(mesh);
    let around = triangles_around(mesh.positions.len(), &mesh.triangles);
    for _ in 0..ROUNDS {
        let normals = mesh.normals();
        let moved: Vec<Vec3> = (0..mesh.positions.len())
            .into_par_iter()
            .with_min_len(256)
            .map(|i| target(mesh.positions[i], normals[i], &neighbors[i], mesh, &surface))
            .collect();
        // Moves that turn a triangle over are taken back, with those of its other corners; the rest cannot depend on their order.
        let turned: Vec<bool> = mesh.triangles.par_iter().map(|t| turns_over(*t, &mesh.positions, &moved)).collect();
        let keeps = |i: usize| around[i].iter().any(|t| turned[*t as usize]);
        let next: Vec<Vec3> =
            (0..moved.len()).into_par_iter().map(|i| if keeps(i) { mesh.positions[i] } else { moved[i] }).collect();
        mesh.positions = next;
    }
}

/// Returns where a vertex goes; its own place if that is not near the surface.
fn target(own: Vec3, normal: Vec3, neighbors: &[u32], mesh: &TriMesh, surface: &Surface) -> Vec3 {
    if neighbors.is_empty() {
        return own;
    }
    let count = neighbors.len() as f32;
    let way = neighbors.iter().map(|i| mesh.positions[*i as usize] - own).sum::<Vec3>() / count;
    let length = neighbors.iter().map(|i| mesh.positions[*i as usize].distance(own)).sum::<f32>() / count;
    let moved = own + (way - normal * normal.dot(way)) * SHARE;
    let nearest = surface.nearest(moved);
    if nearest.distance(moved) <= REACH * length { nearest } else { own }
}

/// Returns whether a triangle faces another way with its corners at other places.
fn turns_over(triangle: [u32; 3], before: &[Vec3], after: &[Vec3]) -> bool {
    let normal = |places: &[Vec3]| {
        let [a, b, c] = triangle.map(|i| places[i as usize]);
        (b - a).cross(c - a).normalize_or_zero()
    };
    normal(before).dot(normal(after)) < 0.5
}

/// Returns the neighbours of each vertex, ascending.
fn neighbors(mesh: &TriMesh) -> Vec<Vec<u32>> {
    let mut neighbors = vec![Vec::new(); mesh.positions.len()];
    for [a, b, c] in &mesh.triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            neighbors[*from as usize].push(*to);
            neighbors[*to as usize].push(*from);
        }
    }
    for row in &mut neighbors {
        row.sort_unstable();
        row.dedup();
    }
    neighbors
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{decimate, self_intersections, shapes};

    /// Returns the mean of heights over longest sides; 0.87 for equilateral triangles.
    fn evenness(mesh: &TriMesh) -> f32 {
        let slim = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
            let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
            (b - a).cross(c - a).length() / longest
        };
        mesh.triangles.iter().map(slim).sum::<f32>() / mesh.triangles.len() as f32
    }

    #[test]
    fn triangles_become_even_and_stay_on_the_surface() {
        for mesh in [shapes::bumpy_sphere(40), shapes::two_tori(200, 40)] {
            let simple = decimate(&mesh, mesh.triangles.len() / 5).unwrap().mesh;
            let (mut even, surface) = (simple.clone(), Surface::new(&mesh));
            relax(&mut even, &mesh);
            assert!(evenness(&even) > 1.03 * evenness(&simple), "{} {}", evenness(&simple), evenness(&even));
            assert!(even.positions.iter().all(|p| surface.distance_m(*p) < 1e-6));
            assert_eq!((&even.triangles, self_intersections(&even)), (&simple.triangles, 0));
            let volume = shapes::volume(&even) / shapes::volume(&simple);
            assert!((volume - 1.0).abs() < 0.01, "{volume}");
            let mut again = simple.clone();
            rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| relax(&mut again, &mesh));
            assert_eq!(even, again);
        }
    }

    #[test]
    fn vertices_far_from_the_surface_and_empty_meshes_stay() {
        let mesh = shapes::bumpy_sphere(8);
        let mut same = mesh.clone();
        relax(&mut same, &TriMesh::default());
        assert_eq!(same, mesh);
        let mut moved = mesh.clone();
        moved.positions.iter_mut().for_each(|p| *p += Vec3::X * 9.0);
        let before = moved.clone();
        relax(&mut moved, &mesh);
        assert_eq!(moved, before);
        let mut empty = TriMesh::default();
        relax(&mut empty, &mesh);
        assert_eq!(empty, TriMesh::default());
        let mut poisoned = mesh.clone();
        poisoned.positions[3] = Vec3::NAN;
        relax(&mut poisoned, &mesh);
        assert_eq!(poisoned.positions.iter().filter(|p| !p.is_finite()).count(), 1);
    }
}

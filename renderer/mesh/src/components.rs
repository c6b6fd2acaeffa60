//! Connected components of triangle meshes.

use crate::error::MeshError;
use crate::mesh::{TriMesh, signed_volume};
use crate::union_find::UnionFind;

/// Volume of a component, in volumes of the largest one, from which it counts as a body of its own.
const BODY: f64 = 0.3;

/// Components removed by [`keep_largest`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Removed {
    /// Signed volumes of the removed components by falling magnitude, cubic metres; negative for cavities.
    pub volumes_m3: Vec<f64>,
    /// Triangles of the removed components.
    pub triangles: usize,
}

impl Removed {
    /// Returns the number of removed cavities inside other components.
    #[must_use]
    pub fn cavities(&self) -> usize {
        self.volumes_m3.iter().filter(|volume| **volume < 0.0).count()
    }
}

/// Keeps the `bodies` components of the largest volume. Floaters and cavities are removed, which fills the latter, as are
/// triangles with vertices out of range.
///
/// # Errors
/// [`MeshError::NoSurface`] if no component encloses a volume, and [`MeshError::SeveralBodies`] if more than `bodies`
/// components have at least 0.3 of the largest volume.
pub fn keep_largest(mesh: &TriMesh, bodies: usize) -> Result<(TriMesh, Removed), MeshError> {
    let mut parts = UnionFind::new(mesh.positions.len());
    let valid = |triangle: &[u32; 3]| triangle.iter().all(|vertex| (*vertex as usize) < mesh.positions.len());
    let rows: Vec<usize> = (0..mesh.triangles.len()).filter(|i| valid(&mesh.triangles[*i])).collect();
    for [a, b, c] in rows.iter().map(|row| mesh.triangles[*row]) {
        parts.join(a as usize, b as usize);
        parts.join(a as usize, c as usize);
    }
    let mut volumes = vec![0.0; mesh.positions.len()];
    let roots: Vec<usize> = rows.iter().map(|row| parts.root(mesh.triangles[*row][0] as usize)).collect();
    for (row, root) in rows.iter().zip(&roots) {
        volumes[*root] += signed_volume(mesh.corners(*row));
    }
    // A volume that is no number is that of a poisoned vertex.
    volumes.iter_mut().filter(|volume| !volume.is_finite()).for_each(|volume| *volume = 0.0);
    let mut order: Vec<usize> = roots.clone();
    order.sort_unstable();
    order.dedup();
    // Equal volumes keep the order of their vertices.
    order.sort_by(|a, b| volumes[*b].total_cmp(&volumes[*a]));
    let largest =
        order.first().map(|root| volumes[*root]).filter(|volume| *volume > 0.0).ok_or(MeshError::NoSurface)?;
    let count = order.iter().take_while(|root| volumes[**root] >= BODY * largest).count();
    if count > bodies.max(1) {
        return Err(MeshError::SeveralBodies { count });
    }
    let (kept, rest) = order.split_at(bodies.max(1).min(order.len()));
    let mut is_kept = vec![false; mesh.positions.len()];
    kept.iter().filter(|root| volumes[**root] > 0.0).for_each(|root| is_kept[*root] = true);
    let lost = rest.iter().chain(kept.iter().filter(|root| volumes[**root] <= 0.0));
    let mut volumes_m3: Vec<f64> = lost.map(|root| volumes[*root]).collect();
    volumes_m3.sort_by(|a, b| b.abs().total_cmp(&a.abs()));

    let mut result = TriMesh::default();
    let mut renumbered = vec![u32::MAX; mesh.positions.len()];
    let mut used = vec![false; mesh.positions.len()];
    let triangles =
        || rows.iter().zip(&roots).filter(|(_, root)| is_kept[**root]).map(|(row, _)| &mesh.triangles[*row]);
    triangles().flatten().for_each(|vertex| used[*vertex as usize] = true);
    for vertex in (0..used.len()).filter(|vertex| used[*vertex]) {
        renumbered[vertex] = result.positions.len() as u32;
        result.positions.push(mesh.positions[vertex]);
        result.from_hole.push(mesh.from_hole.get(vertex).copied().unwrap_or(false));
    }
    result.triangles = triangles().map(|corners| corners.map(|vertex| renumbered[vertex as usize])).collect();
    let removed = Removed { volumes_m3, triangles: mesh.triangles.len() - result.triangles.len() };
    Ok((result, removed))
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    fn tetrahedra(sizes: &[f32]) -> TriMesh {
        let mut mesh = TriMesh::default();
        for (i, size) in sizes.iter().enumerate() {
            let (first, size_of) = (mesh.positions.len() as u32, size.abs());
            let at = Vec3::X * 9.0 * i as f32;
            mesh.positions.extend([Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z].map(|corner| at + corner * size_of));
            let triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|mut corners: [u32; 3]| {
                if *size < 0.0 {
                    corners.reverse();
                }
                corners.map(|vertex| vertex + first)
            });
            mesh.triangles.extend(triangles);
            mesh.from_hole.extend([i == 0; 4]);
        }
        mesh
    }

    #[test]
    fn floaters_and_cavities_are_removed() {
        let (kept, removed) = keep_largest(&tetrahedra(&[0.3, 1.0, -0.5]), 1).unwrap();
        assert_eq!((kept.triangles.len(), kept.positions[0], kept.from_hole[0]), (4, Vec3::X * 9.0, false));
        let mut poisoned = tetrahedra(&[1.0]);
        poisoned.triangles.insert(0, [0, 1, 99]);
        poisoned.triangles.push([0, 1, 99]);
        let (kept, removed_ones) = keep_largest(&poisoned, 1).unwrap();
        assert_eq!((kept.triangles.len(), removed_ones.triangles), (4, 2));
        poisoned.positions[1] = Vec3::NAN;
        assert_eq!(keep_largest(&poisoned, 1).unwrap_err(), MeshError::NoSurface);
        assert_eq!((removed.volumes_m3.len(), removed.cavities(), removed.triangles), (2, 1, 8));
    }

    #[test]
    fn several_bodies_are_an_error_unless_asked_for() {
        let mesh = tetrahedra(&[1.0, 0.1, 0.9]);
        let error = keep_largest(&mesh, 1).unwrap_err();
        assert_eq!(error, MeshError::SeveralBodies { count: 2 });
        assert!(error.to_string().starts_with("2 separate bodies"));
        assert_eq!(keep_largest(&mesh, 2).unwrap().0.triangles.len(), 8);
        assert_eq!(keep_largest(&tetrahedra(&[-1.0]), 1).unwrap_err(), MeshError::NoSurface);
        assert_eq!(keep_largest(&TriMesh::default(), 1).unwrap_err(), MeshError::NoSurface);
    }
}

//! Triangle mesh.

use glam::{DVec3, Vec3};

/// Triangles with shared vertices.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TriMesh {
    /// Positions of the vertices, metres.
    pub positions: Vec<Vec3>,
    /// Vertices of each triangle, counter-clockwise from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Whether a vertex closes a hole in the evidence; one per vertex.
    pub from_hole: Vec<bool>,
}

impl TriMesh {
    /// Returns the corners of a triangle in f64, metres; zeros for a triangle or vertex out of range.
    #[must_use]
    pub fn corners(&self, triangle: usize) -> [DVec3; 3] {
        let corners = self.triangles.get(triangle).copied().unwrap_or_default();
        corners.map(|vertex| self.positions.get(vertex as usize).map_or(DVec3::ZERO, |position| position.as_dvec3()))
    }

    /// Returns the unit outward normals of the vertices, weighted by the areas of their triangles; zero for a vertex
    /// without any.
    #[must_use]
    pub fn normals(&self) -> Vec<Vec3> {
        let mut sums = vec![DVec3::ZERO; self.positions.len()];
        for (i, triangle) in self.triangles.iter().enumerate() {
            let normal = area_vector(self.corners(i));
            for vertex in triangle {
                if let Some(sum) = sums.get_mut(*vertex as usize) {
                    *sum += normal;
                }
            }
        }
        sums.into_iter().map(|sum| sum.normalize_or_zero().as_vec3()).collect()
    }

    /// Returns the area of the surface, square metres.
    #[must_use]
    pub fn area(&self) -> f64 {
        (0..self.triangles.len()).map(|i| area_vector(self.corners(i)).length()).sum()
    }

    /// Returns the area that closes holes, square metres: of each triangle the share of its vertices that do.
    #[must_use]
    pub fn hole_area(&self) -> f64 {
        let closes = |vertex: &&u32| self.from_hole.get(**vertex as usize).copied().unwrap_or(false);
        let share = |i: usize| self.triangles[i].iter().filter(closes).count() as f64 / 3.0;
        (0..self.triangles.len()).map(|i| share(i) * area_vector(self.corners(i)).length()).sum()
    }

    /// Returns the enclosed volume, cubic metres; negative where triangles face inwards.
    #[must_use]
    pub fn volume(&self) -> f64 {
        (0..self.triangles.len()).map(|i| signed_volume(self.corners(i))).sum()
    }
}

/// Returns the normal of a triangle with the length of its area.
pub fn area_vector([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a) * 0.5
}

/// Returns the signed volume between a triangle and the origin.
pub fn signed_volume([a, b, c]: [DVec3; 3]) -> f64 {
    a.dot(b.cross(c)) / 6.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tetrahedron_has_its_measures() {
        let mesh = TriMesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, Vec3::ONE],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
            from_hole: vec![true, false, false, false, false],
        };
        assert!((mesh.volume() - 1.0 / 6.0).abs() < 1e-12);
        assert!((mesh.area() - (1.5 + 0.75f64.sqrt())).abs() < 1e-7);
        assert!((mesh.hole_area() - 0.5).abs() < 1e-7);
        let normals = mesh.normals();
        assert!(normals[0].distance(Vec3::splat(-1.0).normalize()) < 1e-6);
        assert_eq!(normals[4], Vec3::ZERO);
        assert_eq!(mesh.corners(99), [DVec3::ZERO; 3]);
    }
}

//! Topology of triangle meshes.

use crate::connectivity::Connectivity;
use crate::intersections::self_intersections;
use crate::mesh::{TriMesh, area_vector};

/// Height of a triangle over its longest side below which it counts as degenerate.
const FLAT: f64 = 1e-9;

/// Counts of a mesh's defects and its measures. Triangles with vertices out of range count as degenerate and are ignored
/// otherwise.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Topology {
    /// Vertices of at least one triangle.
    pub vertices: usize,
    /// Edges.
    pub edges: usize,
    /// Triangles.
    pub triangles: usize,
    /// Edges of one triangle.
    pub boundary_edges: usize,
    /// Edges of more than two triangles.
    pub non_manifold_edges: usize,
    /// Edges that two triangles pass in the same direction.
    pub inconsistent_edges: usize,
    /// Vertices whose triangles form more than one fan.
    pub non_manifold_vertices: usize,
    /// Triangles without area.
    pub degenerate_triangles: usize,
    /// Pairs of triangles without common vertices that intersect.
    pub self_intersections: usize,
    /// Connected components.
    pub components: usize,
    /// Area, square metres.
    pub area_m2: f64,
    /// Enclosed volume, cubic metres; negative for triangles that face inwards.
    pub volume_m3: f64,
}

impl Topology {
    /// Measures a mesh.
    #[must_use]
    pub fn measure(mesh: &TriMesh) -> Self {
        let valid = |triangle: &[u32; 3]| triangle.iter().all(|vertex| (*vertex as usize) < mesh.positions.len());
        let used: Vec<[u32; 3]> = mesh.triangles.iter().copied().filter(valid).collect();
        let of = Connectivity::new(&used);
        Self {
            vertices: of.vertices,
            edges: of.edges,
            boundary_edges: of.open_edges,
            non_manifold_edges: of.crowded_edges,
            inconsistent_edges: of.twisted_edges,
            non_manifold_vertices: of.pinched_vertices,
            components: of.components,
            triangles: mesh.triangles.len(),
            degenerate_triangles: (0..mesh.triangles.len()).filter(|i| is_degenerate(mesh, *i)).count(),
            self_intersections: self_intersections(mesh),
            area_m2: mesh.area(),
            volume_m3: mesh.volume(),
        }
    }

    /// Returns whether the mesh is closed, manifold and consistently oriented.
    #[must_use]
    pub fn is_closed_manifold(&self) -> bool {
        self.boundary_edges + self.non_manifold_edges + self.inconsistent_edges + self.non_manifold_vertices == 0
    }

    /// Returns vertices minus edges plus triangles.
    #[must_use]
    pub fn euler_characteristic(&self) -> i64 {
        self.vertices as i64 - self.edges as i64 + self.triangles as i64
    }

    /// Returns the number of handles of all components together; `None` unless the mesh is closed and manifold.
    #[must_use]
    pub fn genus(&self) -> Option<i64> {
        self.is_closed_manifold().then(|| self.components as i64 - self.euler_characteristic() / 2)
    }
}

fn is_degenerate(mesh: &TriMesh, triangle: usize) -> bool {
    let [i, j, k] = mesh.triangles[triangle];
    if i == j || j == k || k == i || [i, j, k].iter().any(|vertex| *vertex as usize >= mesh.positions.len()) {
        return true;
    }
    let [a, b, c] = mesh.corners(triangle);
    let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
    let area = area_vector([a, b, c]).length();
    area.is_nan() || longest.is_nan() || 2.0 * area <= FLAT * longest
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    fn tetrahedron() -> TriMesh {
        TriMesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
            from_hole: vec![false; 4],
        }
    }

    #[test]
    fn a_tetrahedron_is_closed() {
        let topology = Topology::measure(&tetrahedron());
        assert!(topology.is_closed_manifold());
        assert_eq!((topology.genus(), topology.components, topology.edges), (Some(0), 1, 6));
        assert_eq!((topology.degenerate_triangles, topology.self_intersections), (0, 0));
    }

    #[test]
    fn each_defect_is_counted() {
        let mut open = tetrahedron();
        open.triangles.pop();
        assert_eq!((Topology::measure(&open).boundary_edges, Topology::measure(&open).genus()), (3, None));

        let mut flipped = tetrahedron();
        flipped.triangles[0].reverse();
        assert_eq!(Topology::measure(&flipped).inconsistent_edges, 3);

        let mut fin = tetrahedron();
        fin.positions.push(Vec3::new(-1.0, -1.0, 0.0));
        fin.triangles.push([0, 1, 4]);
        assert_eq!(Topology::measure(&fin).non_manifold_edges, 1);

        // Two tetrahedra at a vertex.
        let mut pair = tetrahedron();
        pair.positions.extend([-Vec3::X, -Vec3::Y, -Vec3::Z]);
        pair.triangles.extend([[0, 4, 5], [0, 6, 4], [0, 5, 6], [4, 6, 5]]);
        let topology = Topology::measure(&pair);
        assert_eq!((topology.non_manifold_vertices, topology.components, topology.boundary_edges), (1, 1, 0));

        let mut poisoned = tetrahedron();
        poisoned.positions[3] = Vec3::NAN;
        poisoned.triangles.extend([[0, 1, 99], [1, 1, 2]]);
        assert_eq!(Topology::measure(&poisoned).degenerate_triangles, 5);
        assert_eq!(Topology::measure(&TriMesh::default()), Topology::default());
    }
}

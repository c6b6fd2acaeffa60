//! Counts of defects that make a triangle mesh something else than the surface of a solid.

use std::collections::{HashMap, HashSet};

use crate::union_find::UnionFind;

/// Defects and invariants of a triangle mesh, from its indices alone.
///
/// ```
/// use flyrig_mesh::Connectivity;
///
/// let tetrahedron = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
/// let topology = Connectivity::new(&tetrahedron);
/// assert!(topology.is_closed_manifold());
/// assert_eq!((topology.components, topology.euler), (1, 2));
/// assert_eq!(Connectivity::new(&tetrahedron[1..]).open_edges, 3);
/// ```
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Connectivity {
    /// Edges with one triangle.
    pub open_edges: usize,
    /// Edges with more than two triangles.
    pub crowded_edges: usize,
    /// Edges whose two triangles pass them in the same direction, so that one of them is inside out.
    pub twisted_edges: usize,
    /// Vertices whose triangles form more than one fan.
    pub pinched_vertices: usize,
    /// Triangles that use a vertex twice, or the same three vertices as another one.
    pub degenerate_triangles: usize,
    /// Connected parts, joined by shared vertices.
    pub components: usize,
    /// Vertices in use.
    pub vertices: usize,
    /// Edges.
    pub edges: usize,
    /// Euler characteristic: vertices in use - edges + triangles; twice the components less twice the handles when closed.
    pub euler: i64,
}

impl Connectivity {
    /// Measures the topology of triangles.
    #[must_use]
    pub fn new(triangles: &[[u32; 3]]) -> Self {
        Self::with_faults(triangles).0
    }

    /// Returns whether every edge has two triangles of one orientation, every vertex one fan, and no triangle is degenerate.
    #[must_use]
    pub fn is_closed_manifold(&self) -> bool {
        self.defects() == [0; 5]
    }

    /// Returns whether no kind of defect is more frequent than in `before`, and closed surfaces keep their parts and handles.
    #[must_use]
    pub fn is_no_worse_than(&self, before: &Self) -> bool {
        let is_clean = self.defects().iter().zip(before.defects()).all(|(after, before)| *after <= before);
        is_clean && (!before.is_closed_manifold() || (self.components, self.euler) == (before.components, before.euler))
    }

    fn defects(&self) -> [usize; 5] {
        [self.open_edges, self.crowded_edges, self.twisted_edges, self.pinched_vertices, self.degenerate_triangles]
    }

    /// Measures the topology and returns the vertices at its defects other than open edges, ascending.
    pub(crate) fn with_faults(triangles: &[[u32; 3]]) -> (Self, Vec<u32>) {
        let mut found = Self::default();
        let mut faults = HashSet::new();
        // Number of triangles that pass an edge from its lower vertex to the higher one, and back.
        let mut edges: HashMap<[u32; 2], [usize; 2]> = HashMap::with_capacity(3 * triangles.len() / 2);
        let mut seen = HashSet::with_capacity(triangles.len());
        for triangle in triangles {
            let mut sorted = *triangle;
            sorted.sort_unstable();
            if sorted[0] == sorted[1] || sorted[1] == sorted[2] || !seen.insert(sorted) {
                found.degenerate_triangles += 1;
                faults.extend(triangle);
            }
            for [a, b] in edges_of(triangle) {
                edges.entry([a.min(b), a.max(b)]).or_default()[usize::from(a > b)] += 1;
            }
        }
        for (edge, [up, down]) in &edges {
            match (up + down, up.abs_diff(*down)) {
                (1, _) => {
                    found.open_edges += 1;
                    continue;
                }
                (2, 0) => continue,
                (2, _) => found.twisted_edges += 1,
                _ => found.crowded_edges += 1,
            }
            faults.extend(edge);
        }
        let fans = Fans::new(triangles);
        found.pinched_vertices = fans.pinched.len();
        faults.extend(&fans.pinched);
        found.components = fans.components;
        (found.vertices, found.edges) = (fans.vertices, edges.len());
        found.euler = fans.vertices as i64 - edges.len() as i64 + triangles.len() as i64;
        let mut faults: Vec<u32> = faults.into_iter().collect();
        faults.sort_unstable();
        (found, faults)
    }
}

/// Returns the directed edges of a triangle.
fn edges_of([a, b, c]: &[u32; 3]) -> [[u32; 2]; 3] {
    [[*a, *b], [*b, *c], [*c, *a]]
}

/// Triangles around each vertex.
struct Fans {
    vertices: usize,
    components: usize,
    pinched: Vec<u32>,
}

impl Fans {
    fn new(triangles: &[[u32; 3]]) -> Self {
        // Corners around a vertex are joined where their triangles share an edge at it.
        let mut corners = UnionFind::new(3 * triangles.len());
        let mut parts = UnionFind::new(3 * triangles.len());
        let mut first: HashMap<u32, usize> = HashMap::new();
        let mut sides: HashMap<[u32; 2], usize> = HashMap::with_capacity(3 * triangles.len());
        for (t, triangle) in triangles.iter().enumerate() {
            for k in 0..3 {
                let corner = 3 * t + k;
                parts.join(3 * t, *first.entry(triangle[k]).or_insert(corner));
                parts.join(3 * t, corner);
                for other in [triangle[(k + 1) % 3], triangle[(k + 2) % 3]] {
                    corners.join(corner, *sides.entry([triangle[k], other]).or_insert(corner));
                }
            }
        }
        let mut pinched: Vec<u32> = Vec::new();
        for (corner, vertex) in triangles.as_flattened().iter().enumerate() {
            if first.get(vertex).is_some_and(|first| corners.root(*first) != corners.root(corner)) {
                pinched.push(*vertex);
            }
        }
        pinched.sort_unstable();
        pinched.dedup();
        let components = (0..triangles.len()).filter(|t| parts.root(3 * t) == 3 * t).count();
        Self { vertices: first.len(), components, pinched }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    #[test]
    fn closed_shapes_have_their_handles() {
        let sphere = Connectivity::new(&shapes::bumpy_sphere(20).triangles);
        assert!(sphere.is_closed_manifold());
        assert_eq!((sphere.components, sphere.euler), (1, 2));
        let tori = Connectivity::new(&shapes::two_tori(24, 12).triangles);
        assert!(tori.is_closed_manifold());
        assert_eq!((tori.components, tori.euler), (2, 0));
        assert!(!sphere.is_no_worse_than(&tori), "handles must stay");
    }

    #[test]
    fn each_defect_is_counted() {
        let tetrahedron = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let count = |triangles: &[[u32; 3]]| Connectivity::new(triangles);
        assert_eq!(count(&tetrahedron[..3]).open_edges, 3);
        let mut turned = tetrahedron;
        turned[3].swap(0, 1);
        assert_eq!(count(&turned).twisted_edges, 3);
        // Two tetrahedra that share a vertex, then an edge.
        let with = |map: fn(u32) -> u32| [tetrahedron, tetrahedron.map(|t| t.map(map))].concat();
        let at_vertex = count(&with(|i| i + 3));
        assert_eq!((at_vertex.pinched_vertices, at_vertex.components, at_vertex.crowded_edges), (1, 1, 0));
        assert_eq!(count(&with(|i| i + 2)).crowded_edges, 1);
        assert_eq!(count(&with(|i| i + 4)).components, 2);
        assert_eq!(count(&[[0, 1, 2], [0, 2, 1]]).degenerate_triangles, 1);
        assert_eq!(count(&[[0, 1, 1]]).degenerate_triangles, 1);
        assert_eq!(count(&[]), Connectivity::default());
    }
}

//! Collapses of edges that keep the topology of a surface.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::{DVec3, Vec3};

use crate::connectivity::Connectivity;
use crate::finish::{around::triangles_around, quadric::Quadric};

/// Weight of the squared way of a vertex against that of the squared distance from its planes: even triangles where the surface is flat.
const EVENNESS: f64 = 1e-3;
/// Weight of the planes through open edges, which keep the border, against those of triangles.
const BORDER: f64 = 10.0;
/// Least cosine between the normals of a triangle before and after a collapse.
const SAME_SIDE: f64 = 0.3;
/// Least height of a triangle over its longest side.
const SLIM: f64 = 0.05;

/// Bounds of the shape of triangles after a collapse.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Shape {
    /// No triangle turns over or becomes a needle that was none.
    Kept,
    /// Topology alone counts: thin, noisy parts fold.
    Any,
}

/// Triangles, with those around each vertex.
struct Collapsing<'a> {
    positions: &'a [Vec3],
    triangles: Vec<[u32; 3]>,
    is_alive: Vec<bool>,
    alive: usize,
    around: Vec<Vec<u32>>,
    quadrics: Vec<Quadric>,
    /// Vertices of open edges.
    is_border: Vec<bool>,
    /// Vertices at defects, which stay as they are.
    is_locked: Vec<bool>,
    /// Number of changes of each vertex: candidates computed before are out of date.
    changes: Vec<u32>,
}

/// Vertex that is moved onto a neighbour.
struct Candidate {
    cost: f64,
    from: u32,
    to: u32,
    changes: u32,
}

impl Ord for Candidate {
    /// The cheapest candidate is the greatest; equal costs are ordered by vertices.
    fn cmp(&self, other: &Self) -> Ordering {
        let key = |of: &Self| (of.from, of.to, of.changes);
        other.cost.total_cmp(&self.cost).then_with(|| key(other).cmp(&key(self)))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

/// Moves vertices onto neighbours, at the least quadric error (Garland and Heckbert 1997) first, until at most `target` triangles are left
/// or none can go. A collapse is made only if the neighbours that both vertices share are those of their triangles (the link condition,
/// Dey et al. 1999), so that surfaces keep parts, handles and borders; vertices at defects do not move. Indices must be in range and positions
/// finite.
pub fn collapse(positions: &[Vec3], triangles: &[[u32; 3]], target: usize) -> Vec<[u32; 3]> {
    let mut surface = Collapsing::new(positions, triangles);
    for shape in [Shape::Kept, Shape::Any] {
        while surface.alive > target && surface.sweep(target, shape) {}
    }
    let rows = surface.triangles.iter().zip(&surface.is_alive);
    rows.filter(|(_, alive)| **alive).map(|(triangle, _)| *triangle).collect()
}

impl<'a> Collapsing<'a> {
    fn new(positions: &'a [Vec3], triangles: &[[u32; 3]]) -> Self {
        let count = positions.len();
        let mut is_locked = vec![false; count];
        Connectivity::with_faults(triangles).1.iter().for_each(|i| is_locked[*i as usize] = true);
        let mut surface = Self {
            positions,
            triangles: triangles.to_vec(),
            is_alive: vec![true; triangles.len()],
            alive: triangles.len(),
            around: triangles_around(count, triangles),
            quadrics: vec![Quadric::ZERO; count],
            is_border: vec![false; count],
            is_locked,
            changes: vec![0; count],
        };
        surface.measure();
        surface
    }

    fn place(&self, vertex: u32) -> DVec3 {
        self.positions[vertex as usize].as_dvec3()
    }

    /// Finds borders, and sums the quadrics of all vertices.
    fn measure(&mut self) {
        for triangle in self.triangles.clone() {
            let [a, b, c] = triangle.map(|i| self.place(i));
            let normal = (b - a).cross(c - a);
            let area = normal.length();
            let unit = normal.normalize_or_zero();
            for k in 0..3 {
                let vertex = triangle[k];
                let own = Quadric::of_plane(unit, a, area) + Quadric::of_place(self.place(vertex), EVENNESS * area);
                self.quadrics[vertex as usize] += own;
                let other = triangle[(k + 1) % 3];
                if self.triangles_at([vertex, other]) == 1 {
                    let side = self.place(other) - self.place(vertex);
                    let across = side.cross(unit).normalize_or_zero();
                    let border = Quadric::of_plane(across, self.place(vertex), BORDER * side.length_squared());
                    for end in [vertex, other] {
                        self.is_border[end as usize] = true;
                        self.quadrics[end as usize] += border;
                    }
                }
            }
        }
    }

    /// Returns the number of triangles at an edge.
    fn triangles_at(&self, [a, b]: [u32; 2]) -> usize {
        self.around[a as usize].iter().filter(|t| self.triangles[**t as usize].contains(&b)).count()
    }

    /// Returns the neighbours of a vertex, ascending.
    fn neighbors(&self, vertex: u32) -> Vec<u32> {
        let corners = self.around[vertex as usize].iter().flat_map(|t| self.triangles[*t as usize]);
        let mut neighbors: Vec<u32> = corners.filter(|i| *i != vertex).collect();
        neighbors.sort_unstable();
        neighbors.dedup();
        neighbors
    }

    fn candidate(&self, from: u32, to: u32) -> Candidate {
        let of = |vertex: u32| (self.quadrics[vertex as usize], self.changes[vertex as usize]);
        let ((own, before), (other, after)) = (of(from), of(to));
        Candidate { cost: (own + other).at(self.place(to)), from, to, changes: before + after }
    }

    /// Collapses edges by cost until `target` triangles are left. Returns whether any was.
    fn sweep(&mut self, target: usize, shape: Shape) -> bool {
        let mut candidates = Vec::with_capacity(3 * self.alive);
        for (triangle, _) in self.triangles.iter().zip(&self.is_alive).filter(|(_, alive)| **alive) {
            for (a, b) in [(0, 1), (1, 2), (2, 0)].map(|(a, b)| (triangle[a], triangle[b])) {
                candidates.push(self.candidate(a, b));
                // The other triangle of an inner edge passes it the other way.
                if self.is_border[a as usize] && self.is_border[b as usize] {
                    candidates.push(self.candidate(b, a));
                }
            }
        }
        let mut open = BinaryHeap::from(candidates);
        let before = self.alive;
        while self.alive > target
            && let Some(Candidate { from, to, changes, .. }) = open.pop()
        {
            let is_current = self.changes[from as usize] + self.changes[to as usize] == changes;
            let exists = !self.around[from as usize].is_empty() && !self.around[to as usize].is_empty();
            if !is_current || !exists || !self.keeps_topology(from, to) {
                continue;
            }
            if shape == Shape::Kept && !self.keeps_shape(from, to) {
                continue;
            }
            self.apply(from, to);
            for neighbor in self.neighbors(to) {
                open.push(self.candidate(neighbor, to));
                open.push(self.candidate(to, neighbor));
            }
        }
        self.alive < before
    }

    /// Tests the link condition, with open edges as if they had one more triangle to a vertex that all of them share.
    fn keeps_topology(&self, from: u32, to: u32) -> bool {
        let [from_border, to_border] = [from, to].map(|i| self.is_border[i as usize]);
        if self.is_locked[from as usize] || self.is_locked[to as usize] {
            return false;
        }
        let (own, other) = (self.neighbors(from), self.neighbors(to));
        let at_edge = self.triangles_at([from, to]);
        let shared: Vec<u32> = own.iter().copied().filter(|i| other.binary_search(i).is_ok()).collect();
        if shared.len() != at_edge {
            return false;
        }
        match (from_border, to_border, at_edge) {
            // The last tetrahedron stays.
            (false, _, 2) => own.len() > 3 || other.len() > 3,
            // The last triangle stays.
            (true, true, 1) => !shared.iter().any(|i| self.triangles_at([from, *i]) + self.triangles_at([to, *i]) == 2),
            _ => false,
        }
    }

    /// Returns whether no triangle that stays turns over, and none becomes a needle that was none.
    fn keeps_shape(&self, from: u32, to: u32) -> bool {
        self.around[from as usize].iter().all(|t| {
            let triangle = self.triangles[*t as usize];
            if triangle.contains(&to) {
                return true;
            }
            let (before, slim_before) = normal_of(triangle.map(|i| self.place(i)));
            let (after, slim) = normal_of(triangle.map(|i| self.place(if i == from { to } else { i })));
            let turned = before.dot(after) < SAME_SIDE * before.length() * after.length();
            !turned && slim >= SLIM.min(slim_before)
        })
    }

    /// Moves a vertex onto a neighbour.
    fn apply(&mut self, from: u32, to: u32) {
        for t in std::mem::take(&mut self.around[from as usize]) {
            let triangle = &mut self.triangles[t as usize];
            if triangle.contains(&to) {
                self.is_alive[t as usize] = false;
                self.alive -= 1;
                for i in triangle.iter().filter(|i| **i != from) {
                    self.around[*i as usize].retain(|other| *other != t);
                }
            } else {
                triangle.iter_mut().filter(|i| **i == from).for_each(|i| *i = to);
                self.around[to as usize].push(t);
            }
        }
        let own = self.quadrics[from as usize];
        self.quadrics[to as usize] += own;
        self.changes[to as usize] += 1;
    }
}

/// Returns the normal of a triangle, and its height over its longest side.
fn normal_of([a, b, c]: [DVec3; 3]) -> (DVec3, f64) {
    let normal = (b - a).cross(c - a);
    let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
    (normal, normal.length() / longest.max(f64::MIN_POSITIVE))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::{TriMesh, keep_largest, marching_cubes, shapes};

    fn after(mesh: &TriMesh, target: usize) -> Vec<[u32; 3]> {
        collapse(&mesh.positions, &mesh.triangles, target)
    }

    /// Noise in a field, as fused Gaussians have it, leaves dozens of handles of a voxel or two.
    #[test]
    fn surfaces_with_many_small_handles_reach_their_target_and_keep_them() {
        let noise = |lattice: glam::IVec3| {
            let mixed = lattice.dot(glam::IVec3::new(73_856_093, 19_349_663, 83_492_791)) as u32;
            let mixed = (mixed ^ mixed >> 15).wrapping_mul(0x2c1b_3c6d);
            (mixed ^ mixed >> 12) as f32 / u32::MAX as f32 - 0.5
        };
        let field = Field::from_values(5, 0.01, |lattice| {
            (lattice.as_vec3() - 18.0).length() * 0.01 - 0.12 + 0.035 * noise(lattice)
        });
        let (mesh, _) = keep_largest(&marching_cubes(&field), 1).unwrap();
        let before = Connectivity::new(&mesh.triangles);
        let handles = 1 - before.euler / 2;
        assert!(before.is_closed_manifold() && handles > 50, "{handles}");
        for share in [2, 4] {
            let target = mesh.triangles.len() / share;
            let triangles = after(&mesh, target);
            let found = Connectivity::new(&triangles);
            assert!(found.is_closed_manifold() && found.is_no_worse_than(&before), "{found:?}");
            assert!(triangles.len() <= target && triangles.len() + 2 > target, "{} of {target}", triangles.len());
        }
        // The fewest triangles that hold the handles.
        let least = Connectivity::new(&after(&mesh, 0));
        assert!(least.is_closed_manifold() && least.euler == before.euler, "{least:?}");
    }

    #[test]
    fn the_least_surfaces_stay() {
        let tetrahedron: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let corners = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
        assert_eq!(collapse(&corners, &tetrahedron, 0), tetrahedron);
        assert_eq!(collapse(&corners, &tetrahedron[..1], 0), tetrahedron[..1]);
        assert_eq!(collapse(&corners, &[], 0), [[0u32; 3]; 0]);
        // Seven vertices are the fewest of a torus.
        let mut torus = shapes::two_tori(12, 8);
        torus.triangles.truncate(2 * 12 * 8);
        let least = after(&torus, 0);
        let found = Connectivity::new(&least);
        assert!(found.is_closed_manifold() && found.euler == 0 && (14..40).contains(&least.len()), "{found:?}");
    }

    #[test]
    fn borders_and_defects_stay() {
        // Half a sphere: one border, whose length stays.
        let mut half = shapes::bumpy_sphere(20);
        half.triangles.retain(|t| t.iter().all(|i| half.positions[*i as usize].y > 0.9));
        let (before, found) = (Connectivity::new(&half.triangles), Connectivity::new(&after(&half, 400)));
        assert_eq!((found.euler, found.components), (before.euler, before.components));
        assert_eq!((found.crowded_edges, found.pinched_vertices, found.degenerate_triangles), (0, 0, 0));
        assert!(found.open_edges > 5 && found.open_edges < before.open_edges);
        // A fin: three triangles at an edge.
        let mut fin = shapes::bumpy_sphere(12);
        let [a, b, _] = fin.triangles[0];
        fin.positions.push(Vec3::ZERO);
        fin.triangles.push([a, b, fin.positions.len() as u32 - 1]);
        let triangles = after(&fin, 600);
        assert!(triangles.iter().filter(|t| t.contains(&a) && t.contains(&b)).count() == 3 && triangles.len() <= 600);
    }

    #[test]
    fn flat_parts_go_before_curved_ones() {
        let mut mesh = shapes::bumpy_sphere(30);
        for p in &mut mesh.positions {
            p.y = p.y.min(1.1);
        }
        let triangles = after(&mesh, 6_000);
        let is_flat = |t: &&[u32; 3]| t.iter().all(|i| mesh.positions[*i as usize].y > 1.099);
        let share = |triangles: &[[u32; 3]]| triangles.iter().filter(is_flat).count() as f64 / triangles.len() as f64;
        assert!(share(&mesh.triangles) > 0.1 && share(&triangles) < 0.6 * share(&mesh.triangles));
    }
}

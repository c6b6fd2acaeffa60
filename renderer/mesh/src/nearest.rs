//! Distance from points to a surface: a tree of boxes over its triangles.

use glam::Vec3;

use crate::TriMesh;
use crate::triangle::closest_on_triangle;

/// Triangles of a leaf, at most.
const LEAF: usize = 4;

/// Triangles of a mesh, sorted into a tree of boxes.
#[derive(Debug)]
pub(crate) struct Surface {
    /// Corners, and index in the mesh.
    triangles: Vec<([Vec3; 3], u32)>,
    nodes: Vec<Node>,
}

/// Place on a surface that is nearest to a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct NearestPlace {
    pub place: Vec3,
    /// Squared distance from the point, square metres.
    pub squared: f32,
    /// Index of the triangle in the mesh.
    pub triangle: u32,
    /// Weights of its corners, sum 1.
    pub barycentric: [f32; 3],
}

/// Box around a range of triangles. The first child of a node without triangles follows it.
#[derive(Debug)]
struct Node {
    low: Vec3,
    high: Vec3,
    /// Range of triangles of a leaf; empty otherwise.
    range: std::ops::Range<usize>,
    /// Second child.
    second: usize,
}

impl Surface {
    /// Sorts the triangles of a mesh, whose indices must be in range.
    pub(crate) fn new(mesh: &TriMesh) -> Self {
        Self::of(&mesh.positions, &mesh.triangles)
    }

    /// Sorts triangles, whose indices must be in range.
    pub(crate) fn of(positions: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let corners = |(t, i): (&[u32; 3], u32)| (t.map(|i| positions[i as usize]), i);
        let mut surface = Self { triangles: triangles.iter().zip(0u32..).map(corners).collect(), nodes: Vec::new() };
        if !surface.triangles.is_empty() {
            surface.split(0, surface.triangles.len());
        }
        surface
    }

    fn split(&mut self, from: usize, to: usize) {
        let part = &mut self.triangles[from..to];
        let points = || part.iter().flat_map(|(corners, _)| corners.iter().copied());
        let low = points().fold(Vec3::INFINITY, Vec3::min);
        let high = points().fold(Vec3::NEG_INFINITY, Vec3::max);
        let node = self.nodes.len();
        self.nodes.push(Node { low, high, range: from..to, second: 0 });
        if part.len() <= LEAF {
            return;
        }
        let axis = (high - low).max_position();
        let center = |(t, _): &([Vec3; 3], u32)| t[0][axis] + t[1][axis] + t[2][axis];
        let half = part.len() / 2;
        part.select_nth_unstable_by(half, |a, b| center(a).total_cmp(&center(b)));
        self.split(from, from + half);
        self.nodes[node].second = self.nodes.len();
        self.nodes[node].range = 0..0;
        self.split(from + half, to);
    }

    /// Returns the distance from a point to the nearest triangle, metres; infinity without triangles.
    pub(crate) fn distance_m(&self, point: Vec3) -> f32 {
        self.search(point).map_or(f32::INFINITY, |nearest| nearest.squared.sqrt())
    }

    /// Returns the place of the surface that is nearest to a point; the point without triangles.
    pub(crate) fn nearest(&self, point: Vec3) -> Vec3 {
        self.search(point).map_or(point, |nearest| nearest.place)
    }

    /// Returns the nearest place; `None` without triangles, and for a point that is not finite.
    pub(crate) fn search(&self, point: Vec3) -> Option<NearestPlace> {
        let to_box = |node: usize| {
            self.nodes.get(node).map_or(f32::INFINITY, |n| point.distance_squared(point.clamp(n.low, n.high)))
        };
        let (mut least, mut best) = (f32::INFINITY, None);
        let mut open = vec![(to_box(0), 0)];
        while let Some((squared, i)) = open.pop() {
            if squared >= least {
                continue;
            }
            let node = &self.nodes[i];
            for (corners, triangle) in &self.triangles[node.range.clone()] {
                let barycentric = closest_on_triangle(point, *corners);
                let place: Vec3 = corners.iter().zip(barycentric).map(|(corner, weight)| *corner * weight).sum();
                let squared = point.distance_squared(place);
                if squared < least {
                    (least, best) = (squared, Some(NearestPlace { place, squared, triangle: *triangle, barycentric }));
                }
            }
            if node.range.is_empty() {
                let mut children = [i + 1, node.second].map(|child| (to_box(child), child));
                if children[0].0 < children[1].0 {
                    children.reverse();
                }
                open.extend(children);
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    /// Compares with a dense sampling of every triangle.
    #[test]
    fn distances_are_those_of_a_search_through_all_points() {
        let mesh = shapes::two_tori(24, 8);
        let surface = Surface::new(&mesh);
        for i in 0..40 {
            let angle = i as f32;
            let point = Vec3::new(angle.sin(), 0.7 * (1.7 * angle).sin(), (2.3 * angle).cos());
            let mut expected = f32::INFINITY;
            for triangle in &mesh.triangles {
                let [a, b, c] = triangle.map(|i| mesh.positions[i as usize]);
                for (u, v) in (0..=20).flat_map(|u| (0..=20 - u).map(move |v| (u as f32 / 20.0, v as f32 / 20.0))) {
                    expected = expected.min(point.distance(a + u * (b - a) + v * (c - a)));
                }
            }
            let found = surface.distance_m(point);
            assert!(found <= expected + 1e-6 && found > expected - 0.006, "{found} {expected}");
            let nearest = surface.nearest(point);
            assert!((nearest.distance(point) - found).abs() < 1e-6 && surface.distance_m(nearest) < 1e-6);
        }
        assert!(surface.distance_m(mesh.positions[5]) < 1e-6);
        let nothing = Surface::new(&TriMesh::default());
        assert!(nothing.distance_m(Vec3::ZERO).is_infinite());
        assert_eq!(nothing.nearest(Vec3::ONE), Vec3::ONE);
    }
}

//! Generalised winding number of oriented points (Barill et al., Fast Winding Numbers for Soups and Clouds, 2018).

use std::f32::consts::PI;

use glam::Vec3;

use crate::density::Density;
use crate::points::OrientedPoints;

/// Points of a leaf.
const LEAF: usize = 8;
/// Distance of a query from a node's centre, in radii of the node, beyond which its dipole stands for its points.
const OPENING: f32 = 3.0;

/// Part of the tree: a range of points and their dipole.
#[derive(Debug, Clone, Copy)]
struct Node {
    /// Mean of the positions weighted by area, metres.
    center: Vec3,
    /// Largest squared distance of a point from the centre times the squared opening, square metres.
    far: f32,
    /// Sum of the normals times their areas, square metres.
    dipole: Vec3,
    start: u32,
    end: u32,
    /// Node behind this one's subtree in preorder.
    next: u32,
}

/// Tree over oriented points that evaluates their winding number: about 1 inside a closed surface, 0 outside, and smooth
/// across holes.
#[derive(Debug)]
pub struct Winding {
    nodes: Vec<Node>,
    /// Positions, and normals times areas, by leaf.
    points: Vec<(Vec3, Vec3)>,
}

impl Winding {
    /// Builds the tree; a point counts with the surface area that its density gives it.
    #[must_use]
    pub fn new(points: &OrientedPoints, density: &Density) -> Self {
        let columns = points.positions().iter().zip(points.normals()).zip(density.areas());
        let rows: Vec<(Vec3, Vec3)> = columns.map(|((position, normal), area)| (*position, *normal * *area)).collect();
        let mut winding = Self { nodes: Vec::with_capacity(rows.len() / 2), points: rows };
        if !winding.points.is_empty() {
            winding.grow(0, winding.points.len());
        }
        winding
    }

    /// Adds the node of a range of points, and its children: halves of equal number along the longest axis, so that points
    /// at one place end the recursion too.
    fn grow(&mut self, start: usize, end: usize) {
        let at = self.nodes.len();
        let points = &mut self.points[start..end];
        let node = node_of(points, start, end);
        self.nodes.push(node);
        if points.len() > LEAF {
            let low = points.iter().fold(Vec3::INFINITY, |low, point| low.min(point.0));
            let high = points.iter().fold(Vec3::NEG_INFINITY, |high, point| high.max(point.0));
            let axis = (high - low).max_position();
            let middle = points.len() / 2;
            points.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]));
            self.grow(start, start + middle);
            self.grow(start + middle, end);
        }
        self.nodes[at].next = self.nodes.len() as u32;
    }

    /// Returns the winding number at `query`, metres; above 0.5 inside.
    #[must_use]
    pub fn number(&self, query: Vec3) -> f32 {
        let (mut sum, mut at) = (0.0, 0);
        while let Some(node) = self.nodes.get(at) {
            let offset = node.center - query;
            let squared = offset.length_squared();
            if squared > node.far {
                sum += term(offset, squared, node.dipole);
                at = node.next as usize;
            } else if node.next as usize == at + 1 {
                for (position, normal) in &self.points[node.start as usize..node.end as usize] {
                    let offset = *position - query;
                    sum += term(offset, offset.length_squared(), *normal);
                }
                at += 1;
            } else {
                at += 1;
            }
        }
        sum / (4.0 * PI)
    }
}

fn node_of(points: &[(Vec3, Vec3)], start: usize, end: usize) -> Node {
    let (mut sum, mut total, mut dipole) = (Vec3::ZERO, 0.0, Vec3::ZERO);
    for (position, normal) in points {
        let area = normal.length();
        sum += *position * area;
        total += area;
        dipole += *normal;
    }
    let center = if total > 0.0 { sum / total } else { points.first().map_or(Vec3::ZERO, |point| point.0) };
    let radius = points.iter().map(|point| point.0.distance_squared(center)).fold(0.0, f32::max);
    Node { center, far: radius * OPENING * OPENING, dipole, start: start as u32, end: end as u32, next: 0 }
}

/// Solid angle of a small patch at `offset` from the query; 0 at the query itself.
fn term(offset: Vec3, squared: f32, normal: Vec3) -> f32 {
    if squared > 0.0 { offset.dot(normal) / (squared * squared.sqrt()) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::points::OrientedPoint;

    fn sphere(count: usize) -> OrientedPoints {
        OrientedPoints::from_rows((0..count).map(|i| {
            let z = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
            let (sin, cos) = (i as f32 * 2.399_963_2).sin_cos();
            let normal = Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
            OrientedPoint { position: normal * 0.3, normal, weight: 1.0, uncertainty_m: 0.0 }
        }))
    }

    #[test]
    fn the_tree_agrees_with_the_sum_over_all_points() {
        let points = sphere(4000);
        let density = Density::measure(&points).unwrap();
        let winding = Winding::new(&points, &density);
        let mut random = StdRng::seed_from_u64(2);
        for _ in 0..400 {
            let query = (Vec3::from_array(random.random::<[f32; 3]>()) - 0.5) * 1.2;
            let exact: f64 = (0..points.len())
                .map(|i| {
                    let offset = (points.positions()[i] - query).as_dvec3();
                    let area = f64::from(density.areas()[i]);
                    offset.dot(points.normals()[i].as_dvec3()) * area / offset.length().powi(3)
                })
                .sum::<f64>()
                / (4.0 * std::f64::consts::PI);
            let found = f64::from(winding.number(query));
            // The points are 17 mm apart.
            let near = (query.length() - 0.3).abs() < 0.02;
            assert!((found - exact).abs() < if near { 0.06 } else { 0.02 }, "{found} {exact} at {query}");
            if !near {
                assert_eq!(found > 0.5, query.length() < 0.3, "{found} at {query}");
            }
        }
    }

    #[test]
    fn points_at_one_place_and_none_are_harmless() {
        let empty = Winding { nodes: Vec::new(), points: Vec::new() };
        assert!(empty.number(Vec3::ONE).abs() <= 0.0);
        let mut same = Winding { nodes: Vec::new(), points: vec![(Vec3::ONE, Vec3::X); 1000] };
        same.grow(0, 1000);
        assert!(same.number(Vec3::ONE).abs() <= 0.0 && same.number(Vec3::ZERO).is_finite());
    }
}

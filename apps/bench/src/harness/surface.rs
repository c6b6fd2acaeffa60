//! Distances between surfaces, by points spread over them.

use std::collections::HashMap;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

/// Side of a cell of the search grid, metres.
const CELL_M: f32 = 0.02;
/// Cells searched in each direction; larger distances are clamped to it.
const REACH_CELLS: i32 = 8;

/// Points spread evenly over a surface, in a search grid.
#[derive(Debug, Clone)]
pub struct Points {
    pub points: Vec<Vec3>,
    /// Unit normal of each point's triangle; zero for a triangle without area.
    pub normals: Vec<Vec3>,
    cells: HashMap<IVec3, Vec<u32>>,
}

impl Points {
    /// Spreads about `count` points over a surface by area, placed by an additive recurrence, so that the same surface has the same
    /// points.
    pub fn on(positions: &[Vec3], triangles: &[[u32; 3]], count: usize) -> Self {
        let corners = |t: &[u32; 3]| {
            let corner = |i: u32| positions.get(i as usize).copied().filter(|p| p.is_finite());
            Some([corner(t[0])?, corner(t[1])?, corner(t[2])?])
        };
        let area = |[a, b, c]: [Vec3; 3]| 0.5 * f64::from((b - a).cross(c - a).length());
        let corners: Vec<[Vec3; 3]> = triangles.iter().filter_map(corners).collect();
        let total: f64 = corners.iter().map(|&t| area(t)).sum();
        let (mut points, mut normals) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let (mut sum, mut done) = (0.0, 0usize);
        for &[a, b, c] in &corners {
            sum += area([a, b, c]);
            let normal = (b - a).cross(c - a).normalize_or_zero();
            let upto = (sum / total.max(1e-12) * count as f64).floor() as usize;
            for k in done..upto.min(count) {
                // The plastic number's recurrence covers the square evenly.
                let (mut u, mut v) = ((k as f64 * 0.754_877_666).fract(), (k as f64 * 0.569_840_290).fract());
                if u + v > 1.0 {
                    (u, v) = (1.0 - u, 1.0 - v);
                }
                points.push(a + (b - a) * u as f32 + (c - a) * v as f32);
                normals.push(normal);
            }
            done = done.max(upto.min(count));
        }
        let mut cells: HashMap<IVec3, Vec<u32>> = HashMap::new();
        for (i, point) in (0u32..).zip(&points) {
            cells.entry(cell(*point)).or_default().push(i);
        }
        Self { points, normals, cells }
    }

    /// Returns the distance to the nearest point, metres.
    pub fn distance(&self, from: Vec3) -> f64 {
        f64::from(self.nearest(from).1)
    }

    /// Returns the nearest point and the distance to it, metres; no point and the bound of distances where none is that near.
    pub fn nearest(&self, from: Vec3) -> (Option<usize>, f32) {
        let home = cell(from);
        let mut best = (None, REACH_CELLS as f32 * CELL_M);
        for ring in 0..=REACH_CELLS {
            // What lies in farther cells is at least so far away.
            if best.1 <= (ring - 1) as f32 * CELL_M {
                break;
            }
            for z in -ring..=ring {
                for y in -ring..=ring {
                    let edge = z.abs() == ring || y.abs() == ring;
                    let mut x = -ring;
                    while x <= ring {
                        for &i in self.cells.get(&(home + IVec3::new(x, y, z))).map_or(&[][..], Vec::as_slice) {
                            let distance = self.points[i as usize].distance(from);
                            if distance < best.1 {
                                best = (Some(i as usize), distance);
                            }
                        }
                        x += if edge || ring == 0 { 1 } else { 2 * ring };
                    }
                }
            }
        }
        best
    }

    /// Returns the mean distance of `others` to these points, metres; 0 without others.
    pub fn mean_distance(&self, others: &[Vec3]) -> f64 {
        let distances: Vec<f64> = others.par_iter().map(|&point| self.distance(point)).collect();
        distances.iter().sum::<f64>() / distances.len().max(1) as f64
    }

    /// Returns the points for which `keep` is true.
    pub fn filter(&self, keep: impl Fn(DVec3) -> bool) -> Vec<Vec3> {
        self.points.iter().copied().filter(|p| keep(p.as_dvec3())).collect()
    }
}

fn cell(point: Vec3) -> IVec3 {
    (point / CELL_M).floor().as_ivec3()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_of_a_plain_search() {
        let square = [Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y];
        let triangles = [[0, 1, 2], [0, 2, 3], [0, 1, 9]];
        let points = Points::on(&square, &triangles, 20_000);
        assert!((19_990..=20_000).contains(&points.points.len()));
        for from in [Vec3::new(0.5, 0.5, 0.03), Vec3::new(0.2, 0.9, -0.001), Vec3::new(1.05, 0.5, 0.0)] {
            let plain = points.points.iter().map(|p| p.distance(from)).fold(f32::INFINITY, f32::min);
            assert!((points.distance(from) - f64::from(plain)).abs() < 1e-6, "{from}");
        }
        assert!((points.distance(Vec3::splat(9.0)) - 0.16).abs() < 1e-6, "far is far");
        assert_eq!(points.nearest(Vec3::splat(9.0)).0, None);
        assert!(points.normals.iter().all(|normal| *normal == Vec3::Z));
        assert_eq!(points.nearest(points.points[77] + Vec3::Z * 1e-4).0, Some(77));
        let lifted: Vec<Vec3> = points.points.iter().map(|p| *p + Vec3::Z * 0.01).collect();
        assert!((points.mean_distance(&lifted) - 0.01).abs() < 1e-4);
        assert!(Points::on(&[], &[], 10).points.is_empty());
    }
}

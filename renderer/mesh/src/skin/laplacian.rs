//! Cotangent Laplacian of a triangle mesh.

use std::collections::BTreeMap;

use glam::Vec3;

/// Bounds of a cotangent: thin triangles of a marched surface would have unbounded ones.
const MOST_COTANGENT: f64 = 10.0;
/// Least weight of an edge: obtuse triangles have negative ones, which would let weights overshoot.
const LEAST_WEIGHT: f64 = 1e-3;

/// Symmetric Laplacian, `(L x)_i = sum over neighbours j of w_ij (x_i - x_j)`, and the area of each vertex.
#[derive(Debug)]
pub(super) struct Laplacian {
    /// Neighbours of each vertex with their weights.
    pub rows: Vec<Vec<(u32, f64)>>,
    /// A third of the triangles around each vertex, in units of the mean over all vertices.
    pub area: Vec<f64>,
}

impl Laplacian {
    /// Builds the Laplacian. Triangles with corners out of range or without area are ignored.
    pub fn new(positions: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let mut weights: BTreeMap<(u32, u32), f64> = BTreeMap::new();
        let mut area = vec![0.0; positions.len()];
        for triangle in triangles {
            let place = triangle.map(|i| positions.get(i as usize).map(|p| p.as_dvec3()));
            let [Some(a), Some(b), Some(c)] = place else { continue };
            let double = (b - a).cross(c - a).length();
            if !(double.is_finite() && double > 1e-14) {
                continue;
            }
            let corners = [a, b, c];
            for k in 0..3 {
                let (i, j) = (triangle[(k + 1) % 3], triangle[(k + 2) % 3]);
                let (u, v) = (corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k]);
                let cotangent = (u.dot(v) / double).clamp(-MOST_COTANGENT, MOST_COTANGENT);
                *weights.entry((i.min(j), i.max(j))).or_default() += 0.5 * cotangent;
                area[triangle[k] as usize] += double / 6.0;
            }
        }
        let mut rows = vec![Vec::new(); positions.len()];
        for ((i, j), weight) in weights {
            let weight = weight.max(LEAST_WEIGHT);
            rows[i as usize].push((j, weight));
            rows[j as usize].push((i, weight));
        }
        let used = area.iter().filter(|area| **area > 0.0).count().max(1);
        let mean = (area.iter().sum::<f64>() / used as f64).max(f64::MIN_POSITIVE);
        // Slivers would let the inverse of the area grow without bound.
        area.iter_mut().for_each(|area| *area = (*area / mean).max(0.05));
        Self { rows, area }
    }
}

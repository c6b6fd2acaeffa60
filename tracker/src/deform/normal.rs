//! The normal equations of the graph: symmetric 3x3 blocks for pairs of nodes, solved by conjugate gradients.

use glam::{DMat3, DVec3};

/// Entry of a list of pairs that stands for none.
const NONE: u32 = u32::MAX;
/// Conjugate gradients end at this share of the first residual, or after so many iterations.
const TOLERANCE: f64 = 1e-4;
const MAX_ITERATIONS: usize = 200;

/// `H + stiffness * L` with a sparsity that never changes: nodes that share a Gaussian or an edge.
#[derive(Debug)]
pub(super) struct NormalMatrix {
    /// Two different nodes each, the smaller first, ascending.
    pairs: Vec<(u32, u32)>,
    /// For each Gaussian the pairs of its nodes (0,1) (0,2) (0,3) (1,2) (1,3) (2,3), or none.
    gaussian_pairs: Vec<[u32; 6]>,
    /// Edges a pair, and edges a node.
    pair_edges: Vec<f64>,
    node_edges: Vec<f64>,
    diagonal: Vec<DMat3>,
    off_diagonal: Vec<DMat3>,
}

const CORNERS: [(usize, usize); 6] = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)];

impl NormalMatrix {
    pub(super) fn new(nodes: usize, gaussian_nodes: &[[u32; 4]], weights: &[[f32; 4]], edges: &[(u32, u32)]) -> Self {
        let ordered = |a: u32, b: u32| (a.min(b), a.max(b));
        let of_gaussian = |g: usize, (a, b): (usize, usize)| {
            let (n, m) = (gaussian_nodes[g][a], gaussian_nodes[g][b]);
            (n != m && weights[g][a] > 0.0 && weights[g][b] > 0.0).then(|| ordered(n, m))
        };
        let mut pairs: Vec<(u32, u32)> = edges.iter().map(|&(a, b)| ordered(a, b)).collect();
        pairs.extend((0..gaussian_nodes.len()).flat_map(|g| CORNERS.iter().filter_map(move |&c| of_gaussian(g, c))));
        pairs.sort_unstable();
        pairs.dedup();
        let find = |pair| pairs.binary_search(&pair).map_or(NONE, |at| at as u32);
        let gaussian_pairs = (0..gaussian_nodes.len())
            .map(|g| CORNERS.map(|corner| of_gaussian(g, corner).map_or(NONE, find)))
            .collect();
        let mut pair_edges = vec![0.0; pairs.len()];
        let mut node_edges = vec![0.0; nodes];
        for &(a, b) in edges {
            if let Some(count) = pair_edges.get_mut(find(ordered(a, b)) as usize) {
                *count += 1.0;
            }
            node_edges[a as usize] += 1.0;
            node_edges[b as usize] += 1.0;
        }
        let (diagonal, off_diagonal) = (vec![DMat3::ZERO; nodes], vec![DMat3::ZERO; pairs.len()]);
        Self { pairs, gaussian_pairs, pair_edges, node_edges, diagonal, off_diagonal }
    }

    pub(super) fn clear(&mut self) {
        self.diagonal.fill(DMat3::ZERO);
        self.off_diagonal.fill(DMat3::ZERO);
    }

    /// Adds the matrix of a Gaussian's own displacement, spread over its nodes.
    pub(super) fn add_gaussian(&mut self, g: usize, nodes: [u32; 4], weights: [f32; 4], matrix: DMat3) {
        let weights = weights.map(f64::from);
        for (&node, weight) in nodes.iter().zip(weights) {
            if weight > 0.0 {
                self.diagonal[node as usize] += matrix * (weight * weight);
            }
        }
        for (&pair, (a, b)) in self.gaussian_pairs[g].iter().zip(CORNERS) {
            if pair != NONE {
                self.off_diagonal[pair as usize] += matrix * (weights[a] * weights[b]);
            }
        }
    }

    /// Mean of the diagonal's entries.
    pub(super) fn mean_diagonal(&self) -> f64 {
        let sum: f64 = self.diagonal.iter().map(|m| m.x_axis.x + m.y_axis.y + m.z_axis.z).sum();
        sum / (3 * self.diagonal.len().max(1)) as f64
    }

    /// Solves `(H + stiffness L + damping) x = right`; `damping` above 0 keeps it regular whatever H and L are.
    pub(super) fn solve(&self, stiffness: f64, damping: f64, right: &[DVec3]) -> Vec<DVec3> {
        let own =
            |n: usize| self.diagonal[n] + DMat3::from_diagonal(DVec3::splat(stiffness * self.node_edges[n] + damping));
        let inverses: Vec<DMat3> = (0..self.diagonal.len()).map(|n| inverse(own(n))).collect();
        let times = |x: &[DVec3]| {
            let mut y: Vec<DVec3> = (0..x.len()).map(|n| own(n) * x[n]).collect();
            for (k, &(a, b)) in self.pairs.iter().enumerate() {
                let (a, b) = (a as usize, b as usize);
                let spring = stiffness * self.pair_edges[k];
                // The blocks are symmetric.
                y[a] += self.off_diagonal[k] * x[b] - spring * x[b];
                y[b] += self.off_diagonal[k] * x[a] - spring * x[a];
            }
            y
        };
        let dot = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f64>();
        let precondition = |r: &[DVec3]| -> Vec<DVec3> { r.iter().zip(&inverses).map(|(r, m)| *m * *r).collect() };
        let mut x = vec![DVec3::ZERO; right.len()];
        let mut residual = right.to_vec();
        let mut z = precondition(&residual);
        let mut direction = z.clone();
        let mut size = dot(&residual, &z);
        let end = size * TOLERANCE * TOLERANCE;
        for _ in 0..MAX_ITERATIONS {
            let image = times(&direction);
            let bend = dot(&direction, &image);
            // Also ends on NaN.
            if !(size > end && bend > 0.0) {
                break;
            }
            let length = size / bend;
            for n in 0..x.len() {
                x[n] += length * direction[n];
                residual[n] -= length * image[n];
            }
            z = precondition(&residual);
            let next = dot(&residual, &z);
            for (d, z) in direction.iter_mut().zip(&z) {
                *d = *z + *d * (next / size);
            }
            size = next;
        }
        x
    }
}

/// Inverse of a positive definite block; of one that rounding made singular, the inverse of its mean diagonal.
fn inverse(m: DMat3) -> DMat3 {
    let inverse = m.inverse();
    let mean = (m.x_axis.x + m.y_axis.y + m.z_axis.z) / 3.0;
    let definite = |v: DVec3| v.dot(inverse * v) > 0.0;
    if inverse.is_finite() && [DVec3::X, DVec3::Y, DVec3::Z].into_iter().all(definite) {
        inverse
    } else {
        DMat3::from_diagonal(DVec3::splat(1.0 / mean.max(1e-30)))
    }
}

//! Normal equations of the graph: symmetric 3x3 blocks for pairs of nodes, solved by preconditioned conjugate gradients.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::deform::carry::Carried;

/// Marks a missing pair.
const NONE: u32 = u32::MAX;
/// Share of the first residual at which conjugate gradients end, and their largest number of iterations. The step is tested
/// on the images anyway: 1e-4 lowers the loss no further and takes twice as long.
const TOLERANCE: f64 = 1e-3;
const MAX_ITERATIONS: usize = 200;
/// Rows per parallel task of a product.
const ROWS_A_TASK: usize = 128;
/// Nodes or pairs per parallel task of a sum.
const SUMS_A_TASK: usize = 64;

/// Gaussians of each node or pair of nodes, in their order, with their weights.
#[derive(Debug)]
struct Shares {
    ends: Vec<usize>,
    shares: Vec<(u32, f64)>,
}

impl Shares {
    /// Groups `(node or pair, Gaussian, weight)`, ordered by Gaussian, by node or pair.
    fn new(count: usize, all: &[(u32, u32, f64)]) -> Self {
        let mut ends = vec![0; count];
        for &(of, ..) in all {
            ends[of as usize] += 1;
        }
        let mut before = 0;
        for end in &mut ends {
            (*end, before) = (before, before + *end);
        }
        let mut shares = vec![(0, 0.0); all.len()];
        for &(of, gaussian, weight) in all {
            let at = &mut ends[of as usize];
            shares[*at] = (gaussian, weight);
            *at += 1;
        }
        Self { ends, shares }
    }

    /// Returns Gaussians and weights of a node or pair.
    fn of(&self, index: usize) -> &[(u32, f64)] {
        let begin = if index > 0 { self.ends[index - 1] } else { 0 };
        &self.shares[begin..self.ends[index]]
    }
}

/// Matrix `H + stiffness * L` with a fixed sparsity: pairs of nodes that share a Gaussian or an edge.
#[derive(Debug)]
pub(super) struct NormalMatrix {
    /// Weights of the Gaussians attached to each node, and products of their weights for each pair.
    of_node: Shares,
    of_pair: Shares,
    /// Other node and pair of each entry, row by row; `rows[n]..rows[n + 1]` is the row of node n.
    rows: Vec<usize>,
    others: Vec<(u32, u32)>,
    /// Sums of the edges' stiffness per pair, and per node.
    pair_edges: Vec<f64>,
    node_edges: Vec<f64>,
    diagonal: Vec<DMat3>,
    off_diagonal: Vec<DMat3>,
}

const CORNERS: [(usize, usize); 6] = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)];

impl NormalMatrix {
    /// Builds the sparsity; `edges` are directed, with their stiffness.
    pub(super) fn new(
        nodes: usize,
        gaussian_nodes: &[[u32; 4]],
        weights: &[[f32; 4]],
        edges: &[(u32, u32, f64)],
    ) -> Self {
        let ordered = |a: u32, b: u32| (a.min(b), a.max(b));
        let of_gaussian = |g: usize, (a, b): (usize, usize)| {
            let (n, m) = (gaussian_nodes[g][a], gaussian_nodes[g][b]);
            (n != m && weights[g][a] > 0.0 && weights[g][b] > 0.0).then(|| ordered(n, m))
        };
        // Pairs of different nodes, the smaller first, ascending.
        let mut pairs: Vec<(u32, u32)> = edges.iter().map(|&(a, b, _)| ordered(a, b)).collect();
        pairs.extend((0..gaussian_nodes.len()).flat_map(|g| CORNERS.iter().filter_map(move |&c| of_gaussian(g, c))));
        pairs.sort_unstable();
        pairs.dedup();
        let find = |pair| pairs.binary_search(&pair).map_or(NONE, |at| at as u32);
        let (mut of_node, mut of_pair) = (Vec::new(), Vec::new());
        for (g, (own_nodes, weights)) in gaussian_nodes.iter().zip(weights).enumerate() {
            let weights = weights.map(f64::from);
            of_node.extend(own_nodes.iter().zip(weights).filter(|(_, w)| *w > 0.0).map(|(&n, w)| (n, g as u32, w)));
            for (a, b) in CORNERS {
                if let Some(pair) = of_gaussian(g, (a, b)).map(find).filter(|&pair| pair != NONE) {
                    of_pair.push((pair, g as u32, weights[a] * weights[b]));
                }
            }
        }
        let (of_node, of_pair) = (Shares::new(nodes, &of_node), Shares::new(pairs.len(), &of_pair));
        let mut pair_edges = vec![0.0; pairs.len()];
        let mut node_edges = vec![0.0; nodes];
        for &(a, b, stiff) in edges {
            if let Some(sum) = pair_edges.get_mut(find(ordered(a, b)) as usize) {
                *sum += stiff;
            }
            node_edges[a as usize] += stiff;
            node_edges[b as usize] += stiff;
        }
        let mut by_row: Vec<Vec<(u32, u32)>> = vec![Vec::new(); nodes];
        for (k, &(a, b)) in (0u32..).zip(&pairs) {
            by_row[a as usize].push((b, k));
            by_row[b as usize].push((a, k));
        }
        let rows = std::iter::once(0)
            .chain(by_row.iter().scan(0, |end, row| {
                *end += row.len();
                Some(*end)
            }))
            .collect();
        let others = by_row.concat();
        let (diagonal, off_diagonal) = (vec![DMat3::ZERO; nodes], vec![DMat3::ZERO; pairs.len()]);
        Self { of_node, of_pair, rows, others, pair_edges, node_edges, diagonal, off_diagonal }
    }

    /// Sets H to zero.
    pub(super) fn clear(&mut self) {
        self.diagonal.fill(DMat3::ZERO);
        self.off_diagonal.fill(DMat3::ZERO);
    }

    /// Adds the derivatives by the Gaussians' displacements to `gradient` by the nodes, and with `with_matrix` to H. Each
    /// sum runs in the order of the Gaussians: equal input gives equal bytes for any number of threads.
    pub(super) fn accumulate(&mut self, own: &[Carried], gradient: &mut [DVec3], with_matrix: bool) {
        let Self { of_node, of_pair, diagonal, off_diagonal, .. } = self;
        let nodes = gradient.par_iter_mut().zip(diagonal).enumerate().with_min_len(SUMS_A_TASK);
        nodes.for_each(|(n, (gradient, diagonal))| {
            for &(g, weight) in of_node.of(n) {
                let one = &own[g as usize];
                *gradient += one.gradient * weight;
                if with_matrix {
                    *diagonal += one.matrix * (weight * weight);
                }
            }
        });
        if with_matrix {
            let pairs = off_diagonal.par_iter_mut().enumerate().with_min_len(SUMS_A_TASK);
            pairs.for_each(|(k, sum)| {
                for &(g, weight) in of_pair.of(k) {
                    *sum += own[g as usize].matrix * weight;
                }
            });
        }
    }

    /// Returns the diagonal block of H of a node.
    pub(super) fn diagonal_block(&self, node: usize) -> DMat3 {
        self.diagonal[node]
    }

    /// Returns the mean diagonal of L: the mean stiffness of a node's edges.
    pub(super) fn mean_edges(&self) -> f64 {
        self.node_edges.iter().sum::<f64>() / self.node_edges.len().max(1) as f64
    }

    /// Returns the mean diagonal entry of H.
    pub(super) fn mean_diagonal(&self) -> f64 {
        let sum: f64 = self.diagonal.iter().map(|m| m.x_axis.x + m.y_axis.y + m.z_axis.z).sum();
        sum / (3 * self.diagonal.len().max(1)) as f64
    }

    /// Returns the row of node `n` of `H x`; the blocks are symmetric.
    fn times_data(&self, x: &[DVec3], n: usize) -> DVec3 {
        let others = &self.others[self.rows[n]..self.rows[n + 1]];
        others.iter().fold(self.diagonal[n] * x[n], |sum, &(m, k)| sum + self.off_diagonal[k as usize] * x[m as usize])
    }

    /// Returns the row of node `n` of `L x`.
    fn times_laplacian(&self, x: &[DVec3], n: usize) -> DVec3 {
        let others = &self.others[self.rows[n]..self.rows[n + 1]];
        others.iter().fold(x[n] * self.node_edges[n], |sum, &(m, k)| sum - x[m as usize] * self.pair_edges[k as usize])
    }

    /// Solves `(H + stiffness L + damping) x = right`; `damping` above 0 keeps it regular for any H and L.
    pub(super) fn solve(&self, stiffness: f64, damping: f64, right: &[DVec3]) -> Vec<DVec3> {
        let nodes = self.diagonal.len();
        let own =
            |n: usize| self.diagonal[n] + DMat3::from_diagonal(DVec3::splat(stiffness * self.node_edges[n] + damping));
        let inverses: Vec<DMat3> = (0..nodes).map(|n| inverse(own(n))).collect();
        let times = |x: &[DVec3]| -> Vec<DVec3> {
            let row = |n: usize| self.times_data(x, n) + stiffness * self.times_laplacian(x, n) + damping * x[n];
            (0..nodes).into_par_iter().with_min_len(ROWS_A_TASK).map(row).collect()
        };
        conjugate_gradients(right, times, |r| r.iter().zip(&inverses).map(|(r, m)| *m * *r).collect())
    }
}

/// Solves a symmetric positive definite system by preconditioned conjugate gradients.
fn conjugate_gradients(
    right: &[DVec3],
    times: impl Fn(&[DVec3]) -> Vec<DVec3>,
    precondition: impl Fn(&[DVec3]) -> Vec<DVec3>,
) -> Vec<DVec3> {
    let dot = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f64>();
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

/// Returns the inverse of a positive definite block, or of its mean diagonal where rounding made it singular.
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

#[cfg(test)]
#[path = "normal_tests.rs"]
mod tests;

//! Tests of the normal equations on nearly singular matrices.

use glam::{DQuat, DVec3};
use nalgebra::{DMatrix, DVector};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use super::*;

const NODES: usize = 14;

/// Gaussians attached to nodes in a row; the last node has neither Gaussian nor neighbour.
struct Case {
    nodes: Vec<[u32; 4]>,
    weights: Vec<[f32; 4]>,
    edges: Vec<(u32, u32, f64)>,
    matrices: Vec<DMat3>,
    stiffness: f64,
    damping: f64,
}

impl Case {
    fn new(rng: &mut StdRng, matrix: impl Fn(&mut StdRng) -> DMat3, stiffness: f64) -> Self {
        let row = NODES as u32 - 1;
        let nodes: Vec<[u32; 4]> = (0..60).map(|g| [0, 1, 2, 3].map(|k| (g + k) % row)).collect();
        let weight = |_: &_| {
            let raw = [(); 4].map(|()| rng.random_range(0.0f32..1.0));
            raw.map(|w| w / raw.iter().sum::<f32>())
        };
        let weights = nodes.iter().map(weight).collect();
        let edges =
            (0..row).flat_map(|n| [(n, (n + 1) % row, 1.0 + f64::from(n % 3)), ((n + 1) % row, n, 0.5)]).collect();
        let matrices: Vec<DMat3> = nodes.iter().map(|_| matrix(rng)).collect();
        Self { nodes, weights, edges, matrices, stiffness, damping: 0.0 }
    }

    fn normal_matrix(&self) -> NormalMatrix {
        let mut normal = NormalMatrix::new(NODES, &self.nodes, &self.weights, &self.edges);
        let own: Vec<Carried> = self.matrices.iter().map(|&matrix| Carried { gradient: DVec3::ONE, matrix }).collect();
        normal.accumulate(&own, &mut [DVec3::ZERO; NODES], true);
        normal
    }

    /// Returns `x^T (H + stiffness L + damping) y` from the definitions.
    fn product(&self, x: &[DVec3], y: &[DVec3]) -> f64 {
        let mut sum = 0.0;
        for ((nodes, weights), matrix) in self.nodes.iter().zip(&self.weights).zip(&self.matrices) {
            let at = |v: &[DVec3]| (0..4).map(|k| v[nodes[k] as usize] * f64::from(weights[k])).sum::<DVec3>();
            sum += at(x).dot(*matrix * at(y));
        }
        for &(i, j, stiff) in &self.edges {
            let (i, j) = (i as usize, j as usize);
            sum += self.stiffness * stiff * (x[i] - x[j]).dot(y[i] - y[j]);
        }
        sum + (0..NODES).map(|n| self.damping * x[n].dot(y[n])).sum::<f64>()
    }

    /// Returns the value of the quadratic model `x^T A x / 2 - b^T x`, which starts at 0.
    fn model(&self, x: &[DVec3], right: &[DVec3]) -> f64 {
        0.5 * self.product(x, x) - x.iter().zip(right).map(|(x, b)| x.dot(*b)).sum::<f64>()
    }

    /// Returns the minimum of the model.
    fn lowest(&self, right: &[DVec3]) -> f64 {
        let unit = |k: usize| {
            let mut v = vec![DVec3::ZERO; NODES];
            v[k / 3][k % 3] = 1.0;
            v
        };
        let dense = DMatrix::from_fn(3 * NODES, 3 * NODES, |r, c| self.product(&unit(r), &unit(c)));
        let b = DVector::from_iterator(3 * NODES, right.iter().flat_map(DVec3::to_array));
        -0.5 * b.dot(&dense.lu().solve(&b).unwrap())
    }
}

fn turned(rng: &mut StdRng, diagonal: [f64; 3]) -> DMat3 {
    let axis = DVec3::from([(); 3].map(|()| rng.random_range(-2.0..2.0)));
    let turn = DMat3::from_quat(DQuat::from_scaled_axis(axis));
    let matrix = turn * DMat3::from_diagonal(diagonal.into()) * turn.transpose();
    // As the derivatives arrive: rounded, so that small eigenvalues may fall below 0.
    let round = |v: DVec3| v.as_vec3().as_dvec3();
    let matrix = DMat3::from_cols(round(matrix.x_axis), round(matrix.y_axis), round(matrix.z_axis));
    (matrix + matrix.transpose()) * 0.5
}

/// The last node has no gradient.
fn random_right(rng: &mut StdRng, len: usize, size: f64) -> Vec<DVec3> {
    let mut right: Vec<DVec3> =
        (0..len).map(|_| DVec3::from([(); 3].map(|()| rng.random_range(-1.0..1.0))) * size).collect();
    right[NODES - 1] = DVec3::ZERO;
    right
}

type Kind = (&'static str, fn(&mut StdRng) -> DMat3);

const KINDS: [Kind; 8] = [
    ("zero", |_| DMat3::ZERO),
    ("rank 1, each another direction", |rng| turned(rng, [1e4, 0.0, 0.0])),
    ("rank 1, all the same direction", |_| turned(&mut StdRng::seed_from_u64(1), [1e4, 0.0, 0.0])),
    ("condition 1e12", |rng| turned(rng, [1e4, 1e-2, 1e-8])),
    ("one in ten is 1e12 times the others", |rng| {
        let size = if rng.random_range(0..10) == 0 { 1e12 } else { 1.0 };
        turned(rng, [size, 0.3 * size, 0.0])
    }),
    ("1e-30", |rng| turned(rng, [1e-30; 3])),
    ("1e30", |rng| turned(rng, [1e30, 1e29, 0.0])),
    ("well-conditioned", |rng| turned(rng, [3.0, 2.0, 1.0])),
];

#[test]
fn nearly_singular_matrices_are_solved_to_within_a_hundredth_of_what_can_be_won() {
    let mut rng = StdRng::seed_from_u64(2);
    let mut worst = (1.0f64, String::new());
    for (name, matrix) in KINDS {
        for stiffness in [0.0, 1e-9, 1e4, 1e12] {
            let mut case = Case::new(&mut rng, matrix, stiffness);
            let normal = case.normal_matrix();
            // The least that the tracker damps with.
            case.damping = 1e-3 * normal.mean_diagonal() + 1e-11 * stiffness * normal.mean_edges();
            // Gradients have the size of the matrix, or nothing to do with it.
            for size in [normal.mean_diagonal().max(1e-6) * 0.01, 1.0] {
                let right = random_right(&mut rng, NODES, size);
                let x = normal.solve(stiffness, case.damping, &right);
                assert!(x.iter().all(|x| x.is_finite()), "{name}, stiffness {stiffness:e}");
                if case.damping == 0.0 {
                    assert!(x.iter().all(|x| *x == DVec3::ZERO), "{name}: nothing is known of the loss");
                    continue;
                }
                let won = case.model(&x, &right) / case.lowest(&right);
                if won < worst.0 {
                    worst = (won, format!("{name}, stiffness {stiffness:e}"));
                }
                assert!(won > 0.99 && won < 1.01, "{name}, stiffness {stiffness:e}: {won}");
            }
        }
    }
    println!("least share of what can be won: {:.5} ({})", worst.0, worst.1);
}

#[test]
fn with_next_to_no_damping_steps_are_finite_and_do_not_lead_uphill() {
    let mut rng = StdRng::seed_from_u64(3);
    for (name, matrix) in KINDS {
        for stiffness in [0.0, 1e-9, 1e4] {
            for damping in [1e-300, 1e-30, 1e-6] {
                let case = Case { damping, ..Case::new(&mut rng, matrix, stiffness) };
                let right = random_right(&mut rng, NODES, 1.0);
                let x = case.normal_matrix().solve(stiffness, damping, &right);
                let told = format!("{name}, stiffness {stiffness:e}, damping {damping:e}");
                assert!(x.iter().all(|x| x.is_finite()), "{told}: {x:?}");
                let along: f64 = x.iter().zip(&right).map(|(x, b)| x.dot(*b)).sum();
                assert!(along >= 0.0, "{told}: {along}");
            }
        }
    }
}

#[test]
fn poison_in_a_block_gives_no_step() {
    let mut rng = StdRng::seed_from_u64(5);
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut case = Case::new(&mut rng, |rng| turned(rng, [3.0, 2.0, 1.0]), 1.0);
        case.matrices[7].y_axis.z = bad;
        let right = random_right(&mut rng, NODES, 1.0);
        let x = case.normal_matrix().solve(1.0, 1.0, &right);
        assert!(x.iter().all(|x| *x == DVec3::ZERO), "{bad}: {x:?}");
        let mut right = random_right(&mut rng, NODES, 1.0);
        case.matrices[7] = DMat3::IDENTITY;
        right[3].x = bad;
        let x = case.normal_matrix().solve(1.0, 1.0, &right);
        assert!(x.iter().all(|x| *x == DVec3::ZERO), "{bad} to the right: {x:?}");
    }
}

//! Smoothest weights of the vertices that have none.

use std::collections::BTreeSet;

use flyrig_body::SkinWeights;
use glam::Vec3;
use rayon::prelude::*;

use crate::skin::laplacian::Laplacian;

/// Rings of known vertices around the unknown ones that take part: the bi-Laplacian reaches two rings far.
const RINGS: usize = 2;
/// Most iterations of a joint's solve, and the residual at which it ends, as a share of the first.
const ITERATIONS: usize = 1000;
const TOLERANCE: f64 = 1e-5;
/// Sweeps of the harmonic start.
const SWEEPS: usize = 200;

/// Returns the weights of the vertices where `known` has none; `None` for known ones, and for those that no path of edges joins to a
/// known one. Minimises the squared, area-weighted Laplacian of each joint's weight over the mesh.
pub(super) fn inpaint(
    positions: &[Vec3],
    triangles: &[[u32; 3]],
    known: &[Option<SkinWeights>],
) -> Vec<Option<SkinWeights>> {
    let mut filled = vec![None; known.len()];
    if known.iter().all(Option::is_some) {
        return filled;
    }
    let patch = Patch::new(&Laplacian::new(positions, triangles), known);
    if patch.free == 0 {
        return filled;
    }
    let joints: BTreeSet<u16> = patch.vertices[patch.free..]
        .iter()
        .filter_map(|vertex| known[*vertex as usize])
        .flat_map(|skin| skin.joints.into_iter().zip(skin.weights).filter(|(_, weight)| *weight > 0.0))
        .map(|(joint, _)| joint)
        .collect();
    let joints: Vec<u16> = joints.into_iter().collect();
    let solved: Vec<Vec<f64>> = joints.par_iter().map(|joint| patch.solve(&patch.given(known, *joint))).collect();
    for (row, vertex) in patch.vertices[..patch.free].iter().enumerate() {
        let influences: Vec<(u16, f32)> =
            joints.iter().zip(&solved).map(|(joint, weights)| (*joint, weights[row].max(0.0) as f32)).collect();
        filled[*vertex as usize] = SkinWeights::strongest(&influences);
    }
    filled
}

/// Unknown vertices and the known ones around them.
struct Patch {
    /// Vertices of the mesh: unknown ones first, then known ones.
    vertices: Vec<u32>,
    /// Number of unknown ones.
    free: usize,
    /// Neighbours within the patch by row, with weights.
    rows: Vec<Vec<(u32, f64)>>,
    area: Vec<f64>,
}

impl Patch {
    fn new(laplacian: &Laplacian, known: &[Option<SkinWeights>]) -> Self {
        const OUTSIDE: u32 = u32::MAX;
        let reached = joined(laplacian, known);
        let mut vertices: Vec<u32> = (0u32..).zip(&reached).filter(|(_, reached)| **reached).map(|(i, _)| i).collect();
        let free = vertices.len();
        let mut row_of = vec![OUTSIDE; known.len()];
        vertices.iter().enumerate().for_each(|(row, vertex)| row_of[*vertex as usize] = row as u32);
        let mut ring = 0..free;
        for _ in 0..RINGS {
            for row in ring.clone() {
                for (next, _) in &laplacian.rows[vertices[row] as usize] {
                    if row_of[*next as usize] == OUTSIDE {
                        row_of[*next as usize] = vertices.len() as u32;
                        vertices.push(*next);
                    }
                }
            }
            ring = ring.end..vertices.len();
        }
        let rows = vertices.iter().map(|vertex| {
            let inside =
                laplacian.rows[*vertex as usize].iter().map(|(next, weight)| (row_of[*next as usize], *weight));
            inside.filter(|(next, _)| *next != OUTSIDE).collect()
        });
        let rows = rows.collect();
        let area = vertices.iter().map(|vertex| laplacian.area[*vertex as usize]).collect();
        Self { vertices, free, rows, area }
    }

    /// Returns the weights of one joint: those of the known vertices, and 0.
    fn given(&self, known: &[Option<SkinWeights>], joint: u16) -> Vec<f64> {
        let weight = |vertex: &u32| {
            let Some(skin) = known[*vertex as usize] else { return 0.0 };
            let of_joint = skin.joints.iter().zip(skin.weights).filter(|(known, _)| **known == joint);
            of_joint.map(|(_, weight)| f64::from(weight)).sum()
        };
        self.vertices.iter().map(weight).collect()
    }

    /// Returns the unknown weights for given known ones: a harmonic start, then conjugate gradients on the bi-Laplacian.
    fn solve(&self, given: &[f64]) -> Vec<f64> {
        let mut x = given.to_vec();
        for _ in 0..SWEEPS {
            for row in 0..self.free {
                let (mut sum, mut total) = (0.0, 0.0);
                for (next, weight) in &self.rows[row] {
                    sum += weight * x[*next as usize];
                    total += weight;
                }
                x[row] = if total > 0.0 { sum / total } else { x[row] };
            }
        }
        let mut scratch = vec![0.0; x.len()];
        let mut image = vec![0.0; self.free];
        self.bilaplacian(&x, &mut scratch, &mut image);
        let inverse: Vec<f64> = (0..self.free).map(|row| 1.0 / self.diagonal(row)).collect();
        let mut residual: Vec<f64> = image.iter().map(|value| -value).collect();
        let mut step = vec![0.0; x.len()];
        let preconditioned: Vec<f64> = residual.iter().zip(&inverse).map(|(r, m)| r * m).collect();
        step[..self.free].copy_from_slice(&preconditioned);
        let mut rho = dot(&residual, &preconditioned);
        // Weights lie in 0..=1, so that a residual of a millionth is none.
        let end = (rho * TOLERANCE * TOLERANCE).max(1e-18);
        for _ in 0..ITERATIONS {
            if rho.is_nan() || rho <= end {
                break;
            }
            self.bilaplacian(&step, &mut scratch, &mut image);
            let curvature = dot(&step[..self.free], &image);
            if curvature.is_nan() || curvature <= 0.0 {
                break;
            }
            let along = rho / curvature;
            for row in 0..self.free {
                x[row] += along * step[row];
                residual[row] -= along * image[row];
            }
            let next: f64 = residual.iter().zip(&inverse).map(|(r, m)| r * r * m).sum();
            for row in 0..self.free {
                step[row] = residual[row] * inverse[row] + next / rho * step[row];
            }
            rho = next;
        }
        x.truncate(self.free);
        x
    }

    /// Computes `L M^-1 L x` in the unknown rows. Known vertices at the rim of the patch, whose neighbours lie outside, contribute
    /// nothing to `L x`: their weights do not depend on the unknown ones.
    fn bilaplacian(&self, x: &[f64], scratch: &mut [f64], image: &mut [f64]) {
        let apply = |x: &[f64], row: usize| -> f64 {
            self.rows[row].iter().map(|(next, weight)| weight * (x[row] - x[*next as usize])).sum()
        };
        for (row, scratch) in scratch.iter_mut().enumerate() {
            *scratch = apply(x, row) / self.area[row];
        }
        for (row, image) in image.iter_mut().enumerate() {
            *image = apply(scratch, row);
        }
    }

    /// Returns an element of the diagonal of `L M^-1 L`.
    fn diagonal(&self, row: usize) -> f64 {
        let own: f64 = self.rows[row].iter().map(|(_, weight)| weight).sum();
        let others: f64 = self.rows[row].iter().map(|(next, weight)| weight * weight / self.area[*next as usize]).sum();
        (own * own / self.area[row] + others).max(1e-12)
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Returns the unknown vertices that a path of edges joins to a known one.
fn joined(laplacian: &Laplacian, known: &[Option<SkinWeights>]) -> Vec<bool> {
    let mut reached = vec![false; known.len()];
    let mut open: Vec<usize> = (0..known.len()).filter(|i| known[*i].is_some()).collect();
    while let Some(i) = open.pop() {
        for (next, _) in &laplacian.rows[i] {
            let next = *next as usize;
            if known[next].is_none() && !reached[next] {
                reached[next] = true;
                open.push(next);
            }
        }
    }
    reached
}

//! Corrections of a take's node translations, learned with the Gaussians: tracking sees one frame at a time, the fit all of them.
//!
//! Each frame has a small shift of every node of the deformation graph. Three terms keep shifts from following noise: they are pulled to those
//! of neighbouring nodes, to those of the frames before and after, and, weakly, to zero.

use flyrig_fit::{Element, Neighbors};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::fit::pose_fit::usual;

/// Rates at the start and at the end, metres.
const RATE_M: [f32; 2] = [6e-3, 6e-4];
/// Differences at which the pull equals the usual derivative of the images, metres: to the neighbouring nodes, to the
/// frames beside, and to zero.
const BESIDE_M: f32 = 8e-3;
const FRAMES_M: f32 = 1e-2;
const ZERO_M: f32 = 3e-2;
/// Decay of the mean squares of the derivatives.
const BETA: f32 = 0.99;
/// Share of the usual derivatives in the denominator: hardly visible nodes move little.
const SHARE: f32 = 0.3;
/// Largest step, in rates.
const LARGEST: f32 = 5.0;
/// Bound on derivatives.
const LARGEST_SLOPE: f32 = 1e6;

/// Learned corrections of node translations.
#[derive(Debug, Clone)]
pub(crate) struct NodeFit {
    nodes: usize,
    /// Shifts, canonical metres, one row of nodes per frame.
    pub corrections: Vec<Element>,
    /// Mean squares of the derivatives over all frames, one per node.
    pub squares: Vec<f32>,
    neighbors: Neighbors,
}

impl NodeFit {
    /// Starts without corrections, for this many frames and these nodes, canonical metres.
    pub fn new(frames: usize, nodes: &[Vec3]) -> Self {
        Self {
            nodes: nodes.len(),
            corrections: vec![[0.0; 4]; frames * nodes.len()],
            squares: vec![0.0; nodes.len()],
            neighbors: Neighbors::new(nodes),
        }
    }

    fn row(&self, frame: usize) -> &[Element] {
        self.corrections.get(frame * self.nodes..(frame + 1) * self.nodes).unwrap_or_default()
    }

    /// Returns the corrected translations of a frame.
    pub fn corrected(&self, frame: usize, translations: &[DVec3]) -> Vec<DVec3> {
        let row = self.row(frame);
        let shift = |i: usize| row.get(i).map_or(DVec3::ZERO, |by| vector(by).as_dvec3());
        translations.iter().enumerate().map(|(i, translation)| *translation + shift(i)).collect()
    }

    /// Descends by one step, the `count`th from 1, along dL/d canonical centres of an image of `frame`. `nodes` and `weights` are those of each
    /// Gaussian; `progress` in 0..=1 is the completed share of all steps.
    pub fn descend(
        &mut self,
        frame: usize,
        centers: &[Element],
        (nodes, weights): (&[[u32; 4]], &[[f32; 4]]),
        count: u64,
        progress: f32,
    ) {
        if self.row(frame).is_empty() {
            return;
        }
        let slopes = self.slopes(centers, (nodes, weights));
        let unbias = 1.0 - BETA.powi(count.min(1 << 20) as i32);
        for (square, slope) in self.squares.iter_mut().zip(&slopes) {
            *square = BETA * *square + (1.0 - BETA) * slope.length_squared();
        }
        let floor = SHARE * (usual(&self.squares) / unbias).sqrt() + 1e-12;
        let progress = if progress.is_finite() { progress.clamp(0.0, 1.0) } else { 0.0 };
        let rate = RATE_M[0] * (RATE_M[1] / RATE_M[0]).powf(progress);
        let own = self.row(frame).to_vec();
        let beside: Vec<&[Element]> = [frame.checked_sub(1), Some(frame + 1)]
            .into_iter()
            .flatten()
            .map(|other| self.row(other))
            .filter(|row| !row.is_empty())
            .collect();
        let mean = |sum: Vec3, count: usize| sum / count.max(1) as f32;
        let most = Vec3::splat(LARGEST);
        let step = |i: usize| {
            let value = vector(&own[i]);
            let nearest = self.neighbors.of(i);
            let around = mean(nearest.iter().map(|&j| vector(&own[j as usize])).sum(), nearest.len());
            let frames = if beside.is_empty() {
                value
            } else {
                mean(beside.iter().map(|row| vector(&row[i])).sum(), beside.len())
            };
            let image = slopes[i] / ((self.squares[i] / unbias).sqrt() + floor);
            let pull = (value - around) / BESIDE_M + (value - frames) / FRAMES_M + value / ZERO_M;
            (value - rate * (image + pull).clamp(-most, most)).extend(0.0).to_array()
        };
        let moved: Vec<Element> = (0..self.nodes).into_par_iter().with_min_len(256).map(step).collect();
        let first = frame * self.nodes;
        self.corrections[first..first + self.nodes].copy_from_slice(&moved);
    }

    /// Returns dL/d translations of the nodes from dL/d canonical centres. How Gaussians grow where nodes part is left out. Derivatives that are
    /// not finite count as zero.
    fn slopes(&self, centers: &[Element], (nodes, weights): (&[[u32; 4]], &[[f32; 4]])) -> Vec<Vec3> {
        let mut slopes = vec![Vec3::ZERO; self.nodes];
        for ((slope, nodes), weights) in centers.iter().zip(nodes).zip(weights) {
            let slope = vector(slope);
            for (node, weight) in nodes.iter().zip(weights).filter(|_| slope.is_finite()) {
                if let Some(sum) = slopes.get_mut(*node as usize) {
                    *sum += slope * *weight;
                }
            }
        }
        let most = Vec3::splat(LARGEST_SLOPE);
        slopes.iter_mut().for_each(|slope| *slope = slope.clamp(-most, most));
        slopes
    }
}

fn vector([x, y, z, _]: &Element) -> Vec3 {
    Vec3::new(*x, *y, *z)
}

#[cfg(test)]
mod tests {
    use flyrig_body::displacement;
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    /// Nodes, and the nodes and weights of Gaussians.
    fn graph(seed: u64) -> (Vec<Vec3>, Vec<[u32; 4]>, Vec<[f32; 4]>) {
        let mut random = StdRng::seed_from_u64(seed);
        let nodes: Vec<Vec3> = (0..20).map(|_| Vec3::new(random.random(), random.random(), random.random())).collect();
        let mut of = Vec::new();
        let mut weights = Vec::new();
        for _ in 0..60 {
            of.push([0; 4].map(|_| random.random_range(0..20u32)));
            let parts = [0.0; 4].map(|_: f32| random.random_range(0.05f32..1.0));
            weights.push(parts.map(|part| part / parts.iter().sum::<f32>()));
        }
        (nodes, of, weights)
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let (nodes, of, weights) = graph(3);
        let fit = NodeFit::new(1, &nodes);
        let centers: Vec<Element> = (0..60).map(|i| [0, 1, 2, 3].map(|k| ((4 * i + k) as f32 * 1.3).sin())).collect();
        let found = fit.slopes(&centers, (&of, &weights));
        let loss = |translations: &[DVec3]| -> f64 {
            let rows = centers.iter().zip(&of).zip(&weights);
            rows.map(|((slope, of), weights)| {
                let moved = displacement(&nodes, translations, *of, *weights);
                (0..3).map(|k| f64::from(slope[k]) * f64::from(moved[k])).sum::<f64>()
            })
            .sum()
        };
        for node in 0..20 {
            for k in 0..3 {
                let at = |by: f64| {
                    let mut translations = vec![DVec3::ZERO; 20];
                    translations[node][k] = by;
                    loss(&translations)
                };
                let expected = (at(0.5) - at(-0.5)) / 1.0;
                assert!((expected - f64::from(found[node][k])).abs() < 1e-3 * (expected.abs() + 0.1), "{node} {k}");
            }
        }
    }

    #[test]
    fn without_images_corrections_vanish_and_frames_that_are_missing_have_none() {
        let (nodes, of, weights) = graph(4);
        let mut fit = NodeFit::new(3, &nodes);
        let mut random = StdRng::seed_from_u64(5);
        fit.corrections.iter_mut().for_each(|row| *row = [random.random_range(-0.02..0.02), 0.01, -0.01, 0.0]);
        let most = |fit: &NodeFit| fit.corrections.iter().map(|row| vector(row).length()).fold(0.0, f32::max);
        let before = most(&fit);
        for count in 1..=300 {
            fit.descend(count as usize % 3, &[], (&of, &weights), count, 0.0);
        }
        assert!(most(&fit) < 0.2 * before, "{before} {}", most(&fit));
        let given = vec![DVec3::X; 20];
        assert_eq!(fit.corrected(9, &given), given);
        assert!(fit.corrected(0, &[]).is_empty());
        let kept = fit.corrections.clone();
        fit.descend(9, &[[1.0; 4]; 60], (&of, &weights), 301, 0.0);
        assert_eq!(kept, fit.corrections);
        NodeFit::new(2, &[]).descend(0, &[[1.0; 4]; 60], (&of, &weights), 1, 0.0);
    }

    #[test]
    fn poison_is_left_out() {
        let (nodes, mut of, weights) = graph(6);
        of[3] = [99; 4];
        let mut fit = NodeFit::new(2, &nodes);
        let mut centers = vec![[1.0, -2.0, 0.5, 0.0]; 60];
        (centers[7], centers[8], centers[9]) = ([f32::NAN; 4], [f32::INFINITY; 4], [f32::MAX, -f32::MAX, 0.0, 0.0]);
        for count in 1..=40 {
            fit.descend(count as usize % 2, &centers, (&of, &weights), count, f32::NAN);
        }
        assert!(fit.corrections.iter().flatten().chain(&fit.squares).all(|value| value.is_finite()));
        assert!(fit.corrections.iter().any(|row| vector(row).length() > 1e-3));
    }
}

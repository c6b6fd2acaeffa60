//! Thickness of clothes per body part: where no camera looks, they are as thick as on the seen part of the same limb.

use glam::DVec3;

use crate::deform::normal::NormalMatrix;

/// Weight of the mean thickness of all parts but loose ones, as a share of all weights: a part that is hardly seen resembles the others.
const LEAST_SHARE: f64 = 0.01;
/// Share of a frame set in the known thickness, after the first.
const RATE: f64 = 0.5;

/// Mean displacement of each part along its normals, where the images constrain it. Smoothness (Eq. 4) is measured from
/// there, so that the unseen side of a sleeve is not dragged along by the seen one but follows it outwards.
#[derive(Debug)]
pub(super) struct Thickness {
    /// Canonical normals of the nodes, and their parts: odd for those of loose clothes.
    normals: Vec<DVec3>,
    parts: Vec<usize>,
    /// Plausible range, metres.
    range_m: [f64; 2],
    /// Thickness of each part, metres; `None` before the first frame set.
    known: Option<Vec<f64>>,
}

impl Thickness {
    /// Creates an unknown thickness from one normal and one part per node, and whether it belongs to loose clothes.
    pub(super) fn new(normals: Vec<DVec3>, parts: impl Iterator<Item = (usize, bool)>, range_m: [f64; 2]) -> Self {
        let parts = parts.map(|(part, is_loose)| 2 * part + usize::from(is_loose)).collect();
        Self { normals, parts, range_m, known: None }
    }

    /// Forgets the thickness.
    pub(super) fn forget(&mut self) {
        self.known = None;
    }

    /// Returns the displacement of a node clothed like its part, canonical metres.
    pub(super) fn offset(&self, node: usize) -> DVec3 {
        let Some(known) = &self.known else { return DVec3::ZERO };
        self.normals[node] * known[self.parts[node]]
    }

    /// Learns from the result of a frame set: translations beyond `mean`. A node's weight is the information of the images along its normal, `n^T H n`.
    pub(super) fn learn(&mut self, translations: &[DVec3], mean: &[DVec3], matrix: &NormalMatrix) {
        let count = self.parts.iter().max().map_or(0, |most| most + 1);
        let mut sums = vec![(0.0, 0.0); count];
        for (node, ((t, mean), normal)) in translations.iter().zip(mean).zip(&self.normals).enumerate() {
            let weight = normal.dot(matrix.diagonal_block(node) * *normal);
            let along = (*t - *mean).dot(*normal).clamp(self.range_m[0], self.range_m[1]);
            if weight.is_finite() && weight > 0.0 && along.is_finite() {
                let (weights, sum) = &mut sums[self.parts[node]];
                *weights += weight;
                *sum += weight * along;
            }
        }
        let all_weights: f64 = sums.iter().map(|(weights, _)| weights).sum();
        if all_weights <= 0.0 {
            return;
        }
        let (tight_weights, tight) = sums.iter().step_by(2).fold((0.0, 0.0), |(w, s), part| (w + part.0, s + part.1));
        let least = LEAST_SHARE * all_weights;
        let usual = if tight_weights > 0.0 { least * tight / tight_weights } else { 0.0 };
        let now = sums.iter().map(|(weights, sum)| (sum + usual) / (weights + least));
        self.known = Some(match self.known.take() {
            None => now.collect(),
            Some(known) => known.into_iter().zip(now).map(|(known, now)| known + (now - known) * RATE).collect(),
        });
    }
}

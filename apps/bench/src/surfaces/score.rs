//! Distance of a surface from the true one.

use std::fmt::Write as _;

use glam::Vec3;
use rayon::prelude::*;
use serde::Serialize;

use super::{true_surface::TrueSurface, visibility::seen_by};
use crate::harness::surface::Points;

/// Points spread over a surface that is scored.
const POINTS: usize = 300_000;
/// Points whose nearest neighbours are searched; a fifth of those that they are searched among.
const EVERY: usize = 5;

/// Scores of a surface in one frame, or their means over frames. Lengths in millimetres.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub(super) struct SurfaceScore {
    /// Mean distance from the surface to the true one.
    pub accuracy_mm: f64,
    /// Mean distance from the true surface to this one: all of it, what an input camera sees at this instant, and the rest.
    pub completeness_mm: f64,
    pub seen_mm: f64,
    pub unseen_mm: f64,
    /// Mean of accuracy and completeness.
    pub chamfer_mm: f64,
    /// Chamfer of what cameras on all sides see of either surface: the truth has no legs under a long skirt, and a mesh may have them.
    pub outer_mm: f64,
    /// Mean absolute cosine between the normals of nearest points, both ways.
    pub normals: f64,
    /// Harmonic means of the shares of both surfaces that lie within 5 and 10 mm of each other.
    pub f5: f64,
    pub f10: f64,
}

impl SurfaceScore {
    /// Scores a surface in world metres.
    pub fn of(positions: &[Vec3], triangles: &[[u32; 3]], truth: &TrueSurface) -> Self {
        let ours = Points::on(positions, triangles, POINTS);
        let to_truth = Matches::of(&ours, &truth.points);
        let to_ours = Matches::of(&truth.points, &ours);
        let every = |flags: &[bool]| -> Vec<bool> { flags.iter().copied().step_by(EVERY).collect() };
        let accuracy_mm = to_truth.mean_mm(|_| true, &[]);
        let seen = every(&truth.is_seen);
        let our_outer = every(&seen_by(&truth.around, positions, triangles, &ours));
        let outer = [(&to_truth, our_outer), (&to_ours, every(&truth.is_outer))];
        let completeness_mm = to_ours.mean_mm(|_| true, &seen);
        let score = |within_m: f32| {
            let (precision, recall) = (to_truth.share(within_m), to_ours.share(within_m));
            if precision + recall > 0.0 { 2.0 * precision * recall / (precision + recall) } else { 0.0 }
        };
        Self {
            accuracy_mm,
            completeness_mm,
            seen_mm: to_ours.mean_mm(|seen| seen, &seen),
            unseen_mm: to_ours.mean_mm(|seen| !seen, &seen),
            chamfer_mm: 0.5 * (accuracy_mm + completeness_mm),
            outer_mm: 0.5 * outer.map(|(matches, flags)| matches.mean_mm(|outer| outer, &flags)).iter().sum::<f64>(),
            normals: 0.5 * (to_truth.normals() + to_ours.normals()),
            f5: score(0.005),
            f10: score(0.010),
        }
    }

    /// Returns the mean of scores; zeros without any.
    pub fn mean(scores: &[Self]) -> Self {
        let count = scores.len().max(1) as f64;
        let mean = |value: fn(&Self) -> f64| scores.iter().map(value).sum::<f64>() / count;
        Self {
            accuracy_mm: mean(|score| score.accuracy_mm),
            completeness_mm: mean(|score| score.completeness_mm),
            seen_mm: mean(|score| score.seen_mm),
            unseen_mm: mean(|score| score.unseen_mm),
            chamfer_mm: mean(|score| score.chamfer_mm),
            outer_mm: mean(|score| score.outer_mm),
            normals: mean(|score| score.normals),
            f5: mean(|score| score.f5),
            f10: mean(|score| score.f10),
        }
    }

    /// Names of the columns of [`Self::cells`].
    pub const COLUMNS: &str =
        "accuracy | completeness | seen | unseen | chamfer | outer chamfer | normals | F 5 mm | F 10 mm";

    /// Returns the columns of a table.
    pub fn cells(&self) -> String {
        let mut text = String::new();
        let lengths = [self.accuracy_mm, self.completeness_mm, self.seen_mm, self.unseen_mm];
        for length in lengths {
            let _ = write!(text, "{length:.2} | ");
        }
        let _ = write!(text, "**{:.2}** | {:.2} | ", self.chamfer_mm, self.outer_mm);
        let _ = write!(text, "{:.3} | {:.3} | {:.3}", self.normals, self.f5, self.f10);
        text
    }
}

/// Distance in metres, and absolute cosine between normals, of points and their nearest neighbours.
struct Matches(Vec<(f32, f32)>);

impl Matches {
    fn of(from: &Points, to: &Points) -> Self {
        let rows: Vec<usize> = (0..from.points.len()).step_by(EVERY).collect();
        let found = rows.par_iter().map(|&row| {
            let (nearest, distance) = to.nearest(from.points[row]);
            (distance, nearest.map_or(0.0, |at| from.normals[row].dot(to.normals[at]).abs()))
        });
        Self(found.collect())
    }

    /// Returns the mean distance of the points that are chosen by what `flags` says of them, millimetres; 0 without points.
    fn mean_mm(&self, is_chosen: impl Fn(bool) -> bool, flags: &[bool]) -> f64 {
        let flags = flags.iter().copied().chain(std::iter::repeat(false));
        let chosen = || self.0.iter().zip(flags.clone()).filter(|(_, flag)| is_chosen(*flag));
        1e3 * chosen().map(|((distance, _), _)| f64::from(*distance)).sum::<f64>() / chosen().count().max(1) as f64
    }

    fn share(&self, within_m: f32) -> f64 {
        self.0.iter().filter(|(distance, _)| *distance < within_m).count() as f64 / self.0.len().max(1) as f64
    }

    fn normals(&self) -> f64 {
        self.0.iter().map(|(_, cosine)| f64::from(*cosine)).sum::<f64>() / self.0.len().max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Square of 1 m in the plane of x and y.
    fn square(z: f32) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        (corners.map(|[x, y]: [f32; 2]| Vec3::new(x, y, z)).to_vec(), vec![[0, 1, 2], [0, 2, 3]])
    }

    fn truth() -> TrueSurface {
        let (positions, triangles) = square(0.0);
        let points = Points::on(&positions, &triangles, 100_000);
        let is_seen = points.points.iter().map(|point| point.x < 0.5).collect();
        TrueSurface { is_seen, ..TrueSurface::new(positions, triangles, points, &[]) }
    }

    #[test]
    fn a_lifted_surface_is_as_far_as_it_was_lifted() {
        let truth = truth();
        let (positions, triangles) = square(0.007);
        let score = SurfaceScore::of(&positions, &triangles, &truth);
        let SurfaceScore { accuracy_mm, completeness_mm, seen_mm, unseen_mm, chamfer_mm, outer_mm, .. } = score;
        for length in [accuracy_mm, completeness_mm, seen_mm, unseen_mm, chamfer_mm, outer_mm] {
            assert!((length - 7.0).abs() < 0.2, "{score:?}");
        }
        assert!(score.normals > 0.999 && score.f5 < 1e-9 && score.f10 > 0.99, "{score:?}");
    }

    #[test]
    fn a_missing_half_is_incomplete_but_accurate() {
        let truth = truth();
        let (mut positions, triangles) = square(0.0);
        for position in &mut positions {
            position.x *= 0.5;
        }
        let score = SurfaceScore::of(&positions, &triangles, &truth);
        assert!(score.accuracy_mm < 2.5 && score.seen_mm < 2.5, "{score:?}");
        assert!(score.unseen_mm > 100.0 && (score.chamfer_mm - score.completeness_mm / 2.0).abs() < 1.5, "{score:?}");
        assert!((score.f10 - 2.0 / 3.0).abs() < 0.02, "all of ours and half of the truth: {score:?}");
    }

    #[test]
    fn an_empty_or_poisoned_surface_is_far_from_everything() {
        let truth = truth();
        let nan = [Vec3::splat(f32::NAN); 3];
        for score in [SurfaceScore::of(&[], &[], &truth), SurfaceScore::of(&nan, &[[0, 1, 2]], &truth)] {
            assert!((score.completeness_mm - 160.0).abs() < 1e-3 && score.f10 == 0.0, "{score:?}");
        }
    }
}

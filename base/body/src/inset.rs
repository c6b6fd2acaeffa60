//! Insetting of Gaussians below the surface that they render.

use rayon::prelude::*;

use crate::SurfaceGaussians;
use crate::point_grid::PointGrid;

/// Distance of the rendered silhouette (alpha one half) of a closed surface of Gaussians from their centres, in scales.
const DRAWN_BEYOND: f32 = 1.7;
/// Largest thickness that is measured, metres.
const THICKEST_M: f32 = 0.05;
/// Largest part of half the thickness by which a Gaussian moves.
const OF_HALF: f32 = 0.9;
/// Smallest remaining fraction of a Gaussian's scale; smaller ones would leave holes.
const LEAST_SCALE: f32 = 0.6;

impl SurfaceGaussians {
    /// Returns the Gaussians moved inwards, so that their rendered silhouette ends at the surface. In thinner parts (fingers, ears)
    /// they move to the middle and shrink.
    #[must_use]
    pub fn inset(&self) -> Self {
        let mut moved = self.clone();
        // Only points less deep than this limit a movement. Those that count lie less than half their depth aside: within
        // sqrt(1.25) < 1.12 depths.
        let radius = |scale_m: f32| THICKEST_M.min(1.12 * DRAWN_BEYOND * scale_m / (0.5 * OF_HALF));
        let mean = self.scale_m.iter().sum::<f32>() / self.len().max(1) as f32;
        let grid = PointGrid::new(&self.positions, 0.5 * radius(mean));
        let half_thickness = |i: usize| {
            let (point, normal) = (self.positions[i], self.normals[i]);
            let mut least = THICKEST_M;
            grid.within(point, radius(self.scale_m[i]), |j, _| {
                // On the other side, and below this point.
                let depth = (point - self.positions[j]).dot(normal);
                if depth > 1e-3 && self.normals[j].dot(normal) < -0.5 {
                    let aside = (point - self.positions[j] - normal * depth).length();
                    if aside < 0.5 * depth {
                        least = least.min(depth);
                    }
                }
            });
            0.5 * least
        };
        let halves: Vec<f32> = (0..self.len()).into_par_iter().map(half_thickness).collect();
        for (i, half) in halves.into_iter().enumerate() {
            let wanted = DRAWN_BEYOND * self.scale_m[i];
            let by = wanted.min(OF_HALF * half);
            moved.positions[i] = self.positions[i] - self.normals[i] * by;
            moved.depth_m[i] = self.depth_m[i] + by;
            moved.scale_m[i] = self.scale_m[i] * (by / wanted.max(1e-12)).clamp(LEAST_SCALE, 1.0);
        }
        moved
    }
}

#[cfg(test)]
mod tests {
    use crate::{ShapeParams, default_template, sample_surface};

    #[test]
    fn centres_move_inwards_and_not_through_thin_parts() {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 20_000, 1).unwrap();
        let inset = surface.inset();
        let mut shrunk = 0;
        for i in 0..surface.len() {
            let by = (surface.positions[i] - inset.positions[i]).dot(surface.normals[i]);
            assert!(by > 0.0 && by <= 1.7 * surface.scale_m[i] + 1e-6, "{i}: {by}");
            assert!((by - inset.depth_m[i]).abs() < 1e-6 && surface.depth_m[i] == 0.0, "{i}: {by}");
            assert!(inset.scale_m[i] <= surface.scale_m[i] && inset.scale_m[i] >= 0.59 * surface.scale_m[i]);
            shrunk += usize::from(inset.scale_m[i] < surface.scale_m[i]);
        }
        assert!((200..10_000).contains(&shrunk), "fingers and ears, not the trunk: {shrunk}");
        assert_eq!((inset.normals, inset.skin), (surface.normals, surface.skin));
    }

    #[test]
    fn thickness_is_that_of_a_plain_search() {
        let template = default_template(&ShapeParams::default()).unwrap();
        for count in [2_000, 20_000] {
            let surface = sample_surface(&template, count, 2).unwrap();
            let inset = surface.inset();
            for i in (0..count).step_by(count / 500) {
                let (point, normal) = (surface.positions[i], surface.normals[i]);
                let depths = (0..count).filter_map(|j| {
                    let away = point - surface.positions[j];
                    let depth = away.dot(normal);
                    let is_below = depth > 1e-3 && (away - normal * depth).length() < 0.5 * depth;
                    let is_other_side = surface.normals[j].dot(normal) < -0.5;
                    (is_below && is_other_side && away.length() <= 0.05).then_some(depth)
                });
                let expected = (1.7 * surface.scale_m[i]).min(0.45 * depths.fold(0.05, f32::min));
                let found = inset.depth_m[i];
                assert!((found - expected).abs() < 1e-6, "{i} of {count}: {found} {expected}");
            }
        }
    }
}

//! Derivatives by canonical displacements from derivatives by world centres, through each Gaussian's blended bone matrix.

use flyrig_body::{SkinWeights, skin_jacobian_f64};
use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::deform::data::PointDerivatives;

/// Derivatives of one Gaussian.
#[derive(Debug, Clone, Copy)]
pub(super) struct Carried {
    /// dL/d t_x, per metre.
    pub gradient: DVec3,
    /// Gauss-Newton matrix by t_x, per square metre.
    pub matrix: DMat3,
}

/// Returns `B^T g` and `B^T H B` of each Gaussian, with B its blended bone matrix (d LBS(x + t_x) / d t_x), zero for unseen
/// ones; and the number of Gaussians that were dropped because a number was not finite.
pub(super) fn to_canonical(derivatives: &PointDerivatives, skin: &[SkinWeights]) -> (Vec<Carried>, usize) {
    let one = |g: usize| -> Result<Carried, ()> {
        let gradient = derivatives.gradient.get(g).copied().unwrap_or_default();
        // NaN counts as seen, and is dropped below.
        if gradient[3] <= 0.0 {
            return Ok(UNSEEN);
        }
        let bones = skin_jacobian_f64(&derivatives.world_from_canonical, &skin[g]);
        let world = DVec3::new(gradient[0].into(), gradient[1].into(), gradient[2].into());
        let zero = [0.0; 4];
        let first = derivatives.curvature.get(2 * g).unwrap_or(&zero).map(f64::from);
        let second = derivatives.curvature.get(2 * g + 1).unwrap_or(&zero).map(f64::from);
        let h = DMat3::from_cols(
            DVec3::new(first[0], first[1], first[2]),
            DVec3::new(first[1], first[3], second[0]),
            DVec3::new(first[2], second[0], second[1]),
        );
        let carried = Carried { gradient: bones.transpose() * world, matrix: bones.transpose() * h * bones };
        let fine = gradient[3].is_finite() && carried.gradient.is_finite() && carried.matrix.is_finite();
        if fine { Ok(carried) } else { Err(()) }
    };
    let all: Vec<Result<Carried, ()>> =
        (0..skin.len()).into_par_iter().with_min_len(GAUSSIANS_A_TASK).map(one).collect();
    let dropped = all.iter().filter(|one| one.is_err()).count();
    (all.into_iter().map(|one| one.unwrap_or(UNSEEN)).collect(), dropped)
}

/// Derivatives of an unseen Gaussian.
const UNSEEN: Carried = Carried { gradient: DVec3::ZERO, matrix: DMat3::ZERO };
/// Gaussians per parallel task.
const GAUSSIANS_A_TASK: usize = 1024;

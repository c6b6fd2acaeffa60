//! Exponential, logarithm and Jacobians of rotations, SO(3).
//!
//! A rotation vector is axis times angle in radians. Perturbations are on the left: `exp(δ) R`.

use glam::{DMat3, DQuat, DVec3};

/// Angles below this use the Taylor series of the left Jacobian, radians.
const SERIES_ANGLE: f64 = 0.1;

/// Returns the unit quaternion of a rotation vector.
#[must_use]
pub fn exp_rotation(v: DVec3) -> DQuat {
    let angle = v.length();
    if angle < 1e-12 {
        return DQuat::from_xyzw(v.x * 0.5, v.y * 0.5, v.z * 0.5, 1.0).normalize();
    }
    DQuat::from_axis_angle(v / angle, angle)
}

/// Returns the rotation vector of a unit quaternion, at most π long. Accurate near 0 and near π; at π the sign of the
/// axis follows the quaternion's.
#[must_use]
pub fn log_rotation(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let v = DVec3::new(q.x, q.y, q.z);
    let sine = v.length();
    if sine < 1e-9 {
        return v * 2.0;
    }
    v * (2.0 * sine.atan2(q.w) / sine)
}

/// Returns the matrix of the cross product: `skew(v) * x == v × x`.
#[must_use]
pub fn skew(v: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0))
}

/// Returns the left Jacobian of SO(3): `exp(v + d) ≈ exp(J d) exp(v)` for small `d`.
#[must_use]
pub fn left_jacobian(v: DVec3) -> DMat3 {
    let angle = v.length();
    let square = angle * angle;
    // (1 - cos θ) / θ² and (θ - sin θ) / θ³.
    let (first, second) = if angle < SERIES_ANGLE {
        (
            0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0)),
            (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))) / 6.0,
        )
    } else {
        let half = (0.5 * angle).sin();
        (2.0 * half * half / square, (angle - angle.sin()) / (square * angle))
    };
    let cross = skew(v);
    DMat3::IDENTITY + cross * first + cross * cross * second
}

/// Returns the inverse of the left Jacobian: the derivative of `log(exp(δ) R)` by `δ` at 0, where `v = log R`. Singular
/// at an angle of 2π, which no logarithm has.
#[must_use]
pub fn left_jacobian_inverse(v: DVec3) -> DMat3 {
    let angle = v.length();
    let cross = skew(v);
    // (1 - (θ/2) cot(θ/2)) / θ², by its series near 0.
    let factor = if angle < 1e-4 { 1.0 / 12.0 } else { (1.0 - 0.5 * angle / (0.5 * angle).tan()) / (angle * angle) };
    DMat3::IDENTITY - cross * 0.5 + cross * cross * factor
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use flyrig_model::SplitMix64;

    use super::*;
    use crate::testing::RandomGeometry as _;

    /// The exponential by its power series after halving the angle, which shares nothing with the quaternions.
    fn series(v: DVec3) -> DMat3 {
        let small = skew(v) * (1.0 / 1024.0);
        let (mut sum, mut term) = (DMat3::IDENTITY, DMat3::IDENTITY);
        for k in 1..12 {
            term = term * small * (1.0 / f64::from(k));
            sum += term;
        }
        (0..10).fold(sum, |m, _| m * m)
    }

    fn vectors() -> Vec<DVec3> {
        let mut random = SplitMix64(3);
        let axes: Vec<DVec3> = (0..20).map(|_| random.vector().normalize()).chain([DVec3::X, DVec3::NEG_Z]).collect();
        let angles = [0.0, 1e-300, 1e-160, 1e-13, 1e-12, 1e-9, 1e-7, 1e-4, 0.09999, 0.1, 0.5, 2.0, 3.0];
        let near_pi = [PI - 1e-3, PI - 1e-7, PI - 1e-12];
        axes.iter().flat_map(|axis| angles.iter().chain(&near_pi).map(move |angle| *axis * *angle)).collect()
    }

    #[test]
    fn exponential_matches_the_power_series_and_logarithm_inverts_it() {
        for v in vectors() {
            let matrix = DMat3::from_quat(exp_rotation(v));
            assert!((matrix - series(v)).to_cols_array().iter().all(|d| d.abs() < 1e-12), "{v}");
            let error = (log_rotation(exp_rotation(v)) - v).length();
            assert!(error <= 4e-15 * v.length(), "{v}: {error}");
            assert!((log_rotation(-exp_rotation(v)) - v).length() <= 4e-15 * v.length(), "{v}, the other quaternion");
        }
        let half_turn = log_rotation(exp_rotation(DVec3::Y * PI));
        assert!((half_turn.abs() - DVec3::Y * PI).length() < 1e-15 * 10.0, "{half_turn}");
    }

    #[test]
    fn jacobians_match_differences_and_invert_each_other() {
        const STEP: f64 = 1e-6;
        for v in vectors() {
            let (jacobian, inverse) = (left_jacobian(v), left_jacobian_inverse(v));
            let product = jacobian * inverse - DMat3::IDENTITY;
            assert!(product.to_cols_array().iter().all(|d| d.abs() < 1e-13), "{v}: {product}");
            let near_pi = v.length() > PI - 2.0 * STEP;
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                let exp = |s: f64| log_rotation(exp_rotation(v + axis * s) * exp_rotation(v).inverse());
                let numeric = (exp(STEP) - exp(-STEP)) / (2.0 * STEP);
                assert!((jacobian * axis - numeric).length() < 1e-8, "{v} {axis}");
                // The logarithm jumps at π.
                if !near_pi {
                    let log = |s: f64| log_rotation(exp_rotation(axis * s) * exp_rotation(v));
                    let numeric = (log(STEP) - log(-STEP)) / (2.0 * STEP);
                    assert!((inverse * axis - numeric).length() < 1e-8, "{v} {axis}");
                }
            }
        }
    }

    #[test]
    fn logarithm_and_exponential_keep_values_that_are_not_finite() {
        let nan = DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0);
        assert!(!log_rotation(nan).is_finite() && !exp_rotation(DVec3::NAN).is_finite());
    }
}

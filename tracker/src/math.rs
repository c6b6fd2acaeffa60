//! Small helpers on rotations and numbers.

use glam::{DMat3, DQuat, DVec3};

/// Rotation vector (axis times angle in radians, at most π) of a unit quaternion.
pub(crate) fn log_rotation(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let v = DVec3::new(q.x, q.y, q.z);
    let sine = v.length();
    if sine < 1e-9 {
        return v * 2.0;
    }
    v * (2.0 * sine.atan2(q.w) / sine)
}

/// Unit quaternion of a rotation vector.
pub(crate) fn exp_rotation(v: DVec3) -> DQuat {
    let angle = v.length();
    if angle < 1e-12 {
        return DQuat::from_xyzw(v.x * 0.5, v.y * 0.5, v.z * 0.5, 1.0).normalize();
    }
    DQuat::from_axis_angle(v / angle, angle)
}

/// Derivative of `log(exp(δ) R)` by `δ` at 0, where `v = log R` (inverse left Jacobian of SO(3)).
pub(crate) fn log_jacobian(v: DVec3) -> DMat3 {
    let angle = v.length();
    let cross = DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0));
    // (1 - (θ/2) cot(θ/2)) / θ², by its series near 0.
    let factor = if angle < 1e-4 { 1.0 / 12.0 } else { (1.0 - 0.5 * angle / (0.5 * angle).tan()) / (angle * angle) };
    DMat3::IDENTITY - cross * 0.5 + cross * cross * factor
}

/// Median, reordering the values; `None` when there are none.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_undoes_exp_and_its_jacobian_matches_differences() {
        for v in [DVec3::ZERO, DVec3::new(1e-7, 0.0, 0.0), DVec3::new(0.3, -1.2, 0.5), DVec3::new(0.0, 2.9, 0.4)] {
            assert!((log_rotation(exp_rotation(v)) - v).length() < 1e-9, "{v}");
            let jacobian = log_jacobian(v);
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                const STEP: f64 = 1e-6;
                let at = |s: f64| log_rotation(exp_rotation(axis * s) * exp_rotation(v));
                let numeric = (at(STEP) - at(-STEP)) / (2.0 * STEP);
                assert!((jacobian * axis - numeric).length() < 1e-6, "{v} {axis}");
            }
        }
    }

    #[test]
    fn median_of_nothing_is_none() {
        assert_eq!(median(&mut []), None);
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
    }
}

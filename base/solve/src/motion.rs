//! Rigid motions, SE(3).

use std::ops::Mul;

use glam::{DMat3, DQuat, DVec3};

use crate::rotation::{exp_rotation, left_jacobian, left_jacobian_inverse, log_rotation};

/// Rotation followed by a translation: `x -> R x + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidMotion {
    /// Unit quaternion of `R`.
    pub rotation: DQuat,
    /// Translation `t`.
    pub translation: DVec3,
}

impl RigidMotion {
    /// Motion that moves nothing.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Returns the exponential of a twist: rotation vector `turn`, radians, and `shift`, from which the translation follows as
    /// `t = J shift` with the left Jacobian `J`.
    #[must_use]
    pub fn exp(turn: DVec3, shift: DVec3) -> Self {
        Self { rotation: exp_rotation(turn), translation: left_jacobian(turn) * shift }
    }

    /// Returns the twist (turn, shift) whose exponential this is, with a turn of at most π.
    #[must_use]
    pub fn log(&self) -> (DVec3, DVec3) {
        let turn = log_rotation(self.rotation);
        (turn, left_jacobian_inverse(turn) * self.translation)
    }

    /// Returns the inverse motion.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Transforms a point.
    #[must_use]
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// Returns the motion after a small rotation vector `turn` on the left and a shift in the target's axes:
    /// `x -> exp(turn) R x + t + shift`. Cheaper to differentiate than [`Self::exp`]: see [`Self::apply_jacobian`].
    #[must_use]
    pub fn moved(&self, turn: DVec3, shift: DVec3) -> Self {
        Self { rotation: (exp_rotation(turn) * self.rotation).normalize(), translation: self.translation + shift }
    }

    /// Returns the derivatives of `self.moved(turn, shift).apply(point)` by the turn and by the shift at 0, and by the
    /// point.
    #[must_use]
    pub fn apply_jacobian(&self, point: DVec3) -> [DMat3; 3] {
        let turned = self.rotation * point;
        [-crate::skew(turned), DMat3::IDENTITY, DMat3::from_quat(self.rotation)]
    }
}

impl Mul for RigidMotion {
    type Output = Self;

    /// Chains two motions: the right one is applied first.
    fn mul(self, first: Self) -> Self {
        Self {
            rotation: (self.rotation * first.rotation).normalize(),
            translation: self.rotation * first.translation + self.translation,
        }
    }
}

#[cfg(test)]
mod tests {
    use flyrig_model::SplitMix64;

    use super::*;
    use crate::testing::RandomGeometry as _;

    fn random_motion(random: &mut SplitMix64) -> RigidMotion {
        RigidMotion { rotation: random.rotation(), translation: random.vector() * 3.0 }
    }

    #[test]
    fn exponential_is_the_limit_of_many_small_motions_and_logarithm_inverts_it() {
        let mut random = SplitMix64(4);
        for size in [0.0, 1e-9, 1e-3, 1.0, 3.1] {
            let (turn, shift) = (random.vector().normalize() * size, random.vector());
            let motion = RigidMotion::exp(turn, shift);
            // 2^20 equal steps, by squaring.
            let part = RigidMotion { rotation: exp_rotation(turn / 1048576.0), translation: shift / 1048576.0 };
            let reference = (0..20).fold(part, |m, _| m * m);
            assert!((motion.translation - reference.translation).length() < 1e-5, "{turn}");
            assert!(motion.rotation.dot(reference.rotation).abs() > 1.0 - 1e-12, "{turn}");
            let (back_turn, back_shift) = motion.log();
            assert!((back_turn - turn).length() < 1e-14 && (back_shift - shift).length() < 1e-13, "{turn}");
        }
    }

    #[test]
    fn motions_form_a_group() {
        let mut random = SplitMix64(5);
        for _ in 0..100 {
            let (a, b, point) = (random_motion(&mut random), random_motion(&mut random), random.vector());
            assert!(((a * b).apply(point) - a.apply(b.apply(point))).length() < 1e-14);
            assert!((a.inverse().apply(a.apply(point)) - point).length() < 1e-14);
            assert!((RigidMotion::IDENTITY * a).translation == a.translation);
        }
    }

    #[test]
    fn jacobians_match_differences() {
        const STEP: f64 = 1e-6;
        let mut random = SplitMix64(6);
        for _ in 0..50 {
            let (motion, point) = (random_motion(&mut random), random.vector());
            let jacobians = motion.apply_jacobian(point);
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                let moved: [&dyn Fn(f64) -> DVec3; 3] = [
                    &|s| motion.moved(axis * s, DVec3::ZERO).apply(point),
                    &|s| motion.moved(DVec3::ZERO, axis * s).apply(point),
                    &|s| motion.apply(point + axis * s),
                ];
                for (jacobian, at) in jacobians.iter().zip(moved) {
                    let numeric = (at(STEP) - at(-STEP)) / (2.0 * STEP);
                    assert!((*jacobian * axis - numeric).length() < 1e-8, "{motion:?} {axis}");
                }
            }
        }
    }
}

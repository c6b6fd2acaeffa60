//! Random inputs for the tests.

use flyrig_model::SplitMix64;
use glam::{DQuat, DVec3};

/// Geometry from seeded numbers.
pub(crate) trait RandomGeometry {
    /// Returns a point of the cube from -1 to 1.
    fn vector(&mut self) -> DVec3;
    /// Returns a rotation by any angle.
    fn rotation(&mut self) -> DQuat;
}

impl RandomGeometry for SplitMix64 {
    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.signed(), self.signed(), self.signed())
    }

    fn rotation(&mut self) -> DQuat {
        DQuat::from_xyzw(self.signed(), self.signed(), self.signed(), self.signed()).normalize()
    }
}

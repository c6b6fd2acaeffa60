//! Units and axes of splat files.

use clap::ValueEnum;
use glam::Quat;

/// Length of a splat file's unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Unit {
    M,
    Cm,
    Mm,
}

impl Unit {
    pub(super) fn metres(self) -> f32 {
        match self {
            Self::M => 1.0,
            Self::Cm => 0.01,
            Self::Mm => 0.001,
        }
    }
}

/// Upward axis of a splat file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Up {
    Y,
    #[value(name = "-y")]
    MinusY,
    Z,
    #[value(name = "-z")]
    MinusZ,
}

impl Up {
    /// Returns the rotation to y up. A file with y down turns about x, so that what faces the viewer in the usual axes of cameras, x right
    /// and z forward, faces +z.
    pub(super) fn to_y(self) -> Quat {
        use std::f32::consts::{FRAC_PI_2, PI};
        match self {
            Self::Y => Quat::IDENTITY,
            Self::MinusY => Quat::from_rotation_x(PI),
            Self::Z => Quat::from_rotation_x(-FRAC_PI_2),
            Self::MinusZ => Quat::from_rotation_x(FRAC_PI_2),
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    #[test]
    fn the_upward_axis_becomes_y() {
        let axes = [(Up::Y, Vec3::Y), (Up::MinusY, Vec3::NEG_Y), (Up::Z, Vec3::Z), (Up::MinusZ, Vec3::NEG_Z)];
        for (up, axis) in axes {
            assert!((up.to_y() * axis).distance(Vec3::Y) < 1e-6, "{up:?}");
        }
    }
}

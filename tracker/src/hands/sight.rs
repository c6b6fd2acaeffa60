//! One view of a hand or the head: what both fits need to compare landmarks with it.

use flyrig_solve::RigidMotion;
use glam::{DVec2, DVec3};

use crate::image::view::View;

/// Standard deviation of a landmark in every image, undistorted pixels.
const SPREAD_PX: f64 = 1.0;

/// View of a hand or the head at the time of its image.
#[derive(Debug, Clone)]
pub(crate) struct Sight {
    pub view: View,
    /// Importance, 0..=1.
    pub trust: f64,
    /// Motion of the wrist or the head's joint from the frame set's time to that of the image, world frame.
    pub carry: RigidMotion,
}

impl Sight {
    /// Projects a world point of the frame set's time to undistorted pixels from the principal point.
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        self.view.project(self.carry.apply(point))
    }

    /// Returns [`Self::project`] and its derivative by the world point (rows: du, dv).
    pub fn project_with_derivative(&self, point: DVec3) -> Option<(DVec2, [DVec3; 2])> {
        let (pixel, rows) = self.view.project_with_derivative(self.carry.apply(point))?;
        let back = self.carry.rotation.inverse();
        Some((pixel, rows.map(|row| back * row)))
    }

    /// Returns the standard deviation of landmarks that scatter by `spread_m` metres, pixels; `None` behind the camera.
    pub fn spread_px(&self, joint: DVec3, spread_m: f64) -> Option<f64> {
        Some((spread_m * self.view.px_per_m(joint)?).hypot(SPREAD_PX))
    }
}

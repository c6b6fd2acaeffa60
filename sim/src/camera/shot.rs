//! Request for an image of a camera.

use flyrig_types::Isometry;

use crate::error::SimError;
use crate::error::check;

/// Request for one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    /// Middle of the middle row's exposure, nanoseconds.
    pub nanos: i64,
    /// Slot of the camera in the rig.
    pub slot: usize,
    /// Factor on the sensor's exposure.
    pub exposure: f64,
    /// `moved_from_camera`: displacement of a bumped camera from its place in the rig, in its own axes.
    pub camera_shift: Option<Isometry>,
}

impl Shot {
    /// Creates a shot of an undisturbed camera.
    #[must_use]
    pub fn new(nanos: i64, slot: usize) -> Self {
        Self { nanos, slot, exposure: 1.0, camera_shift: None }
    }

    pub(crate) fn validate(&self) -> Result<(), SimError> {
        check("shot.exposure", self.exposure, 0.0, 4096.0, "0 to 4096")?;
        let Some(shift) = self.camera_shift else { return Ok(()) };
        let length = shift.translation.length();
        check("shot.camera_shift", length, 0.0, 1.0, "a finite shift of at most 1 metre")?;
        check("shot.camera_shift", shift.rotation.length(), 0.999, 1.001, "a unit quaternion")
    }
}

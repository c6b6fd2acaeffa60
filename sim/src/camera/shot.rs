//! What a camera is asked for.

use flyrig_types::Isometry;

use crate::SimError;
use crate::error::check;

/// One image to take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    /// Middle of the middle row's exposure, nanoseconds.
    pub nanos: i64,
    /// Place of the camera in the rig.
    pub slot: usize,
    /// Factor on the sensor's exposure.
    pub exposure: f64,
    /// `moved_from_camera`: how the camera stands off its place in the rig (somebody bumped into it), in its own axes.
    pub camera_shift: Option<Isometry>,
}

impl Shot {
    /// A shot of an undisturbed camera.
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

//! Masks from an empty plate.

use flyrig_types::{Image, Mask};

use crate::{TrackError, TrackErrorKind};

/// Person mask of a picture from the empty scene of the same camera.
///
/// # Errors
/// Kind `Image` when the sizes differ or a format cannot be read.
pub fn mask_from_plate(_image: &Image, _plate: &Image) -> Result<Option<Mask>, TrackError> {
    Err(TrackError::new(TrackErrorKind::Image, "not made"))
}

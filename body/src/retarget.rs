//! Motion of one skeleton on another.

use flyrig_types::PoseTrack;

use crate::{BodyError, BvhClip, Skeleton};

impl BvhClip {
    /// The clip on another skeleton; world z up.
    ///
    /// # Errors
    /// [`BodyError::Skeleton`], [`BodyError::Track`].
    pub fn retarget(&self, _skeleton: &Skeleton) -> Result<PoseTrack, BodyError> {
        Err(BodyError::Asset("not yet".to_owned()))
    }
}

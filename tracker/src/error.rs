//! What can go wrong while tracking.

/// What sort of trouble a [`TrackError`] is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TrackErrorKind {
    /// No person was found in this frame set, or too little of one. The estimator searches again on the next set.
    Lost,
    /// The frame set does not fit the rig: wrong number of slots, no frame at all, another image size.
    Frames,
    /// The pixels are not usable: another size than needed, or a format that cannot be read.
    Image,
    /// The network file is damaged or its outputs are not finite.
    Net,
    /// The template lacks joints that the fit needs, or its numbers are not usable.
    Template,
    /// The rig is not valid.
    Rig,
}

/// Why a pose, a mask or a shape could not be estimated.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct TrackError {
    /// What sort of trouble.
    pub kind: TrackErrorKind,
    /// Problem and fix.
    pub message: String,
}

impl TrackError {
    pub(crate) fn new(kind: TrackErrorKind, message: impl Into<String>) -> Self {
        Self { kind, message: message.into() }
    }

    pub(crate) fn lost(message: impl Into<String>) -> Self {
        Self::new(TrackErrorKind::Lost, message)
    }
}

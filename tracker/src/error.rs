//! Errors of tracking.

/// Kind of a [`TrackError`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TrackErrorKind {
    /// The frame set shows no person, or too little of one. The estimator searches again in the next one.
    Lost,
    /// The frame set does not fit the rig: another number of slots, or no frame at all.
    Frames,
    /// The image is not usable: another size than expected, or a format that cannot be read.
    Image,
    /// The network does not load, or its outputs are missing or not finite.
    Net,
    /// The template lacks joints that the fit needs, or holds unusable numbers.
    Template,
    /// The rig is not valid.
    Rig,
}

/// Reason why a pose, a mask or a shape could not be estimated.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct TrackError {
    /// Kind.
    pub kind: TrackErrorKind,
    /// Problem and fix.
    pub message: String,
}

impl TrackError {
    /// Creates an error.
    pub(crate) fn new(kind: TrackErrorKind, message: impl Into<String>) -> Self {
        Self { kind, message: message.into() }
    }

    /// Creates an error of kind `Lost`.
    pub(crate) fn lost(message: impl Into<String>) -> Self {
        Self::new(TrackErrorKind::Lost, message)
    }
}

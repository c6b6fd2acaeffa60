//! Errors of the transport.

use flyrig_stream::SplatError;

use crate::{printable::printable, schema::SCHEMA_VERSION};

/// Kind of a [`TransportError`], for callers that react to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TransportErrorKind {
    /// Invalid setting, name or request of this side.
    Config,
    /// Failure of the zenoh session.
    Session,
    /// Schema version of the other side that this program does not know.
    UnknownVersion,
    /// Malformed message.
    Malformed,
    /// Closed session.
    Closed,
}

/// Error that names the faulty item and the fix. Both texts are [`printable()`]: either may repeat what another program sent.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{topic}: {message}")]
pub struct TransportError {
    /// Kind.
    pub kind: TransportErrorKind,
    /// Key, setting or part of a message that is at fault.
    pub topic: String,
    /// Fault and fix.
    pub message: String,
}

impl TransportError {
    pub(crate) fn new(kind: TransportErrorKind, topic: impl Into<String>, message: impl Into<String>) -> Self {
        let (topic, message) = (topic.into(), message.into());
        Self { kind, topic: printable(&topic).into_owned(), message: printable(&message).into_owned() }
    }

    pub(crate) fn config(topic: impl Into<String>, message: impl Into<String>) -> Self {
        Self::new(TransportErrorKind::Config, topic, message)
    }

    pub(crate) fn malformed(topic: impl Into<String>, message: impl Into<String>) -> Self {
        Self::new(TransportErrorKind::Malformed, topic, message)
    }

    pub(crate) fn session(topic: impl Into<String>, cause: &impl std::fmt::Display) -> Self {
        Self::new(TransportErrorKind::Session, topic, cause.to_string())
    }

    pub(crate) fn version(topic: impl Into<String>, found: impl std::fmt::Display) -> Self {
        Self::new(
            TransportErrorKind::UnknownVersion,
            topic,
            format!(
                "speaks schema version {found}, this program knows version {SCHEMA_VERSION}; run the same flyrig on both sides"
            ),
        )
    }
}

impl From<SplatError> for TransportError {
    fn from(error: SplatError) -> Self {
        let kind = match error {
            SplatError::State(_) => TransportErrorKind::Config,
            SplatError::Version(_) => TransportErrorKind::UnknownVersion,
            SplatError::Malformed(_) => TransportErrorKind::Malformed,
        };
        Self::new(kind, "splats", error.to_string())
    }
}

//! Errors of the codec.

use core::fmt;

use crate::message::CODEC_VERSION;

/// Error of encoding or decoding a message of the person stream.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum StreamError {
    /// Message of a program with another version of the codec.
    Version {
        /// Name of the message.
        what: &'static str,
        /// Version of the message.
        found: u8,
    },
    /// Damaged message, or one of another kind.
    Malformed {
        /// Name of the message.
        what: &'static str,
        /// Fault.
        problem: &'static str,
    },
    /// Message of another template than the decoder's.
    OtherTemplate {
        /// Name of the message.
        what: &'static str,
    },
    /// Template that cannot be encoded.
    Template(&'static str),
}

impl fmt::Display for StreamError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Version { what, found } => write!(
                f,
                "the {what} has version {found} of the person stream, this program reads version {CODEC_VERSION}; update the older of the two \
                 programs"
            ),
            Self::Malformed { what, problem } => write!(f, "the {what} is damaged: {problem}"),
            Self::OtherTemplate { what } => write!(f, "the {what} belongs to another template"),
            Self::Template(problem) => write!(f, "no template can be made: {problem}"),
        }
    }
}

impl core::error::Error for StreamError {}

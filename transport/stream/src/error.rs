//! Why a message is refused.

use core::fmt;

use crate::message::CODEC_VERSION;

/// Why something cannot be encoded or decoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum StreamError {
    /// Written by a program with another form of the codec.
    Version {
        /// The message.
        what: &'static str,
        /// Its version.
        found: u8,
    },
    /// Damaged, or not such a message.
    Malformed {
        /// The message.
        what: &'static str,
        /// The fault.
        problem: &'static str,
    },
    /// Belongs to another template than the decoder's.
    OtherTemplate {
        /// The message.
        what: &'static str,
    },
    /// A template that cannot be made.
    Template(&'static str),
}

impl fmt::Display for StreamError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Version { what, found } => write!(
                f,
                "the {what} has version {found} of the person stream, this program reads version {}; update the older of the two \
                 programs",
                CODEC_VERSION
            ),
            Self::Malformed { what, problem } => write!(f, "the {what} is damaged: {problem}"),
            Self::OtherTemplate { what } => write!(f, "the {what} belongs to another template"),
            Self::Template(problem) => write!(f, "no template can be made: {problem}"),
        }
    }
}

impl core::error::Error for StreamError {}

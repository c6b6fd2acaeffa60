//! Errors of keys and of the gate.

use std::{net::SocketAddr, path::PathBuf};

/// Error of keys or of the gate; its text names the file, holder or address, and the fix.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// A file cannot be used.
    #[error("{}: {problem}", file.display())]
    File {
        /// Which one.
        file: PathBuf,
        /// The fault and the fix.
        problem: String,
    },
    /// A request is not possible.
    #[error("{0}")]
    Request(String),
    /// The gate's address cannot be listened on.
    #[error(
        "cannot listen on {address}: {problem}; is another rig with keys running? Free the port, or change it in ring.toml"
    )]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Error of the operating system.
        problem: std::io::Error,
    },
    /// The rig cannot be reached, or does not admit the key; for [`crate::KeyProbe`].
    #[error("{0}")]
    Refused(String),
    /// The system gives no thread or no random numbers, or a certificate cannot be made.
    #[error("keys: {0}")]
    System(String),
}

impl AccessError {
    pub(crate) fn file(file: impl Into<PathBuf>, problem: impl Into<String>) -> Self {
        Self::File { file: file.into(), problem: problem.into() }
    }

    pub(crate) fn system(error: impl std::fmt::Display) -> Self {
        Self::System(error.to_string())
    }
}

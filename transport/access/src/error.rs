//! Errors of keys and of the gate.

use std::{net::SocketAddr, path::PathBuf};

/// Error of keys or of the gate, whose text names the file, holder or address, and the fix.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// Unusable file.
    #[error("{}: {problem}", file.display())]
    File {
        /// Path of the file.
        file: PathBuf,
        /// Fault and fix.
        problem: String,
    },
    /// Impossible request.
    #[error("{0}")]
    Request(String),
    /// Address of the gate that cannot be listened on.
    #[error(
        "cannot listen on {address}: {problem}; is another rig with keys running? Free the port, or change it in ring.toml"
    )]
    Listen {
        /// Address of the gate.
        address: SocketAddr,
        /// Error of the operating system.
        problem: std::io::Error,
    },
    /// Rig that cannot be reached or rejects the key.
    #[error("{0}")]
    Refused(String),
    /// Failure of the system: no thread, no random numbers, or no certificate.
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

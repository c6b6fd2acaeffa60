//! Errors of the web page's server.

use std::{net::SocketAddr, path::PathBuf};

/// Error of starting the server.
#[derive(Debug, thiserror::Error)]
pub enum WebError {
    /// Invalid setting.
    #[error("{0}")]
    Config(String),
    /// Unusable certificate or key.
    #[error("{}: {problem}", file.display())]
    Certificate {
        /// Path of the file.
        file: PathBuf,
        /// Fault and fix.
        problem: String,
    },
    /// Address that cannot be listened on.
    #[error("web: cannot listen on {address}: {problem}; free the port or choose another one")]
    Listen {
        /// Address of the page.
        address: SocketAddr,
        /// Error of the operating system.
        problem: std::io::Error,
    },
    /// Failure of the system: no thread, or no random numbers.
    #[error("web: cannot start: {0}")]
    Start(String),
}

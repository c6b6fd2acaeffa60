//! Errors of the web page's server.

use std::{net::SocketAddr, path::PathBuf};

/// Why no page is served.
#[derive(Debug, thiserror::Error)]
pub enum WebError {
    /// A setting is not valid.
    #[error("{0}")]
    Config(String),
    /// A certificate or a key cannot be used.
    #[error("{}: {problem}", file.display())]
    Certificate {
        /// Which file.
        file: PathBuf,
        /// The fault and the fix.
        problem: String,
    },
    /// The address cannot be listened on.
    #[error("web: cannot listen on {address}: {problem}; free the port or choose another one")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Error of the operating system.
        problem: std::io::Error,
    },
    /// The system gives no thread, or no random numbers.
    #[error("web: cannot start: {0}")]
    Start(String),
}

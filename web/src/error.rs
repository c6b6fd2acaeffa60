//! Errors of the web page's server.

use std::net::SocketAddr;

/// Why no page is served.
#[derive(Debug, thiserror::Error)]
pub enum WebError {
    /// A setting is not valid.
    #[error("{0}")]
    Config(String),
    /// The address is no loopback address.
    #[error(
        "web: {0} can be reached from other computers, and nothing is encrypted yet; listen on 127.0.0.1, forward the port (ssh -L \
         {port}:127.0.0.1:{port} HOST), or pass --insecure (web.insecure = true) in a network that you trust", port = .0.port()
    )]
    NotLoopback(SocketAddr),
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

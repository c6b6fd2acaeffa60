//! Errors of learned appearance.

use std::path::PathBuf;

/// Reason why an operation of learned appearance failed. Nothing was changed then.
#[derive(Debug, thiserror::Error)]
pub enum StfaError {
    /// A file cannot be read or written.
    #[error("{path}: {source}")]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Reason given by the system.
        source: std::io::Error,
    },
    /// Weights are truncated, of another version or of another network.
    #[error("weights {name}: {what}; use a weights file that this version of flyrig wrote")]
    Weights {
        /// Name of the file, or "embedded".
        name: String,
        /// Fault found.
        what: String,
    },
    /// A training sample is damaged.
    #[error("training sample {name}: {what}; delete it, the next run makes it again")]
    Sample {
        /// Name of the file.
        name: String,
        /// Fault found.
        what: String,
    },
    /// Gaussians, graph and observations do not belong together.
    #[error("learned appearance cannot use this body: {0}; build Gaussians and graph from the same template")]
    Body(String),
    /// A frame's inputs have different lengths.
    #[error("learned appearance cannot use this frame: {0}")]
    Frame(String),
}

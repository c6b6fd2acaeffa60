//! What can be wrong with weights and inputs.

use std::path::PathBuf;

/// Why learned appearance cannot go on. Nothing was changed then.
#[derive(Debug, thiserror::Error)]
pub enum StfaError {
    /// A file that cannot be read or written.
    #[error("{path}: {source}")]
    File {
        /// Which.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Weights that are cut short, of another version or of another network.
    #[error("weights {name}: {what}; use a weights file that this version of flyrig wrote")]
    Weights {
        /// Which file, or "embedded".
        name: String,
        /// What is wrong.
        what: String,
    },
    /// A training sample that is damaged.
    #[error("training sample {name}: {what}; delete it, the next run makes it again")]
    Sample {
        /// Which file.
        name: String,
        /// What is wrong.
        what: String,
    },
    /// Gaussians, graph and observations that do not belong together.
    #[error("learned appearance cannot use this body: {0}; build Gaussians and graph from the same template")]
    Body(String),
    /// A frame's inputs of different lengths.
    #[error("learned appearance cannot use this frame: {0}")]
    Frame(String),
}

//! Errors of avatars.

use std::path::PathBuf;

use flyrig_body::BodyError;
use flyrig_gpu::GpuError;

/// Reason why an avatar cannot be built, read or drawn.
#[derive(Debug, thiserror::Error)]
pub enum AvatarError {
    /// The graphics adapter reported an error.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The body is invalid.
    #[error(transparent)]
    Body(#[from] BodyError),
    /// A file cannot be read or written.
    #[error("{path}: {source}")]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Reason given by the system.
        source: std::io::Error,
    },
    /// A file is no avatar, or damaged.
    #[error("{path}: {problem}")]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// The fault, and how to fix it.
        problem: String,
    },
    /// A texture does not fit the avatar.
    #[error("{0}")]
    Texture(String),
    /// Networks cannot predict this avatar.
    #[error("{0}")]
    Networks(String),
}

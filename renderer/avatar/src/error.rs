//! Reasons why there is no avatar.

use std::path::PathBuf;

use flyrig_body::BodyError;
use flyrig_gpu::GpuError;
use flyrig_renderer::BackwardError;

/// Reason why an avatar cannot be built, read or drawn.
#[derive(Debug, thiserror::Error)]
pub enum AvatarError {
    /// The graphics adapter.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Derivatives.
    #[error(transparent)]
    Backward(#[from] BackwardError),
    /// The body.
    #[error(transparent)]
    Body(#[from] BodyError),
    /// A file that cannot be read or written.
    #[error("{path}: {source}")]
    File {
        /// Which file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A file that is no avatar, or a damaged one.
    #[error("{path}: {problem}")]
    Format {
        /// Which file.
        path: PathBuf,
        /// The fault, and how to fix it.
        problem: String,
    },
    /// A texture that does not fit the avatar.
    #[error("{0}")]
    Texture(String),
    /// Nothing to learn from.
    #[error("{0}")]
    Images(String),
}

//! Errors of fits.

use flyrig_gpu::GpuError;
use flyrig_renderer::BackwardError;

/// Reason why a model cannot be fitted.
#[derive(Debug, thiserror::Error)]
pub enum FitError {
    /// The graphics adapter reported an error.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Derivatives could not be recorded.
    #[error(transparent)]
    Backward(#[from] BackwardError),
    /// The images cannot be learned from.
    #[error("{0}")]
    Images(String),
    /// The state cannot be written.
    #[error("checkpoint: {0}")]
    Checkpoint(String),
}

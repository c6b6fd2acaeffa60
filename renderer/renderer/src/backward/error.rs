//! Errors of the backward rasteriser.

use flyrig_gpu::GpuError;

/// Reason why no derivative was recorded.
#[derive(Debug, thiserror::Error)]
pub enum BackwardError {
    /// A buffer would exceed the adapter's limits, or the device is lost.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A buffer does not fit the image rendered last.
    #[error("{what}: {found} elements where the image rendered last needs {needed}; make it for that image")]
    Buffer {
        /// Name of the buffer.
        what: &'static str,
        /// Elements found.
        found: usize,
        /// Elements needed.
        needed: usize,
    },
}

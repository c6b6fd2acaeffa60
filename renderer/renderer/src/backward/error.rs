//! Errors of the backward rasteriser.

use flyrig_gpu::GpuError;

/// Why there is no derivative.
#[derive(Debug, thiserror::Error)]
pub enum BackwardError {
    /// Buffers must grow and cannot.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A buffer does not belong to the image that was drawn last.
    #[error("{what}: {found} elements where the image drawn last needs {needed}; make it for that image")]
    Buffer {
        /// Which buffer.
        what: &'static str,
        /// Its elements.
        found: usize,
        /// Elements needed.
        needed: usize,
    },
}

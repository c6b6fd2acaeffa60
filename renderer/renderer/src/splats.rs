//! Gaussians in memory, for programs that read them back from a session.

use flyrig_gpu::{GpuContext, GpuError};

use crate::buffers::GaussianBuffers;

/// Gaussian with the attributes of a splat file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Splat {
    /// World position, metres.
    pub position: [f32; 3],
    /// World unit normal of the surface.
    pub normal: [f32; 3],
    /// Linear RGB.
    pub color: [f32; 3],
    /// Opacity in 0..=1.
    pub opacity: f32,
    /// Standard deviations along the axes, metres.
    pub scale_m: [f32; 3],
    /// Unit quaternion w, x, y, z: world from the Gaussian's axes.
    pub rotation_wxyz: [f32; 4],
}

/// Waits for the GPU and reads the Gaussians back (isotropic, no rotation).
///
/// # Errors
/// [`GpuError::Lost`].
pub fn read_splats(gpu: &GpuContext, gaussians: &GaussianBuffers) -> Result<Vec<Splat>, GpuError> {
    let centers = gaussians.center_scale.read(gpu)?;
    let normals = gaussians.normal.read(gpu)?;
    let colors = gaussians.color.read(gpu)?;
    Ok(centers
        .iter()
        .zip(&normals)
        .zip(&colors)
        .map(|((&[x, y, z, scale], &[nx, ny, nz, _]), &[r, g, b, opacity])| Splat {
            position: [x, y, z],
            normal: [nx, ny, nz],
            color: [r, g, b],
            opacity,
            scale_m: [scale; 3],
            rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
        })
        .collect())
}

//! Interface of the solver to the images: the data loss and its derivatives (FlyHuman Eq. 3).

use glam::DMat4;

/// Derivatives of the data loss by the Gaussians' world centres at one instant, as the backward rasteriser lays them out.
#[derive(Debug, Clone, Default)]
pub struct PointDerivatives {
    /// Skinning matrices of the instant, one per joint.
    pub world_from_canonical: Vec<DMat4>,
    /// One per Gaussian. xyz: dL/d world centre, per metre; w: visibility, 0 for one that no pixel depends on.
    pub gradient: Vec<[f32; 4]>,
    /// Two per Gaussian: xx, xy, xz, yy | yz, zz, unused, unused of the symmetric, positive semidefinite Gauss-Newton
    /// matrix by the world centre, per square metre, as if all Gaussians of a pixel moved together.
    pub curvature: Vec<[f32; 4]>,
}

/// Comparison of the posed, displaced Gaussians with the images of a frame set: `λ_color L_color + λ_mask L_mask` of
/// FlyHuman Eq. 3.
pub trait DataTerm {
    /// Error of the comparison.
    type Error;

    /// Returns the loss with the Gaussians at `LBS(x + displacement)`; xyz in canonical metres, w their growth.
    ///
    /// # Errors
    /// The implementation's.
    fn loss(&mut self, displacement: &[[f32; 4]]) -> Result<f64, Self::Error>;

    /// Returns the loss and writes its derivatives into `out`: one element per instant of the images (a single one when the
    /// cameras are synchronous), to be summed.
    ///
    /// # Errors
    /// The implementation's.
    fn derivatives(&mut self, displacement: &[[f32; 4]], out: &mut Vec<PointDerivatives>) -> Result<f64, Self::Error>;
}

//! What the solver asks of the images.

use glam::DMat4;

/// Derivatives of the data loss by the Gaussians' world centres at one instant, as the backward rasteriser lays them out.
#[derive(Debug, Clone, Default)]
pub struct PointDerivatives {
    /// Skinning matrices of the instant, one a joint.
    pub world_from_canonical: Vec<DMat4>,
    /// One a Gaussian. xyz: dL/d world centre, per metre; w: how much it is seen, 0 for one that cannot matter.
    pub gradient: Vec<[f32; 4]>,
    /// Two a Gaussian: xx, xy, xz, yy | yz, zz, unused, unused of the symmetric, positive semidefinite Gauss-Newton
    /// matrix by the world centre, per square metre, as if all that a pixel shows moved together.
    pub curvature: Vec<[f32; 4]>,
}

/// Compares the posed, displaced Gaussians with the images of this instant: `λ_color L_color + λ_mask L_mask` of
/// Eq. 3.
pub trait DataTerm {
    /// Why it cannot.
    type Error;

    /// The loss with the Gaussians at `LBS(x + displacement)`, canonical metres, and growth in w.
    ///
    /// # Errors
    /// The implementation's.
    fn loss(&mut self, displacement: &[[f32; 4]]) -> Result<f64, Self::Error>;

    /// The loss, and its derivatives into `out`: one element an instant that images were taken at (all together when
    /// the cameras are synchronous); the sum of all counts.
    ///
    /// # Errors
    /// The implementation's.
    fn derivatives(&mut self, displacement: &[[f32; 4]], out: &mut Vec<PointDerivatives>) -> Result<f64, Self::Error>;
}

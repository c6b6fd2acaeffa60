//! Interface between a fit and the model that is fitted.

use flyrig_renderer::HarmonicOrder;
use glam::Vec3;

/// Row of every list of attributes: four numbers.
pub type Element = [f32; 4];

/// Place of a step in a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Number of the step, from 1.
    pub count: u64,
    /// Completed share of all steps, 0..=1.
    pub progress: f32,
}

/// Model whose parameters are fitted to images.
///
/// Lists have the form of [`flyrig_renderer::AnisotropicBuffers`]: world centres (metres), standard deviations with
/// the opacity in w, quaternions, and coefficients of linear RGB, [`HarmonicOrder::coefficients`] rows per Gaussian.
pub trait Model {
    /// Returns the number of Gaussians, which stays the same during a fit.
    fn gaussians(&self) -> usize;

    /// Returns the order of the colours' harmonics.
    fn order(&self) -> HarmonicOrder;

    /// Returns the number of frames that Gaussians can be placed in.
    fn frames(&self) -> usize;

    /// Places the Gaussians in the world at a frame and returns centres, scales with opacities, rotations and colours, for an image that is
    /// seen from `eye`, world metres. Gaussians of opacity 0 are not drawn and have no derivatives.
    fn place(&mut self, frame: usize, eye: Vec3) -> [&[Element]; 4];

    /// Returns how far the Gaussians' centres, as [`Self::place`] placed them last, lie below the surface that they draw, metres: known depths
    /// are of that surface, and planes of Gaussians pass through their centres.
    fn below_surface_m(&self) -> f32 {
        0.0
    }

    /// Moves the parameters by one step, from the derivatives with respect to the lists that [`Self::place`] returned
    /// last, for the same frame. Derivatives may be changed; those that are not finite count as zero.
    fn descend(&mut self, frame: usize, slopes: &mut [Vec<Element>], step: Step);

    /// Returns all numbers that change from step to step, by name: the state that a checkpoint keeps.
    fn state(&mut self) -> Vec<(String, &mut [f32])>;

    /// Brings what depends on the state up to date, after it was replaced by that of `count` steps.
    fn restore(&mut self, count: u64);
}

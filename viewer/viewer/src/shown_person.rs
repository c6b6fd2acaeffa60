//! Person to draw.

use flyrig_stream::{Posed, PosedAxes};

/// One person to draw; borrowed lists with one element per Gaussian.
#[derive(Debug, Clone, Copy)]
pub struct ShownPerson<'a> {
    /// Centres, standard deviations and normals.
    pub posed: &'a Posed,
    /// Linear RGB and opacity.
    pub colors: &'a [[f32; 4]],
    /// Axes of the Gaussians; `None` where they are isotropic.
    pub axes: Option<&'a PosedAxes>,
}

impl<'a> From<(&'a Posed, &'a [[f32; 4]])> for ShownPerson<'a> {
    fn from((posed, colors): (&'a Posed, &'a [[f32; 4]])) -> Self {
        Self { posed, colors, axes: None }
    }
}

impl ShownPerson<'_> {
    /// Returns the number of Gaussians that all lists have.
    pub(crate) fn count(&self) -> usize {
        self.posed.center_scale.len().min(self.posed.normal.len()).min(self.colors.len())
    }
}

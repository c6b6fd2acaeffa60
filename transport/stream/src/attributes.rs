//! Attributes of anisotropic Gaussians beyond those of every template.

use alloc::vec::Vec;

use flyrig_model::light;

/// Number of terms of an avatar's light, see [`light::Terms`].
pub const LIGHT_TERMS: usize = light::TERMS;

/// Shapes of anisotropic Gaussians; both lists have one element per Gaussian, in the template's order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Shapes {
    /// Standard deviations, metres; w: opacity.
    pub scale_opacity: Vec<[f32; 4]>,
    /// Unit quaternion x, y, z, w: canonical from the Gaussian's axes.
    pub rotation: Vec<[f32; 4]>,
}

/// Colours of an avatar that poses alone drive.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Look {
    /// Linear RGB without the light, w: opacity; one element per Gaussian, in the template's order.
    pub colors: Vec<[f32; 4]>,
    /// Factors of red, green and blue for each term.
    pub light: light::Terms,
}

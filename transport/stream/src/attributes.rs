//! Attributes of an avatar's Gaussians beyond those of every template.

use alloc::vec::Vec;

/// Terms of the light: 1, x, y, z, xy, yz, 3zz - 1, xz, xx - yy of the unit normal in the world.
pub const LIGHT_TERMS: usize = 9;

/// Shapes, colours and light of an avatar; the lists have one element per Gaussian, in the template's order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct AvatarAttributes {
    /// Standard deviations, metres; w: opacity.
    pub scale_opacity: Vec<[f32; 4]>,
    /// Unit quaternion x, y, z, w: canonical from the Gaussian's axes.
    pub rotation: Vec<[f32; 4]>,
    /// Linear RGB without the light; w: opacity.
    pub colors: Vec<[f32; 4]>,
    /// Factors of red, green and blue for each term.
    pub light: [[f32; 3]; LIGHT_TERMS],
}

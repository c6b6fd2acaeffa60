//! Names of the variants that the tables compare, and the sizes that belong to them.

/// Number of input cameras where it is not varied.
pub const VIEWS: usize = 3;
/// Variant that compares every Gaussian with the images.
pub const ALL_GAUSSIANS: &str = "all Gaussians";
/// Variant that compares images at full size.
pub const FULL_SIZE: &str = "full size";
/// Variant without level of detail.
pub const ALL_DETAIL: &str = "all detail";
/// Variant that compares every input view.
pub const ALL_VIEWS: &str = "all views";
/// Variant that iterates after convergence.
pub const NO_REST: &str = "no rest";

/// Returns the side of images in which a pixel covers several of the compared Gaussians, pixels.
pub fn small(side: u32) -> u32 {
    (side * 5 / 16).max(16)
}

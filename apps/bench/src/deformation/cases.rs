//! Names of the variants that the tables compare, and the sizes that belong to them.

/// Input cameras of a case that does not vary them.
pub const VIEWS: usize = 3;
/// Every Gaussian is compared with the images.
pub const ALL_GAUSSIANS: &str = "all Gaussians";
/// Images are not halved.
pub const FULL_SIZE: &str = "full size";
/// No level of detail.
pub const ALL_DETAIL: &str = "all detail";
/// Every input view is compared.
pub const ALL_VIEWS: &str = "all views";
/// Iterations go on after the error has settled.
pub const NO_REST: &str = "no rest";

/// Returns the side of images in which a pixel covers several of the compared Gaussians, pixels.
pub fn small(side: u32) -> u32 {
    (side * 5 / 16).max(16)
}

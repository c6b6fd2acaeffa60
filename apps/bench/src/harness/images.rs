//! Images and masks in memory.

use anyhow::Result;
use flyrig_types::{Image, Mask};

/// Copies an image.
///
/// # Errors
/// None in practice: the copy has the size of its bytes.
pub fn copy(image: &Image) -> Result<Image> {
    Ok(Image::new(image.width(), image.height(), image.format(), image.bytes().to_vec())?)
}

/// Returns the alpha channel of an input image as a mask of the size of `like`; `None` where the sizes differ.
pub fn coverage(rgba: &[u8], like: &Mask) -> Option<Mask> {
    Mask::new(like.width(), like.height(), rgba.chunks_exact(4).map(|p| p[3]).collect()).ok()
}

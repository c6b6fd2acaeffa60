//! Masks with colours of their outline.

use flyrig_types::Mask;

/// Foreground colour of a pixel that also shows the background.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EdgeColor {
    /// Index of the pixel, row by row.
    pub pixel: u32,
    /// sRGB without the background's share.
    pub rgb: [u8; 3],
}

/// Mask with sub-pixel coverage, and colours of its outline without the background.
#[derive(Debug, Clone, PartialEq)]
pub struct Matte {
    /// Coverage.
    pub mask: Mask,
    /// Colours of pixels that are covered in part, by rising index.
    pub colors: Vec<EdgeColor>,
}

//! Masks with foreground colours along their outline, which replace those of the image where a person is painted.

use flyrig_types::Mask;

/// Foreground colour of a pixel that shows the background as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EdgeColor {
    /// Index of the pixel, row by row.
    pub pixel: u32,
    /// sRGB bytes without the background's share.
    pub rgb: [u8; 3],
}

/// Mask with sub-pixel coverage, and colours of its outline without the background.
#[derive(Debug, Clone, PartialEq)]
pub struct Matte {
    /// Coverage at the image's size.
    pub mask: Mask,
    /// Colours of partly covered pixels, by rising index.
    pub colors: Vec<EdgeColor>,
}

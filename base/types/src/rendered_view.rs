//! An image drawn by flyrig.

/// A rendered view: sRGB with straight alpha, 4 bytes a pixel, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RenderedView {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// `4 * width * height` bytes.
    pub rgba: Vec<u8>,
}

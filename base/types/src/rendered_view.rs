//! Rendered images.

/// A rendered view: sRGB with straight alpha, 4 bytes a pixel, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RenderedView {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Red, green, blue and alpha of each pixel: `4 * width * height` bytes.
    pub rgba: Vec<u8>,
}

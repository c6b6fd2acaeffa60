//! Image as the watch of a camera takes it.

/// An RGB or grey image: bytes, `channels` for each pixel, row by row.
#[derive(Debug, Clone, Copy)]
pub struct WatchedImage<'a> {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// 1 or 3.
    pub channels: usize,
    /// `width * height * channels` bytes.
    pub bytes: &'a [u8],
}

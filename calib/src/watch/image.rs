//! Input image of the watch.

/// RGB or grey image: bytes, `channels` per pixel, row by row.
#[derive(Debug, Clone, Copy)]
pub struct WatchedImage<'a> {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Bytes per pixel, 1 or 3.
    pub channels: usize,
    /// `width * height * channels` bytes.
    pub bytes: &'a [u8],
}

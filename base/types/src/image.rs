//! Images and masks whose pixel format is part of the type.

use std::{fmt, ops::Deref, sync::Arc};

use crate::camera::MAX_IMAGE_SIDE;

/// Layout and colour space of the bytes of an [`Image`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PixelFormat {
    /// 3 bytes a pixel, sRGB red green blue.
    Rgb8,
    /// 3 bytes a pixel, sRGB blue green red (OpenCV).
    Bgr8,
    /// 4 bytes a pixel, sRGB with straight alpha.
    Rgba8,
    /// 1 byte a pixel, sRGB-encoded luminance.
    Gray8,
    /// 4:2:2, bytes Y0 U Y1 V.
    Yuyv,
    /// 4:2:2, bytes U Y0 V Y1.
    Uyvy,
    /// 4:2:0, a plane of Y, then a plane of interleaved UV at half size.
    Nv12,
    /// Bayer mosaic of 8 bits, rows RG and GB.
    BayerRggb8,
    /// Bayer mosaic of 8 bits, rows GR and BG.
    BayerGrbg8,
    /// Bayer mosaic of 8 bits, rows GB and RG.
    BayerGbrg8,
    /// Bayer mosaic of 8 bits, rows BG and GR.
    BayerBggr8,
    /// One JPEG image, any length up to the raw size.
    Mjpeg,
}

impl PixelFormat {
    /// Returns the bytes of a `width` x `height` image without row padding; `None` for compressed formats.
    #[must_use]
    pub fn byte_len(self, width: u32, height: u32) -> Option<usize> {
        let pixels = width as usize * height as usize;
        match self {
            Self::Rgb8 | Self::Bgr8 => Some(pixels * 3),
            Self::Rgba8 => Some(pixels * 4),
            Self::Gray8 | Self::BayerRggb8 | Self::BayerGrbg8 | Self::BayerGbrg8 | Self::BayerBggr8 => Some(pixels),
            Self::Yuyv | Self::Uyvy => Some(pixels * 2),
            Self::Nv12 => Some(pixels + (width as usize).div_ceil(2) * (height as usize).div_ceil(2) * 2),
            Self::Mjpeg => None,
        }
    }
}

/// Owner of leased bytes, which it takes back from a dropped [`PixelBuffer`]: a pool, or a driver's queue.
pub trait Recycle: Send + Sync {
    /// Takes the bytes back. Called once, on the thread that drops the buffer.
    fn recycle(&self, bytes: Vec<u8>);
}

/// Bytes of an image: owned, or a lease that goes back to its owner when dropped.
pub struct PixelBuffer {
    bytes: Vec<u8>,
    owner: Option<Arc<dyn Recycle>>,
}

impl PixelBuffer {
    /// Creates a buffer whose bytes go back to `owner` when it is dropped.
    #[must_use]
    pub fn leased(bytes: Vec<u8>, owner: Arc<dyn Recycle>) -> Self {
        Self { bytes, owner: Some(owner) }
    }
}

impl From<Vec<u8>> for PixelBuffer {
    fn from(bytes: Vec<u8>) -> Self {
        Self { bytes, owner: None }
    }
}

impl Deref for PixelBuffer {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for PixelBuffer {
    fn drop(&mut self) {
        if let Some(owner) = self.owner.take() {
            owner.recycle(std::mem::take(&mut self.bytes));
        }
    }
}

impl fmt::Debug for PixelBuffer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PixelBuffer({} bytes, leased: {})", self.bytes.len(), self.owner.is_some())
    }
}

/// Error of bytes that are not an image or mask of the stated size.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    /// A side is 0 or beyond [`MAX_IMAGE_SIDE`].
    #[error("image size {width}x{height} is not between 1 and {MAX_IMAGE_SIDE} pixels a side")]
    Size {
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
    },
    /// The byte count does not fit the size and format.
    #[error("{format:?} image of {width}x{height} needs {needed} bytes but has {found}")]
    ByteCount {
        /// Stated format.
        format: PixelFormat,
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
        /// Bytes that the format needs.
        needed: usize,
        /// Bytes given.
        found: usize,
    },
}

/// Accessors of the fields `width` and `height`.
macro_rules! sides {
    () => {
        /// Returns the width, pixels.
        #[must_use]
        pub fn width(&self) -> u32 {
            self.width
        }

        /// Returns the height, pixels.
        #[must_use]
        pub fn height(&self) -> u32 {
            self.height
        }
    };
}

/// One image in memory, rows top to bottom without padding.
#[derive(Debug)]
pub struct Image {
    width: u32,
    height: u32,
    format: PixelFormat,
    bytes: PixelBuffer,
}

impl Image {
    /// Creates an image from bytes of matching size.
    ///
    /// ```
    /// use flyrig_types::{Image, PixelFormat};
    ///
    /// let image = Image::new(4, 2, PixelFormat::Rgb8, vec![128; 24])?;
    /// assert_eq!((image.width(), image.height()), (4, 2));
    /// assert!(Image::new(4, 2, PixelFormat::Rgb8, vec![128; 23]).is_err());
    /// # Ok::<(), flyrig_types::ImageError>(())
    /// ```
    ///
    /// # Errors
    /// [`ImageError`] when a side is 0 or above [`MAX_IMAGE_SIDE`], or the byte count does not fit.
    pub fn new(
        width: u32,
        height: u32,
        format: PixelFormat,
        bytes: impl Into<PixelBuffer>,
    ) -> Result<Self, ImageError> {
        let bytes = bytes.into();
        check_size(width, height)?;
        match format.byte_len(width, height) {
            Some(needed) if needed != bytes.len() => {
                Err(ImageError::ByteCount { format, width, height, needed, found: bytes.len() })
            }
            _ => Ok(Self { width, height, format, bytes }),
        }
    }

    sides!();

    /// Returns the pixel format.
    #[must_use]
    pub fn format(&self) -> PixelFormat {
        self.format
    }

    /// Returns the bytes in the layout of [`PixelFormat`].
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }
}

/// Foreground coverage of an image: 0 background, 255 person, one byte a pixel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    width: u32,
    height: u32,
    coverage: Vec<u8>,
}

impl Mask {
    /// Creates a mask from one byte of coverage per pixel.
    ///
    /// # Errors
    /// [`ImageError`] when a side is 0 or above [`MAX_IMAGE_SIDE`], or the byte count does not fit.
    pub fn new(width: u32, height: u32, coverage: Vec<u8>) -> Result<Self, ImageError> {
        check_size(width, height)?;
        let needed = width as usize * height as usize;
        if coverage.len() != needed {
            return Err(ImageError::ByteCount {
                format: PixelFormat::Gray8,
                width,
                height,
                needed,
                found: coverage.len(),
            });
        }
        Ok(Self { width, height, coverage })
    }

    sides!();

    /// Returns the coverage, row by row.
    #[must_use]
    pub fn coverage(&self) -> &[u8] {
        &self.coverage
    }

    /// Counts the pixels of at least half coverage.
    #[must_use]
    pub fn area_px(&self) -> usize {
        self.coverage.iter().filter(|&&c| c >= 128).count()
    }

    /// Returns the smallest box around the pixels of at least half coverage as `[x0, y0, x1, y1]`, ends excluded;
    /// `None` when the mask is empty.
    #[must_use]
    pub fn bounding_box(&self) -> Option<[u32; 4]> {
        let mut bounds: Option<[u32; 4]> = None;
        for (row, y) in self.coverage.chunks_exact(self.width as usize).zip(0u32..) {
            let Some(first) = row.iter().position(|&c| c >= 128) else { continue };
            let last = row.iter().rposition(|&c| c >= 128).unwrap_or(first);
            let [x0, y0, x1, _] = bounds.unwrap_or([u32::MAX, y, 0, 0]);
            bounds = Some([x0.min(first as u32), y0, x1.max(last as u32 + 1), y + 1]);
        }
        bounds
    }
}

fn check_size(width: u32, height: u32) -> Result<(), ImageError> {
    let sane = 1..=MAX_IMAGE_SIDE;
    if sane.contains(&width) && sane.contains(&height) { Ok(()) } else { Err(ImageError::Size { width, height }) }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    #[test]
    fn a_truncated_image_is_an_error_that_names_both_counts() {
        let error = Image::new(4, 2, PixelFormat::Rgb8, vec![0; 23]).unwrap_err();
        assert_eq!(error.to_string(), "Rgb8 image of 4x2 needs 24 bytes but has 23");
        assert!(Image::new(0, 2, PixelFormat::Rgb8, vec![]).is_err());
        assert!(Image::new(u32::MAX, u32::MAX, PixelFormat::Mjpeg, vec![]).is_err());
    }

    #[test]
    fn a_leased_buffer_goes_home_once() {
        struct Home(Mutex<Vec<Vec<u8>>>);
        impl Recycle for Home {
            fn recycle(&self, bytes: Vec<u8>) {
                self.0.lock().unwrap().push(bytes);
            }
        }
        let home = Arc::new(Home(Mutex::new(Vec::new())));
        let image = Image::new(1, 1, PixelFormat::Gray8, PixelBuffer::leased(vec![7], home.clone())).unwrap();
        drop(image);
        assert_eq!(*home.0.lock().unwrap(), vec![vec![7]]);
    }

    #[test]
    fn mask_box_and_area() {
        let mut coverage = vec![0; 12];
        coverage[5] = 255; // x 1, y 1 of a 4x3 mask
        coverage[10] = 200; // x 2, y 2
        let mask = Mask::new(4, 3, coverage).unwrap();
        assert_eq!(mask.bounding_box(), Some([1, 1, 3, 3]));
        assert_eq!(mask.area_px(), 2);
        assert_eq!(Mask::new(2, 2, vec![0; 4]).unwrap().bounding_box(), None);
    }
}

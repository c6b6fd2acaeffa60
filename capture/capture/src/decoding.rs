//! Conversion of camera images to RGB.

use std::sync::Arc;

use flyrig_types::{Frame, Image, PixelFormat};

use crate::error::{CaptureError, CaptureErrorKind};
use crate::mjpeg::JpegScratch;
use crate::pool::BufferPool;
use crate::rgb;
use crate::stage::FrameStage;

/// Free buffers kept for later frames.
const POOLED_FRAMES: usize = 16;

/// Stage that converts the frames of one camera to `Rgb8` in pooled buffers; frames that are RGB already pass unchanged.
/// JPEG images that are damaged but decode are found by their data, also against the camera's image before.
///
/// An image that cannot be decoded is a `Corrupt` error, one of unexpected size an `Unsupported` one; each loses its
/// own frame only.
#[derive(Debug)]
pub struct Decoding {
    /// Expected width and height, pixels, where they are known.
    size: Option<[u32; 2]>,
    pool: Arc<BufferPool>,
    scratch: JpegScratch,
}

impl Decoding {
    /// Creates a stage for images of this width and height in pixels, or of any size with `None`. A known size keeps a
    /// forged header from allocating more memory than the camera's images need.
    #[must_use]
    pub fn new(size: Option<[u32; 2]>) -> Self {
        Self { size, pool: BufferPool::new(POOLED_FRAMES), scratch: JpegScratch::of_camera() }
    }
}

impl FrameStage for Decoding {
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError> {
        let (width, height) = (frame.image.width(), frame.image.height());
        if let Some(size) = self.size.filter(|size| *size != [width, height]) {
            let message = format!(
                "is {width}x{height} pixels, the calibration is for {}x{}; let the camera send that size, or calibrate it \
                 at the size that it sends",
                size[0], size[1]
            );
            return Err(CaptureError::general(CaptureErrorKind::Unsupported, message));
        }
        if frame.image.format() == PixelFormat::Rgb8 {
            return Ok(frame);
        }
        let mut bytes = self.pool.take();
        let decoded = rgb::convert(&frame.image, &mut bytes, &mut self.scratch);
        // Back to the pool, whether it is an image or not.
        let bytes = self.pool.lease(bytes);
        decoded?;
        let image = Image::new(width, height, PixelFormat::Rgb8, bytes)
            .map_err(|error| CaptureError::general(CaptureErrorKind::Corrupt, error.to_string()))?;
        Ok(Frame { image, ..frame })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_that_claims_to_be_huge_gets_no_memory() {
        let frame = Frame {
            camera: "a".into(),
            sequence: 3,
            capture_nanos: 0,
            exposure_nanos: None,
            image: Image::new(16_384, 16_384, PixelFormat::Mjpeg, vec![0xff, 0xd8, 0xff, 0xd9]).unwrap(),
            mask: None,
        };
        let mut decoding = Decoding::new(Some([640, 360]));
        let error = decoding.process(frame).unwrap_err();
        assert_eq!(error.kind, CaptureErrorKind::Unsupported);
        assert!(error.message.contains("is 16384x16384 pixels, the calibration is for 640x360"), "{error}");
        assert_eq!(decoding.pool.take().capacity(), 0);
    }
}

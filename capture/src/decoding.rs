//! Pictures as cameras send them, made RGB.

use std::sync::Arc;

use flyrig_types::{Frame, Image, PixelFormat};

use crate::{BufferPool, CaptureError, CaptureErrorKind, FrameStage, mjpeg::JpegScratch, rgb};

/// Free buffers that are kept for frames to come.
const POOLED_FRAMES: usize = 16;

/// Makes `Rgb8` frames of a camera's frames, in buffers that are used again; frames that are RGB already pass.
///
/// A picture that cannot be decoded is a `Corrupt` error and costs its own frame alone.
#[derive(Debug)]
pub struct Decoding {
    pool: Arc<BufferPool>,
    scratch: JpegScratch,
}

impl Default for Decoding {
    fn default() -> Self {
        Self { pool: BufferPool::new(POOLED_FRAMES), scratch: JpegScratch::default() }
    }
}

impl FrameStage for Decoding {
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError> {
        if frame.image.format() == PixelFormat::Rgb8 {
            return Ok(frame);
        }
        let mut bytes = self.pool.take();
        let decoded = rgb::convert(&frame.image, &mut bytes, &mut self.scratch);
        // Back to the pool, whether it is a picture or not.
        let bytes = self.pool.lease(bytes);
        decoded?;
        let (width, height) = (frame.image.width(), frame.image.height());
        let image = Image::new(width, height, PixelFormat::Rgb8, bytes)
            .map_err(|error| CaptureError::general(CaptureErrorKind::Corrupt, error.to_string()))?;
        Ok(Frame { image, ..frame })
    }
}

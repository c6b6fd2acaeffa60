//! Pictures as cameras send them, made RGB in the camera's own thread.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    time::Duration,
};

use flyrig_types::{CameraId, Frame, Image, PixelFormat};

use crate::{BufferPool, CameraSource, CaptureError, CaptureErrorKind, SourceHealth, to_rgb8_into};

/// Free buffers that are kept for frames to come.
const POOLED_FRAMES: usize = 16;

/// Makes `Rgb8` frames of a source's frames, in buffers that are used again.
///
/// The driver fills its other buffers meanwhile. A picture that cannot be decoded is a `Corrupt` error and costs its own
/// frame alone, even when the decoder fails inside.
#[derive(Debug)]
pub struct Decoding<S> {
    source: S,
    pool: Arc<BufferPool>,
}

impl<S: CameraSource> Decoding<S> {
    /// Around a source.
    #[must_use]
    pub fn new(source: S) -> Self {
        Self { source, pool: BufferPool::new(POOLED_FRAMES) }
    }
}

impl<S: CameraSource> CameraSource for Decoding<S> {
    fn camera(&self) -> &CameraId {
        self.source.camera()
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let frame = self.source.next_frame(timeout)?;
        if frame.image.format() == PixelFormat::Rgb8 {
            return Ok(frame);
        }
        let mut rgb = self.pool.take();
        let decoded = catch_unwind(AssertUnwindSafe(|| to_rgb8_into(&frame.image, &mut rgb)))
            .unwrap_or_else(|_| Err(CaptureError::general(CaptureErrorKind::Corrupt, "made the decoder fail inside")));
        let (width, height) = (frame.image.width(), frame.image.height());
        let failed = |error: CaptureError| {
            let message = format!("frame {} {}", frame.sequence, error.message);
            CaptureError { message, ..error }.of(&frame.camera)
        };
        decoded.map_err(failed)?;
        let image = Image::new(width, height, PixelFormat::Rgb8, self.pool.lease(rgb))
            .map_err(|error| failed(CaptureError::general(CaptureErrorKind::Corrupt, error.to_string())))?;
        Ok(Frame { image, ..frame })
    }

    fn order_nanos(&self, frame: &Frame) -> i64 {
        self.source.order_nanos(frame)
    }

    fn health(&self) -> SourceHealth {
        self.source.health()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Script(CameraId, Vec<Image>);

    impl CameraSource for Script {
        fn camera(&self) -> &CameraId {
            &self.0
        }

        fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
            let end = || CaptureError::new(&self.0, CaptureErrorKind::EndOfStream, "over");
            let image = self.1.pop().ok_or_else(end)?;
            let camera = self.0.clone();
            Ok(Frame { camera, sequence: 7, capture_nanos: 5, exposure_nanos: Some(3), image, mask: None })
        }
    }

    #[test]
    fn a_damaged_picture_costs_its_own_frame() {
        let yuyv = || Image::new(2, 1, PixelFormat::Yuyv, vec![235, 128, 16, 128]).unwrap();
        let broken = Image::new(2, 1, PixelFormat::Mjpeg, vec![0xff, 0xd8, 1]).unwrap();
        let mut source = Decoding::new(Script("a".into(), vec![yuyv(), broken, yuyv()]));
        for round in 0..2 {
            let frame = source.next_frame(Duration::ZERO).unwrap();
            assert_eq!((frame.image.format(), frame.image.bytes()), (PixelFormat::Rgb8, &[255, 255, 255, 0, 0, 0][..]));
            assert_eq!((frame.sequence, frame.capture_nanos, frame.exposure_nanos), (7, 5, Some(3)));
            if round == 0 {
                let error = source.next_frame(Duration::ZERO).unwrap_err();
                assert_eq!(error.kind, CaptureErrorKind::Corrupt);
                assert_eq!(error.to_string(), "camera a: frame 7 is a JPEG picture that is cut off");
            }
        }
    }
}

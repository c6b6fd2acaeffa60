//! Cameras of this process that behave like those of a driver.

use std::{sync::Arc, time::Duration};

use flyrig_capture::{BufferPool, CameraSource, CaptureError, CaptureErrorKind, SourceHealth};
use flyrig_transport::HostClock;
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

/// Returns this computer's clock.
pub fn host_clock() -> HostClock {
    HostClock::new(flyrig_capture::monotonic_nanos)
}

/// A camera that delivers a few images in turn at a fixed rate; like with a driver, a late reader loses frames, and their numbers skip.
pub struct Steady {
    camera: CameraId,
    clock: HostClock,
    format: PixelFormat,
    size: [u32; 2],
    pictures: Arc<Vec<Vec<u8>>>,
    pool: Arc<BufferPool>,
    period_nanos: i64,
    start_nanos: i64,
    next: i64,
    health: SourceHealth,
}

impl Steady {
    /// Creates a camera that starts in 0.2 s. Every image must have the bytes of its size and format.
    pub fn new(
        camera: CameraId,
        clock: &HostClock,
        format: PixelFormat,
        size: [u32; 2],
        pictures: Arc<Vec<Vec<u8>>>,
        fps: f64,
    ) -> Self {
        let [width, height] = size;
        Self {
            camera,
            format,
            size,
            pictures,
            pool: BufferPool::new(16),
            period_nanos: (1e9 / fps) as i64,
            start_nanos: clock.now_nanos().saturating_add(200_000_000),
            clock: clock.clone(),
            next: 0,
            health: SourceHealth { mode: format!("{format:?} {width}x{height}").into(), ..SourceHealth::default() },
        }
    }
}

impl CameraSource for Steady {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let now = self.clock.now_nanos();
        // A driver keeps a few buffers; what is older is gone.
        let oldest = (now - self.start_nanos) / self.period_nanos - 4;
        if oldest > self.next {
            self.health.lost_by_driver += (oldest - self.next).unsigned_abs();
            self.next = oldest;
        }
        let due = self.start_nanos + self.next * self.period_nanos;
        let wait = Duration::from_nanos(u64::try_from(due - now).unwrap_or(0));
        std::thread::sleep(wait.min(timeout));
        if wait > timeout {
            return Err(CaptureError::new(&self.camera, CaptureErrorKind::Timeout, "no frame yet"));
        }
        let sequence = self.next.unsigned_abs();
        let mut bytes = self.pool.take();
        let picture = self.pictures.get(sequence as usize % self.pictures.len().max(1));
        bytes.extend_from_slice(picture.map_or(&[], Vec::as_slice));
        let [width, height] = self.size;
        let image = Image::new(width, height, self.format, self.pool.lease(bytes))
            .map_err(|error| CaptureError::new(&self.camera, CaptureErrorKind::Corrupt, error.to_string()))?;
        self.next += 1;
        let camera = self.camera.clone();
        Ok(Frame { camera, sequence, capture_nanos: due, exposure_nanos: None, image, mask: None })
    }

    fn health(&self) -> SourceHealth {
        self.health.clone()
    }
}

//! JPEG compression of uncompressed images before they are recorded, in a thread per camera.

use std::{
    sync::Arc,
    thread::{Builder, JoinHandle},
    time::Duration,
};

use flyrig_types::{CameraId, Frame, Image, caught};

use super::outlet::Outlet;
use crate::encoding::JpegEncoding;
use crate::error::{CaptureError, CaptureErrorKind};
use crate::pool::BufferPool;
use crate::queue::LatestQueue;

/// Images of a camera that may wait for compression: a quarter of a second at 30 frames per second.
const WAITING: usize = 8;

/// Compression of uncompressed images in a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Compression {
    /// Quality of the JPEG images, 1 to 100 (libjpeg's scale).
    pub quality: u8,
    /// Whether to block the cameras instead of losing a frame: for sources that can wait. Otherwise the oldest waiting
    /// frame is dropped and counted when compression is too slow.
    pub keep_all: bool,
}

/// Compression thread of one camera.
#[derive(Debug)]
pub(super) struct Compressor {
    camera: CameraId,
    queue: Arc<LatestQueue<Frame>>,
    pool: Arc<BufferPool>,
    keep_all: bool,
    outlet: Outlet,
    thread: Option<JoinHandle<()>>,
}

impl Compressor {
    pub fn start(camera: &CameraId, compression: Compression, outlet: Outlet) -> Result<Self, CaptureError> {
        let queue = Arc::new(LatestQueue::new(WAITING));
        let (of_thread, mut out) = (Arc::clone(&queue), outlet.clone());
        let work = move || {
            if caught(|| compress(&of_thread, compression.quality, &mut out)).is_err() {
                out.shared.stop("compressing failed inside; record without it (record.jpeg_quality = 0)".to_owned());
            }
            // Nobody waits for a thread that has ended.
            of_thread.close();
        };
        let thread = Builder::new()
            .name(format!("jpeg {camera}"))
            .spawn(work)
            .map_err(|error| CaptureError::new(camera, CaptureErrorKind::Io, format!("no thread: {error}")))?;
        Ok(Self {
            camera: camera.clone(),
            queue,
            // Those that wait, and the one that is worked on.
            pool: BufferPool::new(WAITING + 1),
            keep_all: compression.keep_all,
            outlet,
            thread: Some(thread),
        })
    }

    /// Queues a copy for compression, since the frame itself continues to the rig.
    pub fn record(&self, frame: &Frame) {
        let mut bytes = self.pool.take();
        bytes.extend_from_slice(frame.image.bytes());
        let (width, height, format) = (frame.image.width(), frame.image.height(), frame.image.format());
        let Ok(image) = Image::new(width, height, format, self.pool.lease(bytes)) else { return };
        let Frame { sequence, capture_nanos, exposure_nanos, .. } = *frame;
        let copy = Frame { camera: self.camera.clone(), sequence, capture_nanos, exposure_nanos, image, mask: None };
        if self.keep_all {
            // Closed when the thread has ended, which it has logged.
            let _ = self.queue.push_wait(copy);
        } else if let Ok(Some(_)) = self.queue.push(copy) {
            let mut state = self.outlet.shared.lock();
            state.dropped += 1;
            // The 1st, 2nd, 4th ...: a machine that is too slow all night must not fill the disk.
            if state.dropped.is_power_of_two() {
                let count = state.dropped;
                tracing::warn!(count, "camera {}: a frame was not recorded: compression is too slow", self.camera);
            }
        }
    }
}

impl Drop for Compressor {
    /// Records everything that is still queued.
    fn drop(&mut self) {
        self.queue.close();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn compress(queue: &LatestQueue<Frame>, quality: u8, outlet: &mut Outlet) {
    let mut encoding = JpegEncoding::new(quality);
    let mut channel = None;
    while let Ok(frame) = queue.pop(Duration::MAX) {
        let bytes_sent = frame.image.bytes().len();
        let frame = match encoding.encode(&frame.image) {
            Ok(image) => Frame { image, ..frame },
            // What cannot be compressed, like an odd width, is recorded as it came.
            Err(_) => frame,
        };
        outlet.frame(&mut channel, &frame, bytes_sent);
    }
}

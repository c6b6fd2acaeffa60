//! Steady state of capture (camera threads, decoding, queue): no allocation per frame in any format, except inside the
//! JPEG decoder.

#![allow(unsafe_code, reason = "an allocator that counts")]
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::{
    alloc::{GlobalAlloc, Layout, System},
    io::Cursor,
    sync::{
        Arc,
        atomic::{AtomicI64, AtomicU64, Ordering},
    },
    time::Duration,
};

use flyrig_capture::{
    BufferPool, CameraSource, CaptureError, CaptureThreads, Decoding, Pacing, SourceHealth, ThreadsConfig,
};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};

static CALLS: AtomicU64 = AtomicU64::new(0);
static LIVE_BYTES: AtomicI64 = AtomicI64::new(0);

struct Counting;

// SAFETY: hands everything through to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        CALLS.fetch_add(1, Ordering::SeqCst);
        LIVE_BYTES.fetch_add(layout.size() as i64, Ordering::SeqCst);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        LIVE_BYTES.fetch_sub(layout.size() as i64, Ordering::SeqCst);
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Source that copies frames out of driver memory into pooled buffers, as a V4L2 camera does.
struct Driver {
    camera: CameraId,
    format: PixelFormat,
    picture: Vec<u8>,
    pool: Arc<BufferPool>,
    sequence: u64,
    health: SourceHealth,
}

impl CameraSource for Driver {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _timeout: Duration) -> Result<Frame, CaptureError> {
        let mut bytes = self.pool.take();
        bytes.extend_from_slice(&self.picture);
        self.sequence += 1;
        Ok(Frame {
            camera: self.camera.clone(),
            sequence: self.sequence,
            capture_nanos: self.sequence as i64,
            exposure_nanos: None,
            image: Image::new(SIDE, SIDE, self.format, self.pool.lease(bytes)).unwrap(),
            mask: None,
        })
    }

    fn health(&self) -> SourceHealth {
        self.health.clone()
    }
}

const SIDE: u32 = 64;
/// Buffers kept by a camera's pool.
const POOL: usize = 16;

fn jpeg() -> Vec<u8> {
    let picture = image::RgbImage::from_fn(SIDE, SIDE, |x, y| image::Rgb([(x * 4) as u8, (y * 4) as u8, 90]));
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    bytes.into_inner()
}

/// Returns allocator calls and growth in bytes over this many frames of each camera, after as many to warm up.
fn steady(formats: &[PixelFormat], frames: u64, pacing: Pacing) -> (u64, i64) {
    let sources = formats.iter().enumerate().map(|(i, &format)| {
        let picture = format.byte_len(SIDE, SIDE).map_or_else(jpeg, |length| vec![77; length]);
        let mode = "YUYV 64x64 at 30.00".into();
        Box::new(Driver {
            camera: i.to_string().into(),
            format,
            picture,
            pool: BufferPool::new(POOL),
            sequence: 0,
            health: SourceHealth { mode, ..SourceHealth::default() },
        }) as Box<dyn CameraSource>
    });
    let config = ThreadsConfig { queue_capacity: 8, pacing };
    let threads = CaptureThreads::start_staged(sources.collect(), |_| Box::new(Decoding::new(None)), config).unwrap();
    let pass = || {
        for _ in 0..frames * formats.len() as u64 {
            drop(threads.queue().pop(Duration::from_secs(60)).unwrap());
        }
        (CALLS.load(Ordering::SeqCst), LIVE_BYTES.load(Ordering::SeqCst))
    };
    let (first, second) = (pass(), pass());
    (second.0 - first.0, second.1 - first.1)
}

/// Runs as a single test, since the counts are of the whole process.
#[test]
fn the_steady_state_allocates_nothing() {
    use PixelFormat::{BayerRggb8, Bgr8, Gray8, Mjpeg, Nv12, Uyvy, Yuyv};
    for pacing in [Pacing::Lossless, Pacing::AsDelivered] {
        let formats = [Yuyv, Uyvy, Nv12, Gray8, Bgr8, BayerRggb8];
        let (calls, growth) = steady(&formats, 2000, pacing);
        println!("uncompressed, {pacing:?}: {calls} allocations, {growth} bytes, for 12,000 frames");
        // When the system takes the processor away, more is in flight than ever before: a pool may then make one of the 16
        // buffers that it did not need yet. Whatever costs an allocation a frame makes thousands.
        let most = POOL as u64 * formats.len() as u64;
        assert!(calls <= most, "{calls} allocations, {pacing:?}");
        assert!(growth <= (most * u64::from(SIDE * SIDE * 3)) as i64, "{growth} bytes, {pacing:?}");
    }
    let frames = 500;
    let (calls, growth) = steady(&[Mjpeg], frames, Pacing::Lossless);
    println!("MJPEG: {} allocations a frame inside of the decoder", calls as f64 / frames as f64);
    assert!(calls / frames < 100, "{calls} calls for {frames} frames");
    // What is in flight differs from one look to the next.
    assert!(growth.abs() < 4 << 20, "{growth} bytes");
}

//! Thread that blocks inside a camera's driver.

use std::{
    sync::{
        Arc, Mutex, OnceLock,
        atomic::{AtomicBool, Ordering},
    },
    thread::Builder,
};

use flyrig_types::{CameraId, PixelBuffer, caught, lock};

use super::camera::{BlockingCamera, DriverImage, Opener};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::pool::BufferPool;
use crate::queue::LatestQueue;

/// Queued events between driver thread and camera thread: one to read next, one for jitter.
const WAITING: usize = 2;

/// Event from the driver thread.
#[derive(Debug)]
pub(super) enum Event {
    /// The camera is open and has a mode.
    Opened,
    Image(DriverImage, PixelBuffer),
    /// An image was lost.
    Damaged(CaptureError),
}

/// State shared between the driver thread and its watchdog.
#[derive(Debug)]
pub(super) struct Line {
    /// Queue of events, closed when the thread has ended.
    pub events: LatestQueue<Event>,
    /// Mode of the open camera as text for logs.
    pub mode: OnceLock<String>,
    is_abandoned: AtomicBool,
    /// Error with which the thread ended.
    end: Mutex<Option<CaptureError>>,
}

impl Line {
    /// Makes the thread end as soon as its current call returns.
    pub fn abandon(&self) {
        self.is_abandoned.store(true, Ordering::Relaxed);
    }

    /// Returns the reason why the thread has ended.
    pub fn end(&self) -> CaptureError {
        let end = lock(&self.end).clone();
        end.unwrap_or_else(|| CaptureError::general(CaptureErrorKind::Disconnected, "was closed"))
    }
}

/// Starts a thread that opens the camera and reads it.
///
/// # Errors
/// `Io` when the system cannot start a thread.
pub(super) fn start<O: Opener>(
    camera: &CameraId,
    opener: &Arc<O>,
    pool: &Arc<BufferPool>,
) -> Result<Arc<Line>, CaptureError> {
    let line = Arc::new(Line {
        events: LatestQueue::new(WAITING),
        mode: OnceLock::new(),
        is_abandoned: AtomicBool::new(false),
        end: Mutex::new(None),
    });
    let (of_thread, opener, pool) = (Arc::clone(&line), Arc::clone(opener), Arc::clone(pool));
    let work = move || {
        let end = work(&*opener, &pool, &of_thread);
        *lock(&of_thread.end) = end.err();
        of_thread.events.close();
    };
    Builder::new()
        .name(format!("driver {camera}"))
        .spawn(work)
        .map_err(|error| CaptureError::general(CaptureErrorKind::Io, format!("no thread: {error}")))?;
    Ok(line)
}

/// Catches panics of one driver call. Every call is guarded separately: a camera that is dropped while its own panic
/// unwinds may panic again, which would abort the process.
fn guarded<T>(call: impl FnOnce() -> Result<T, CaptureError>) -> Result<T, CaptureError> {
    caught(call).unwrap_or_else(|text| {
        let text = format!("its driver library failed inside: {text}; opening it again");
        Err(CaptureError::general(CaptureErrorKind::Disconnected, text))
    })
}

fn work<O: Opener>(opener: &O, pool: &Arc<BufferPool>, line: &Line) -> Result<(), CaptureError> {
    let mut camera = guarded(|| opener.open())?;
    let result = read(&mut camera, pool, line);
    let closed = guarded(|| {
        drop(camera);
        Ok(())
    });
    result.and(closed)
}

fn read(camera: &mut impl BlockingCamera, pool: &Arc<BufferPool>, line: &Line) -> Result<(), CaptureError> {
    let mode = guarded(|| Ok(camera.mode()))?;
    line.mode.get_or_init(|| mode);
    let mut event = Event::Opened;
    loop {
        if line.is_abandoned.load(Ordering::Relaxed) || line.events.push(event).is_err() {
            return Ok(());
        }
        let mut bytes = pool.take();
        event = match guarded(|| camera.read(&mut bytes)) {
            Ok(shot) => Event::Image(shot, pool.lease(bytes)),
            Err(error) if error.kind == CaptureErrorKind::Corrupt => Event::Damaged(error),
            Err(error) => return Err(error),
        };
    }
}

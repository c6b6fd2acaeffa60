//! Supervision of cameras whose reads may never return: each is read in a thread of its own, which a watchdog abandons
//! when it hangs. A device that hangs holds at most two threads.

mod camera;
mod left;
#[cfg(test)]
mod tests;
mod worker;

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use flyrig_types::{CameraId, Frame, Image, PixelBuffer};

pub(crate) use self::camera::{BlockingCamera, DriverImage, Opener};
use self::worker::{Event, Line};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::pool::BufferPool;
use crate::queue::PopError;
use crate::source::{CameraSource, SourceHealth};
use crate::stamps::{StampSource, Stamps};

/// Periods without a frame after which a streaming camera counts as silent, but never less than [`SILENT_AFTER`].
const SILENT_PERIODS: f64 = 5.0;
const SILENT_AFTER: Duration = Duration::from_millis(500);
/// Time limit of an opening, and of the first frame after it.
const FIRST_FRAME: Duration = Duration::from_secs(5);
/// Most threads of one camera that are abandoned in calls that do not return; one more may hang without being
/// abandoned.
const MOST_ABANDONED: usize = 1;
/// Time that an orderly shutdown allows the camera to close.
const CLOSING: Duration = Duration::from_secs(1);
/// Free buffers kept for later frames.
const POOLED_FRAMES: usize = 16;

/// Expected properties of a camera's frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Expected {
    pub size: (u32, u32),
    /// Frames per second.
    pub fps: f64,
    /// Latency of the timestamps, seconds; subtracted from them.
    pub lag_secs: f64,
}

/// Frame source over a blocking camera.
///
/// A read or an opening that takes too long is abandoned in its thread, which ends as soon as the call returns, and the
/// camera is opened again in a new thread. If that one hangs too it is kept: a camera never has more than two threads
/// in its driver, however often it fails and is reopened.
#[derive(Debug)]
pub(crate) struct Watched<O: Opener> {
    camera: CameraId,
    expected: Expected,
    opener: Arc<O>,
    session: Option<Session>,
    /// Abandoned threads that have not returned yet.
    abandoned: Vec<Arc<Line>>,
    stamps: Stamps,
    frames: u64,
    health: SourceHealth,
    pool: Arc<BufferPool>,
}

/// State between an opening and its end.
#[derive(Debug)]
struct Session {
    line: Arc<Line>,
    /// Time of the last event, or of the start.
    heard: Instant,
    is_flowing: bool,
    /// Whether the next frame is the first one after a reconnect.
    is_back: bool,
    was_asked: bool,
    /// Whether the camera hangs and cannot be abandoned.
    is_stuck: bool,
    /// Frames overtaken by newer ones, as counted so far.
    overtaken: u64,
}

impl Session {
    fn silent_after(&self, fps: f64) -> Duration {
        if self.is_flowing {
            SILENT_AFTER.max(flyrig_types::saturating_secs(SILENT_PERIODS / fps.clamp(0.1, 1e6)))
        } else {
            FIRST_FRAME
        }
    }
}

impl<O: Opener> Watched<O> {
    /// Opens the camera immediately, so that errors are reported at the start.
    pub fn open(camera: &CameraId, expected: Expected, opener: O) -> Result<Self, CaptureError> {
        let abandoned = left::take(&opener.device());
        let mut watched = Self {
            camera: camera.clone(),
            expected,
            opener: Arc::new(opener),
            session: None,
            abandoned,
            stamps: Stamps::default(),
            frames: 0,
            health: SourceHealth::default(),
            pool: BufferPool::new(POOLED_FRAMES),
        };
        let of_camera = |error: CaptureError| error.of(camera);
        if watched.abandoned.len() > MOST_ABANDONED {
            let text =
                "hangs in its driver since it was opened before; unplug it and plug it in again, or restart flyrig";
            return Err(CaptureError::new(camera, CaptureErrorKind::Io, text));
        }
        let session = watched.start().map_err(of_camera)?;
        let opened = session.line.events.pop(FIRST_FRAME);
        let line = Arc::clone(&session.line);
        watched.session = Some(session);
        match opened {
            Ok(_) => watched.report_mode(&line, ""),
            Err(PopError::Closed) => return Err(of_camera(line.end())),
            Err(PopError::Timeout) => {
                let text = format!(
                    "was not opened within {} s: its driver hangs; unplug it and plug it in again",
                    FIRST_FRAME.as_secs()
                );
                return Err(CaptureError::new(camera, CaptureErrorKind::Io, text));
            }
        }
        Ok(watched)
    }

    fn start(&self) -> Result<Session, CaptureError> {
        let line = worker::start(&self.camera, &self.opener, &self.pool)?;
        let (heard, overtaken) = (Instant::now(), 0);
        let is_back = self.frames > 0;
        Ok(Session { line, heard, is_flowing: false, is_back, was_asked: false, is_stuck: false, overtaken })
    }

    fn report_mode(&mut self, line: &Line, stamps: &str) {
        let mode = format!("{}{stamps}", line.mode.get().map_or("", String::as_str));
        if *self.health.mode != *mode {
            self.health.mode = mode.into();
        }
    }

    fn read(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let deadline = Instant::now() + timeout.min(Duration::from_secs(3600));
        if self.session.is_none() {
            self.session = Some(self.start()?);
        }
        loop {
            let Some(session) = &mut self.session else {
                return Err(CaptureError::general(CaptureErrorKind::Disconnected, "is not open"));
            };
            if !std::mem::replace(&mut session.was_asked, true) {
                // Frames overtaken before the first request are no loss.
                session.overtaken = session.line.events.dropped();
            }
            let left = deadline.saturating_duration_since(Instant::now());
            let silent_after = session.silent_after(self.expected.fps);
            // It must not take longer to notice silence than the caller waits.
            let patience = silent_after.saturating_sub(session.heard.elapsed());
            let event = match session.line.events.pop(left.min(patience)) {
                Ok(event) => event,
                Err(PopError::Closed) => {
                    let error = session.line.end();
                    self.session = None;
                    return Err(error);
                }
                Err(PopError::Timeout) if patience > left => {
                    return Err(CaptureError::general(CaptureErrorKind::Timeout, "no frame yet"));
                }
                Err(PopError::Timeout) => return Err(self.silent(silent_after)),
            };
            session.heard = Instant::now();
            let overtaken = session.line.events.dropped();
            self.health.lost_by_driver += overtaken - std::mem::replace(&mut session.overtaken, overtaken);
            match event {
                Event::Opened => {}
                Event::Damaged(error) => return Err(error),
                Event::Image(shot, bytes) => {
                    (session.is_flowing, session.is_stuck) = (true, false);
                    let line = Arc::clone(&session.line);
                    if std::mem::take(&mut session.is_back) {
                        self.health.reconnects += 1;
                        tracing::info!("camera {}: is back", self.camera);
                    }
                    return self.frame(&line, shot, bytes);
                }
            }
        }
    }

    fn frame(&mut self, line: &Line, shot: DriverImage, bytes: PixelBuffer) -> Result<Frame, CaptureError> {
        let number = self.frames + self.health.lost_by_driver;
        self.frames += 1;
        let corrupt =
            |text: String| CaptureError::general(CaptureErrorKind::Corrupt, format!("frame {number}: {text}"));
        let (width, height) = shot.size;
        if shot.size != self.expected.size {
            let (wanted_width, wanted_height) = self.expected.size;
            let text = format!("it is {width}x{height} and not {wanted_width}x{wanted_height} as asked for");
            return Err(corrupt(text));
        }
        let image = Image::new(width, height, shot.format, bytes).map_err(|error| corrupt(error.to_string()))?;
        let half_period = (0.5e9 / self.expected.fps.clamp(0.1, 1e6)) as i64;
        let (stamp, source, note) = match shot.stamp_nanos {
            Some(stamp) => (stamp, StampSource::EndOfFrame, ", stamped by the system"),
            None => (0, StampSource::Other, ", stamped at arrival less half a period"),
        };
        let half = if source == StampSource::Other { half_period } else { 0 };
        let capture = self.stamps.capture_nanos(stamp, source, shot.arrival_nanos, half);
        self.health.stamps_replaced = self.stamps.replaced;
        self.report_mode(line, note);
        Ok(Frame {
            camera: self.camera.clone(),
            sequence: number,
            capture_nanos: capture.saturating_sub((self.expected.lag_secs * 1e9) as i64),
            exposure_nanos: None,
            image,
            mask: None,
        })
    }

    /// Handles a silent camera: abandons its thread where that is allowed.
    fn silent(&mut self, silent_after: Duration) -> CaptureError {
        let disconnected = |text: String| CaptureError::general(CaptureErrorKind::Disconnected, text);
        let Some(session) = &mut self.session else { return disconnected("is not open".to_owned()) };
        self.health.silences += u64::from(!session.is_stuck);
        self.abandoned.retain(|line| !line.events.is_closed());
        if self.abandoned.len() < MOST_ABANDONED {
            session.line.abandon();
            self.abandoned.push(Arc::clone(&session.line));
            self.session = None;
            return disconnected(format!("gave no frame for {} ms; opening it again", silent_after.as_millis()));
        }
        // The next silence is reported again.
        (session.is_stuck, session.is_flowing, session.heard) = (true, false, Instant::now());
        disconnected(
            "hangs in its driver, and so does the attempt to open it again; no other is made until one of them returns: \
             unplug it and plug it in again, or restart flyrig"
                .to_owned(),
        )
    }
}

impl<O: Opener> CameraSource for Watched<O> {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        self.read(timeout).map_err(|error| match error.kind {
            // It was there once and may come back, changed settings of another program included.
            CaptureErrorKind::NotFound | CaptureErrorKind::Unsupported => {
                CaptureError { kind: CaptureErrorKind::Disconnected, ..error }.of(&self.camera)
            }
            _ => error.of(&self.camera),
        })
    }

    fn health(&self) -> SourceHealth {
        self.health.clone()
    }
}

impl<O: Opener> Drop for Watched<O> {
    /// Lets the thread close the camera with its next frame. A thread that hangs lives until the process ends, and
    /// counts against its device when that is opened again.
    fn drop(&mut self) {
        if let Some(session) = self.session.take() {
            session.line.abandon();
            let deadline = Instant::now() + CLOSING;
            if !session.is_stuck {
                while session.line.events.pop(deadline.saturating_duration_since(Instant::now())).is_ok() {}
            }
            self.abandoned.push(session.line);
        }
        left::leave(&self.opener.device(), self.abandoned.drain(..));
    }
}

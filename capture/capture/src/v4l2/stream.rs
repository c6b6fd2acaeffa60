//! Stream of one camera: connecting, supervision and reconnecting.

use std::{
    io,
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use flyrig_types::{CameraId, Frame, Image};

use super::{
    causes::{explain, lost},
    controls::{self, ControlDevice, ControlError},
    format::{fourcc_text, pack},
    modes::{self, Mode, Offer, SAME_RATE},
    queue::{BufferDevice, BufferQueue},
    sequence::Sequence,
    sys::{ActiveFormat, SizeRange},
};
use crate::camera_options::{CameraIdentity, CameraOptions};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::pool::BufferPool;
use crate::source::{CameraSource, SourceHealth};
use crate::stamps::Stamps;

/// Periods without a frame after which a streaming camera counts as silent, but never less than [`SILENT_AFTER`].
const SILENT_PERIODS: f64 = 5.0;
const SILENT_AFTER: Duration = Duration::from_millis(500);
/// Time limit of the first frame after a start.
const FIRST_FRAME: Duration = Duration::from_secs(5);
/// Age above which frames that queued up before the first request (while other cameras were opened) are discarded.
const STALE: Duration = Duration::from_millis(200);
/// Free buffers kept for later frames.
const POOLED_FRAMES: usize = 16;

/// Device that can be configured and streamed from.
pub(crate) trait CameraDevice: BufferDevice + ControlDevice {
    fn formats(&self) -> io::Result<Vec<[u8; 4]>>;
    fn sizes(&self, fourcc: [u8; 4]) -> io::Result<Vec<SizeRange>>;
    fn rates(&self, fourcc: [u8; 4], width: u32, height: u32) -> io::Result<Vec<f64>>;
    fn set_format(&mut self, fourcc: [u8; 4], width: u32, height: u32) -> io::Result<ActiveFormat>;
    fn set_rate(&mut self, fps: f64) -> io::Result<Option<f64>>;
}

/// Environment of a stream: finds devices and reads the clock; scripted in tests.
pub(crate) trait Host: Send {
    type Device: CameraDevice + Send;
    /// Opens the device; returns it with its node and the speed of its USB link, megabits per second, where it has one.
    fn open(&mut self, identity: &CameraIdentity) -> Result<(Self::Device, PathBuf, Option<u32>), CaptureError>;
    /// Returns the time of `CLOCK_MONOTONIC`, nanoseconds.
    fn now_nanos(&self) -> i64;
}

/// Camera as a source of frames in its own pixel format.
#[derive(Debug)]
pub(crate) struct Stream<H: Host> {
    camera: CameraId,
    options: CameraOptions,
    host: H,
    session: Option<Session<H::Device>>,
    /// Steps down in mode that were needed so far; kept across reconnects.
    rung: usize,
    stamps: Stamps,
    sequence: Sequence,
    health: SourceHealth,
    pool: Arc<BufferPool>,
}

/// State between STREAMON and its end.
#[derive(Debug)]
struct Session<D: BufferDevice> {
    queue: BufferQueue<D>,
    active: ActiveFormat,
    fps: f64,
    exposure_nanos: Option<u64>,
    /// Arrival of the last frame, or the start of the stream, nanoseconds.
    last_nanos: i64,
    is_flowing: bool,
    was_asked: bool,
}

impl<H: Host> Stream<H> {
    /// Connects immediately, so that errors are reported at the start.
    pub fn open(camera: &CameraId, options: &CameraOptions, host: H) -> Result<Self, CaptureError> {
        let mut stream = Self {
            camera: camera.clone(),
            options: options.clone(),
            host,
            session: None,
            rung: 0,
            stamps: Stamps::default(),
            sequence: Sequence::default(),
            health: SourceHealth::default(),
            pool: BufferPool::new(POOLED_FRAMES),
        };
        let session = stream.connect().map_err(|error| error.of(camera))?;
        stream.session = Some(session);
        Ok(stream)
    }

    #[cfg(test)]
    pub fn device(&mut self) -> Option<&mut H::Device> {
        self.session.as_mut().map(|session| session.queue.device())
    }

    #[cfg(test)]
    pub fn host(&self) -> &H {
        &self.host
    }

    fn connect(&mut self) -> Result<Session<H::Device>, CaptureError> {
        let unsupported = |text: String| CaptureError::general(CaptureErrorKind::Unsupported, text);
        let (device, node, usb_speed) = self.host.open(&self.options.identity)?;
        let (width, height) = (self.options.width, self.options.height);
        let offers = offers(&device, width, height)
            .map_err(|error| explain(&error, "cannot be asked for its formats", &node))?;
        let camera_bytes = usb_speed.map(|speed| modes::usb_capacity(speed).1);
        let ladder = modes::ladder(self.options.format, self.options.fps, (width, height), &offers, camera_bytes)
            .map_err(|text| unsupported(format!("{text} ({})", node.display())))?;
        let mut queue = BufferQueue::new(device);
        let rung = self.rung.min(ladder.len().saturating_sub(1));
        for (step, mode) in ladder.iter().enumerate().skip(rung) {
            let active = queue
                .device()
                .set_format(mode.fourcc, width, height)
                .map_err(|error| explain(&error, "does not take its format", &node))?;
            if (active.fourcc, active.width, active.height) != (mode.fourcc, width, height) {
                return Err(unsupported(format!(
                    "sends {} {}x{} instead of {} {width}x{height}; set width and height to a size that it has",
                    fourcc_text(active.fourcc),
                    active.width,
                    active.height,
                    fourcc_text(mode.fourcc)
                )));
            }
            let rate = queue.device().set_rate(mode.fps);
            let fps = rate.map_err(|error| explain(&error, "does not take its frame rate", &node))?.unwrap_or(mode.fps);
            if (fps / mode.fps - 1.0).abs() > SAME_RATE {
                tracing::warn!(
                    "camera {}: {:.2} frames per second were requested, it runs at {fps:.2}",
                    self.camera,
                    mode.fps
                );
            }
            match queue.start(self.options.buffers) {
                Ok(()) => {
                    if step > rung {
                        let (wanted, got) = (describe(&ladder[rung]), describe(mode));
                        tracing::warn!("camera {}: its bus has no room for {wanted}; it sends {got}", self.camera);
                    }
                    self.rung = step;
                    return self.set_up(queue, active, fps, mode, &node);
                }
                Err(error) if error.raw_os_error() == Some(libc::ENOSPC) => {}
                Err(error) => return Err(explain(&error, "cannot be started", &node)),
            }
        }
        Err(CaptureError::general(
            CaptureErrorKind::Io,
            format!(
                "its USB bus has no room for it, even as {}; plug it into a port of another controller (`flyrig doctor` shows \
                 who shares a bus)",
                ladder.last().map(describe).unwrap_or_default()
            ),
        ))
    }

    fn set_up(
        &mut self,
        mut queue: BufferQueue<H::Device>,
        active: ActiveFormat,
        fps: f64,
        mode: &Mode,
        node: &Path,
    ) -> Result<Session<H::Device>, CaptureError> {
        // Some cameras forget their settings when a stream starts.
        let (exposure_nanos, warnings) =
            controls::apply(&self.options.controls, queue.device()).map_err(|error| match error {
                ControlError::Refused(text) => CaptureError::general(CaptureErrorKind::Unsupported, text),
                ControlError::Io(error) => explain(&error, "does not take its settings", node),
            })?;
        for warning in warnings {
            tracing::warn!("camera {}: {warning}", self.camera);
        }
        self.health.mode =
            format!("{} {}x{} at {fps:.2}", fourcc_text(mode.fourcc), active.width, active.height).into();
        self.sequence.restart();
        tracing::debug!("camera {}: {} as {}", self.camera, node.display(), self.health.mode);
        Ok(Session {
            queue,
            active,
            fps,
            exposure_nanos,
            last_nanos: self.host.now_nanos(),
            is_flowing: false,
            was_asked: false,
        })
    }

    fn read(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        if self.session.is_none() {
            let session = self.connect().map_err(|error| match error.kind {
                // It was there once and may come back, changed settings of another program included.
                CaptureErrorKind::NotFound | CaptureErrorKind::Unsupported => {
                    CaptureError { kind: CaptureErrorKind::Disconnected, ..error }
                }
                _ => error,
            })?;
            self.session = Some(session);
            self.health.reconnects += 1;
            tracing::info!("camera {}: is back as {}", self.camera, self.health.mode);
        }
        let Some(session) = &mut self.session else {
            return Err(CaptureError::general(CaptureErrorKind::Disconnected, "is not connected"));
        };
        let now = self.host.now_nanos();
        let nanos = |time: Duration| i64::try_from(time.as_nanos()).unwrap_or(i64::MAX);
        if !std::mem::replace(&mut session.was_asked, true) && now.saturating_sub(session.last_nanos) > nanos(STALE) {
            session.discard(self.options.buffers).map_err(|error| lost(&error))?;
        }
        // It must not take longer to notice silence than the caller waits.
        let silent_after = session.silent_after();
        let patience = nanos(silent_after).saturating_sub(now.saturating_sub(session.last_nanos));
        let patience = Duration::from_nanos(u64::try_from(patience).unwrap_or(0));
        let lease = session.queue.next(timeout.min(patience)).map_err(|error| lost(&error))?;
        let arrival = self.host.now_nanos();
        let Some(lease) = lease else {
            if patience > timeout {
                return Err(CaptureError::general(CaptureErrorKind::Timeout, "no frame yet"));
            }
            self.health.silences += 1;
            let text = format!("gave no frame for {} ms; starting it again", silent_after.as_millis());
            return Err(CaptureError::general(CaptureErrorKind::Disconnected, text));
        };
        session.last_nanos = arrival;
        session.is_flowing = true;
        let number = self.sequence.count(lease.buffer.sequence);
        self.health.lost_by_driver = self.sequence.lost;
        let corrupt =
            |text: String| CaptureError::general(CaptureErrorKind::Corrupt, format!("frame {number}: {text}"));
        if lease.buffer.is_broken {
            return Err(corrupt("the driver flags it as damaged".to_owned()));
        }
        let mut bytes = self.pool.take();
        let packed = pack(&session.active, |plane| lease.plane(plane), &mut bytes);
        let (stamp, source) = (lease.buffer.stamp_nanos, lease.buffer.stamp_source);
        drop(lease);
        let format = packed.map_err(corrupt)?;
        let (width, height) = (session.active.width, session.active.height);
        let image = Image::new(width, height, format, self.pool.lease(bytes));
        let exposure = session.exposure_nanos;
        let whole = exposure.unwrap_or(0) as f64 + self.options.readout_secs * 1e9;
        let capture = self.stamps.capture_nanos(stamp, source, arrival, (whole / 2.0) as i64);
        self.health.stamps_replaced = self.stamps.replaced;
        Ok(Frame {
            camera: self.camera.clone(),
            sequence: number,
            capture_nanos: capture.saturating_sub((self.options.lag_secs * 1e9) as i64),
            exposure_nanos: exposure,
            image: image.map_err(|error| corrupt(error.to_string()))?,
            mask: None,
        })
    }
}

impl<D: BufferDevice> Session<D> {
    fn silent_after(&self) -> Duration {
        if self.is_flowing {
            SILENT_AFTER.max(flyrig_types::saturating_secs(SILENT_PERIODS / self.fps.clamp(0.1, 1e6)))
        } else {
            FIRST_FRAME
        }
    }

    /// Discards frames that queued up before the first request.
    fn discard(&mut self, buffers: u32) -> io::Result<()> {
        for _ in 0..buffers {
            if self.queue.next(Duration::ZERO)?.is_none() {
                break;
            }
        }
        Ok(())
    }
}

impl<H: Host> CameraSource for Stream<H> {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let result = self.read(timeout);
        if matches!(&result, Err(error) if matches!(error.kind, CaptureErrorKind::Disconnected | CaptureErrorKind::Io))
        {
            self.session = None;
        }
        result.map_err(|error| error.of(&self.camera))
    }

    fn health(&self) -> SourceHealth {
        self.health.clone()
    }
}

fn describe(mode: &Mode) -> String {
    format!("{} at {:.2} frames per second", fourcc_text(mode.fourcc), mode.fps)
}

/// Lists the formats that a device has at a size.
pub(crate) fn offers(device: &impl CameraDevice, width: u32, height: u32) -> io::Result<Vec<Offer>> {
    let mut offers = Vec::new();
    for fourcc in device.formats()? {
        let sizes = device.sizes(fourcc)?;
        let on = |[low, high, step]: [u32; 3], side: u32| {
            (low..=high).contains(&side) && (step < 2 || (side - low).is_multiple_of(step))
        };
        let has = |size: &SizeRange| match *size {
            SizeRange::One(w, h) => (w, h) == (width, height),
            SizeRange::Steps(w, h) => on(w, width) && on(h, height),
        };
        if sizes.is_empty() || sizes.iter().any(has) {
            offers.push(Offer { fourcc, rates: device.rates(fourcc, width, height)? });
        }
    }
    Ok(offers)
}

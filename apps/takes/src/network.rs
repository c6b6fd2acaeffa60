//! Cameras of other computers, behind the same trait as all others.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result};
use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind, NetworkHealth, SourceHealth, SourceOpener};
use flyrig_transport::{CameraLink, CameraStatus, CameraSubscriber, HostClock, TransportConfig, TransportErrorKind};
use flyrig_types::{CameraId, Frame, Rig, ThreadWatch};

/// A camera that was there is silent after this.
const SILENT: Duration = Duration::from_millis(700);
/// A camera that was not there yet is missed after this.
const FIRST_FRAME: Duration = Duration::from_secs(5);
/// How often the health is put together.
const HEALTH_EVERY: Duration = Duration::from_millis(250);

/// This computer's clock.
pub fn host_clock() -> HostClock {
    HostClock::new(flyrig_capture::monotonic_nanos)
}

/// Returns an opener for every camera of the rig, all in one session, and the thread that compares their clocks.
///
/// # Errors
/// Names settings of the session that are wrong.
pub fn openers(transport: &TransportConfig, rig: &Rig) -> Result<(Vec<SourceOpener>, ThreadWatch)> {
    let cameras: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    // It listens nowhere: that address is the results'.
    let transport = TransportConfig { listen: Vec::new(), ..transport.clone() };
    let subscriber = CameraSubscriber::open(&transport, &cameras, host_clock())
        .context("source.kind is \"network\": transport.connect must name the computers with cameras or a router")?;
    let clocks = subscriber.clock_thread();
    let subscriber = Arc::new(subscriber);
    let opener = |camera: &flyrig_types::Camera| {
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let (id, subscriber) = (camera.id.clone(), Arc::clone(&subscriber));
        SourceOpener::new(&camera.id, move || {
            Ok(Box::new(NetworkCamera::new(id.clone(), size, Arc::clone(&subscriber))) as Box<dyn CameraSource>)
        })
    };
    Ok((rig.cameras.iter().map(opener).collect(), clocks))
}

/// A camera of another computer, with capture times on this computer's clock.
struct NetworkCamera {
    camera: CameraId,
    /// As calibrated.
    size: (u32, u32),
    subscriber: Arc<CameraSubscriber>,
    /// The last frame, or the start.
    heard: Instant,
    has_come: bool,
    is_missed: bool,
    returns: u64,
    silences: u64,
    /// The link when this was opened. It goes on counting while a camera is opened again, and the counts of earlier sources
    /// are kept elsewhere.
    opened: CameraLink,
    health: SourceHealth,
    health_at: Option<Instant>,
}

impl NetworkCamera {
    fn new(camera: CameraId, size: (u32, u32), subscriber: Arc<CameraSubscriber>) -> Self {
        let opened = subscriber.link(&camera);
        Self {
            camera,
            size,
            subscriber,
            opened,
            heard: Instant::now(),
            has_come: false,
            is_missed: false,
            returns: 0,
            silences: 0,
            health: SourceHealth::default(),
            health_at: None,
        }
    }

    fn error(&self, kind: CaptureErrorKind, message: impl Into<String>) -> CaptureError {
        CaptureError::new(&self.camera, kind, message)
    }

    fn nothing(&mut self) -> CaptureError {
        let why = self.subscriber.absence(&self.camera);
        let patience = if self.has_come { SILENT } else { FIRST_FRAME };
        if self.is_missed || self.heard.elapsed() < patience {
            return self.error(CaptureErrorKind::Timeout, why);
        }
        self.is_missed = true;
        self.silences += u64::from(self.has_come);
        self.error(CaptureErrorKind::Disconnected, why)
    }

    fn look(&mut self) {
        if self.health_at.is_some_and(|at| at.elapsed() < HEALTH_EVERY) {
            return;
        }
        self.health_at = Some(Instant::now());
        let link = self.subscriber.link(&self.camera);
        let mut health = health_since(&link, &self.opened);
        health.reconnects = health.reconnects.saturating_add(self.returns);
        health.silences = health.silences.saturating_add(self.silences);
        if health.mode == self.health.mode {
            health.mode = Arc::clone(&self.health.mode);
        }
        self.health = health;
    }
}

/// Returns the health of a link, counted since it was as in `opened`.
fn health_since(link: &CameraLink, opened: &CameraLink) -> SourceHealth {
    // A camera's computer that starts anew counts from 0.
    let since = |now: u64, then: u64| now.checked_sub(then).unwrap_or(now);
    let (no_status, none) = (CameraStatus::default(), CameraStatus::default());
    let (status, then) = (link.status.as_ref().unwrap_or(&no_status), opened.status.as_ref().unwrap_or(&none));
    SourceHealth {
        lost_by_driver: since(status.lost_by_driver, then.lost_by_driver),
        reconnects: since(status.reconnects, then.reconnects),
        silences: since(status.silences, then.silences),
        stamps_replaced: since(status.stamps_replaced, then.stamps_replaced),
        mode: status.mode.as_str().into(),
        network: Some(NetworkHealth {
            overtaken_before: since(link.withheld, opened.withheld),
            lost_on_the_way: since(link.lost, opened.lost),
            overtaken_here: since(link.overtaken, opened.overtaken),
            refused: since(link.refused, opened.refused),
            before_clock: since(link.before_clock, opened.before_clock),
            clock_offset_nanos: link.clock.map(|clock| clock.offset_nanos),
            clock_drift_ppb: link.clock.map_or(0, |clock| (clock.drift_ppm * 1e3) as i64),
            round_trip_nanos: link.clock.map_or(0, |clock| clock.round_trip_nanos.unsigned_abs()),
        }),
    }
}

impl CameraSource for NetworkCamera {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let came = self.subscriber.next_frame(&self.camera, timeout);
        self.look();
        let frame = match came {
            Ok(Some(frame)) => frame,
            Ok(None) => return Err(self.nothing()),
            Err(error) if error.kind == TransportErrorKind::Config => {
                return Err(self.error(CaptureErrorKind::Unsupported, error.to_string()));
            }
            Err(error) => return Err(self.error(CaptureErrorKind::Corrupt, error.to_string())),
        };
        self.heard = Instant::now();
        self.has_come = true;
        if std::mem::take(&mut self.is_missed) {
            self.returns += 1;
            tracing::info!("camera {}: is back", self.camera);
        }
        let (width, height) = (frame.image.width(), frame.image.height());
        if (width, height) != self.size {
            let text = format!(
                "frame {} is {width}x{height}, its calibration {}x{}; set its size on its computer, or recalibrate it",
                frame.sequence, self.size.0, self.size.1
            );
            return Err(self.error(CaptureErrorKind::Corrupt, text));
        }
        Ok(frame)
    }

    fn health(&self) -> SourceHealth {
        self.health.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_is_opened_anew_counts_nothing_twice() {
        let link = |lost, reconnects| CameraLink {
            lost,
            status: Some(CameraStatus { reconnects, mode: "YUYV".to_owned(), ..CameraStatus::default() }),
            ..CameraLink::default()
        };
        let counts = |now: &CameraLink, opened: &CameraLink| {
            let health = health_since(now, opened);
            (health.network.unwrap().lost_on_the_way, health.reconnects)
        };
        assert_eq!(counts(&link(5, 2), &CameraLink::default()), (5, 2));
        let opened = link(5, 2);
        assert_eq!(counts(&opened, &opened), (0, 0), "these belong to the source before");
        assert_eq!(counts(&link(8, 3), &opened), (3, 1));
        assert_eq!(counts(&link(8, 1), &opened), (3, 1), "its computer has counted anew");
        assert_eq!(&*health_since(&link(8, 1), &opened).mode, "YUYV");
    }
}

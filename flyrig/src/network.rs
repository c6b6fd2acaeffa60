//! Cameras of other computers, behind the same trait as all others.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result};
use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind, NetworkHealth, SourceHealth, SourceOpener};
use flyrig_transport::{CameraSubscriber, HostClock, TransportConfig, TransportErrorKind};
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
    health: SourceHealth,
    health_at: Option<Instant>,
}

impl NetworkCamera {
    fn new(camera: CameraId, size: (u32, u32), subscriber: Arc<CameraSubscriber>) -> Self {
        Self {
            camera,
            size,
            subscriber,
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
        let status = link.status.unwrap_or_default();
        if *self.health.mode != *status.mode {
            self.health.mode = status.mode.as_str().into();
        }
        self.health.lost_by_driver = status.lost_by_driver;
        self.health.stamps_replaced = status.stamps_replaced;
        self.health.reconnects = status.reconnects.saturating_add(self.returns);
        self.health.silences = status.silences.saturating_add(self.silences);
        self.health.network = Some(NetworkHealth {
            overtaken_before: link.withheld,
            lost_on_the_way: link.lost,
            overtaken_here: link.overtaken,
            refused: link.refused,
            before_clock: link.before_clock,
            clock_offset_nanos: link.clock.map(|clock| clock.offset_nanos),
            clock_drift_ppb: link.clock.map_or(0, |clock| (clock.drift_ppm * 1e3) as i64),
            round_trip_nanos: link.clock.map_or(0, |clock| clock.round_trip_nanos.unsigned_abs()),
        });
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
                "frame {} is {width}x{height}, its calibration {}x{}; set its size on its computer, or calibrate it anew",
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

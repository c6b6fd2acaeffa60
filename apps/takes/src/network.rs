//! Cameras of other computers as capture sources.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result};
use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind, NetworkHealth, SourceHealth, SourceOpener};
use flyrig_transport::{CameraLink, CameraStatus, CameraSubscriber, HostClock, TransportConfig, TransportErrorKind};
use flyrig_types::{CameraId, Frame, Rig, ThreadWatch};

/// Silence after which a camera that has delivered frames counts as disconnected.
const SILENT: Duration = Duration::from_millis(700);
/// Time that a camera has for its first frame before it counts as disconnected.
const FIRST_FRAME: Duration = Duration::from_secs(5);
/// Interval at which the health is updated.
const HEALTH_EVERY: Duration = Duration::from_millis(250);

/// Returns this computer's monotonic clock.
#[must_use]
pub fn host_clock() -> HostClock {
    HostClock::new(flyrig_capture::monotonic_nanos)
}

/// Returns an opener for every camera of the rig, all in one session, and the thread that measures their clock offsets.
///
/// # Errors
/// Names settings of the session that are wrong.
pub(crate) fn openers(transport: &TransportConfig, rig: &Rig) -> Result<(Vec<SourceOpener>, ThreadWatch)> {
    let cameras: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    // `listen` is the address of the results, so this session must not listen there.
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

/// Camera of another computer, with capture times on this computer's clock.
struct NetworkCamera {
    camera: CameraId,
    /// Calibrated width and height, pixels.
    size: (u32, u32),
    subscriber: Arc<CameraSubscriber>,
    /// Time of the last frame, or of the opening.
    heard: Instant,
    has_come: bool,
    is_missed: bool,
    returns: u64,
    silences: u64,
    /// Link when this source was opened: its counts continue when a camera is opened again, and those of earlier sources are kept
    /// elsewhere.
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

    fn missing_frame_error(&mut self) -> CaptureError {
        let why = self.subscriber.absence(&self.camera);
        let patience = if self.has_come { SILENT } else { FIRST_FRAME };
        if self.is_missed || self.heard.elapsed() < patience {
            return self.error(CaptureErrorKind::Timeout, why);
        }
        self.is_missed = true;
        self.silences += u64::from(self.has_come);
        self.error(CaptureErrorKind::Disconnected, why)
    }

    fn update_health(&mut self) {
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

/// Returns the health of a link, with counts since its state `opened`.
fn health_since(link: &CameraLink, opened: &CameraLink) -> SourceHealth {
    // Counts restart at 0 when the camera's computer restarts.
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
        self.update_health();
        let frame = match came {
            Ok(Some(frame)) => frame,
            Ok(None) => return Err(self.missing_frame_error()),
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
    use flyrig_capture::{CaptureThreads, ThreadsConfig};
    use flyrig_transport::CameraPublisher;
    use flyrig_types::{Camera, Image, Intrinsics, Isometry, PixelFormat};

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

    #[test]
    fn a_camera_of_another_computer_at_half_rate_is_slow() {
        let name = CameraId::from("far");
        let listen = vec!["tcp/127.0.0.1:0".to_owned()];
        let config = TransportConfig { listen, ..TransportConfig::publisher("slow") };
        let host = CameraPublisher::open(&config, std::slice::from_ref(&name), host_clock()).unwrap();
        let config = TransportConfig { connect: host.endpoints().to_vec(), ..TransportConfig::subscriber("slow") };
        let camera = Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: name.clone(),
            intrinsics: Intrinsics::pinhole(2, 1, 2.0),
            camera_from_world: Isometry::IDENTITY,
        };
        let rig = Rig { cameras: vec![camera], world_up: glam::DVec3::Z };
        let (openers, _) = openers(&config, &rig).unwrap();
        let threads = CaptureThreads::start_opening(openers, ThreadsConfig::default()).unwrap();
        let status = CameraStatus { mode: "GREY 2x1 at 30.00".to_owned(), ..CameraStatus::default() };
        let (mut begun, mut sequence, mut count, end) = (None, 0u64, 0i64, Instant::now() + Duration::from_secs(60));
        let rate = loop {
            assert!(Instant::now() < end, "{:?}", threads.stats());
            // At 15 per second by the camera's clock, and faster than that by ours: frames may be seconds old.
            let first = *begun.get_or_insert_with(|| host_clock().now_nanos() - 6_000_000_000);
            (sequence, count) = (sequence + 1, count + 1);
            let capture_nanos = first + count * 66_666_667;
            let image = Image::new(2, 1, PixelFormat::Gray8, vec![0; 2]).unwrap();
            let camera = name.clone();
            host.publish(Frame { camera, sequence, capture_nanos, exposure_nanos: None, image, mask: None }).unwrap();
            host.publish_status(&name, &status).unwrap();
            std::thread::sleep(Duration::from_millis(20));
            if let Some(rate) = threads.stats()[0].rate {
                break rate;
            }
            // The clock of the other computer was not known in time.
            if capture_nanos > host_clock().now_nanos() {
                (begun, count) = (None, 0);
            }
        };
        assert!(rate.is_slow() && (rate.ratio() - 0.5).abs() < 0.01, "{rate:?}");
    }
}

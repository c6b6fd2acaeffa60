//! Cameras that capture at less than the rate of their mode.

use std::{collections::BTreeMap, fmt};

use flyrig_capture::FrameRate;
use flyrig_fusion::Health;
use flyrig_types::CameraId;

/// Watch over the rates of all cameras.
#[derive(Debug, Default)]
pub(crate) struct RateWatch(BTreeMap<CameraId, Slowness>);

#[derive(Debug, Default)]
struct Slowness {
    is_slow: bool,
    /// Number of times that it became slow.
    times: u64,
}

/// Change of a camera's rate that is to be logged.
#[derive(Debug)]
pub(crate) struct RateChange {
    camera: CameraId,
    rate: FrameRate,
}

impl RateWatch {
    /// Returns the cameras that became slow, the 1st, 2nd, 4th time, and those whose rate is back. A camera that is gone is neither.
    pub fn changes(&mut self, health: &Health) -> Vec<RateChange> {
        let mut changes = Vec::new();
        for camera in &health.cameras {
            let name = &camera.stats.camera;
            let Some(rate) = camera.stats.rate.filter(|_| camera.is_up()) else {
                self.0.entry(name.clone()).or_default().is_slow = false;
                continue;
            };
            let known = self.0.entry(name.clone()).or_default();
            if std::mem::replace(&mut known.is_slow, rate.is_slow()) == rate.is_slow() {
                continue;
            }
            known.times += u64::from(rate.is_slow());
            if known.times.is_power_of_two() {
                changes.push(RateChange { camera: name.clone(), rate });
            }
        }
        changes
    }
}

impl RateChange {
    pub fn log(&self) {
        if self.rate.is_slow() {
            tracing::warn!("{self}");
        } else {
            tracing::info!("{self}");
        }
    }
}

impl fmt::Display for RateChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (camera, FrameRate { mode_fps, measured_fps }) = (&self.camera, self.rate);
        write!(f, "camera {camera}: captures {measured_fps:.1} of the {mode_fps:.1} frames per second of its mode")?;
        if !self.rate.is_slow() {
            return f.write_str(" again");
        }
        write!(
            f,
            ", probably since its exposure is longer than {:.0} ms; set exposure_ms of the camera to less and add light, or lower its fps",
            1e3 / mode_fps
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_camera_is_reported_once_and_when_it_is_back() {
        let (mut watch, mut health) = (RateWatch::default(), crate::table::tests::health());
        let mut changes = |measured_fps: Option<f64>, quiet_s: f64| -> Vec<String> {
            let camera = &mut health.cameras[0];
            camera.stats.rate = measured_fps.map(|measured_fps| FrameRate { mode_fps: 30.0, measured_fps });
            camera.quiet_s = Some(quiet_s);
            watch.changes(&health).iter().map(ToString::to_string).collect()
        };
        assert!(changes(None, 0.1).is_empty() && changes(Some(29.9), 0.1).is_empty());
        let slow = changes(Some(15.0), 0.1);
        let expected = "camera le\"ft: captures 15.0 of the 30.0 frames per second of its mode, probably since its exposure is longer than \
                        33 ms; set exposure_ms of the camera to less and add light, or lower its fps";
        assert_eq!(slow, [expected]);
        assert!(changes(Some(15.0), 0.1).is_empty());
        assert_eq!(
            changes(Some(30.0), 0.1),
            ["camera le\"ft: captures 30.0 of the 30.0 frames per second of its mode again"]
        );
        // Gone while slow: that is another message.
        assert_eq!(changes(Some(15.0), 0.1).len(), 1);
        assert!(changes(Some(15.0), 60.0).is_empty() && changes(None, 60.0).is_empty());
        // The third time is not logged, the fourth is.
        assert_eq!(
            [changes(Some(9.0), 0.1).len(), changes(Some(30.0), 0.1).len(), changes(Some(9.0), 0.1).len()],
            [0, 0, 1]
        );
    }
}

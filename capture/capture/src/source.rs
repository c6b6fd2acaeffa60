//! Common trait of all frame sources, and their health.

use std::{sync::Arc, time::Duration};

use flyrig_types::{CameraId, Frame};

use crate::error::CaptureError;

/// Health of a source beyond its frames and errors; counts since its creation.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SourceHealth {
    /// Frames numbered by the driver that were never received.
    pub lost_by_driver: u64,
    /// Reconnects after the camera was gone.
    pub reconnects: u64,
    /// Periods of silence without an error.
    pub silences: u64,
    /// Implausible timestamps that were replaced.
    pub stamps_replaced: u64,
    /// Format, size and rate in use, as text such as `YUYV 640x360 at 30.00`, and notes after it; empty where the source does not report
    /// them.
    pub mode: Arc<str>,
    /// Network statistics of a camera on another computer.
    pub network: Option<NetworkHealth>,
}

impl SourceHealth {
    /// Returns the frame rate of the mode, frames per second; `None` where the source does not report it.
    #[must_use]
    pub fn mode_fps(&self) -> Option<f64> {
        let (_, rate) = self.mode.split_once(" at ")?;
        let end = rate.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(rate.len());
        rate[..end].parse().ok().filter(|fps: &f64| fps.is_finite() && *fps > 0.0)
    }
}

/// Network statistics of a camera on another computer; counts since the subscription began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NetworkHealth {
    /// Frames that never left the camera's computer: overtaken by newer ones, without a subscriber, or failed to send.
    pub overtaken_before: u64,
    /// Frames that were sent and never arrived.
    pub lost_on_the_way: u64,
    /// Frames that arrived and were overtaken before they were read.
    pub overtaken_here: u64,
    /// Rejected messages: damaged, hostile, of another publisher, or with an implausible timestamp.
    pub refused: u64,
    /// Frames that arrived before the other computer's clock was known.
    pub before_clock: u64,
    /// Clock of the camera's computer minus the local one, nanoseconds; `None` until it is known.
    pub clock_offset_nanos: Option<i64>,
    /// Drift of that clock against the local one, parts in 10^9; positive if it runs faster.
    pub clock_drift_ppb: i64,
    /// Shortest recent round trip, nanoseconds; half of it bounds the clock-offset error.
    pub round_trip_nanos: u64,
}

/// Camera, physical, recorded or simulated, read by one thread.
pub trait CameraSource: Send {
    /// Returns the name of the camera, which never changes.
    fn camera(&self) -> &CameraId;

    /// Returns the next frame in the order of capture. Blocks for about `timeout` at most on a camera; a recording may
    /// take as long as decoding takes.
    ///
    /// # Errors
    /// After a recoverable error ([`crate::CaptureErrorKind::is_recoverable`]) the next call continues: with the next
    /// frame after `Corrupt`, with a reconnect after `Disconnected` and `Io`. Every other kind is final for this
    /// source, `EndOfStream` for its camera.
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError>;

    /// Returns the time by which [`crate::Pacing::Lossless`] sorts the last frame among those of other cameras,
    /// nanoseconds: its capture time, unless the source knows that its timestamps are wrong.
    fn order_nanos(&self, frame: &Frame) -> i64 {
        frame.capture_nanos
    }

    /// Returns the earliest [`Self::order_nanos`] of the next frame, nanoseconds, where the source knows it after an
    /// error: the other cameras then proceed without it.
    fn next_nanos(&self) -> Option<i64> {
        None
    }

    /// Returns the counts beyond frames and errors.
    fn health(&self) -> SourceHealth {
        SourceHealth::default()
    }
}

impl<S: CameraSource + ?Sized> CameraSource for Box<S> {
    fn camera(&self) -> &CameraId {
        (**self).camera()
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        (**self).next_frame(timeout)
    }

    fn order_nanos(&self, frame: &Frame) -> i64 {
        (**self).order_nanos(frame)
    }

    fn next_nanos(&self) -> Option<i64> {
        (**self).next_nanos()
    }

    fn health(&self) -> SourceHealth {
        (**self).health()
    }
}

/// Implements [`CameraSource`] for a newtype by forwarding to its field, which has methods of the same names.
macro_rules! forward_source {
    ($source:ty) => {
        impl $crate::CameraSource for $source {
            fn camera(&self) -> &flyrig_types::CameraId {
                self.0.camera()
            }

            fn next_frame(
                &mut self,
                timeout: std::time::Duration,
            ) -> Result<flyrig_types::Frame, $crate::CaptureError> {
                self.0.next_frame(timeout)
            }

            fn health(&self) -> $crate::SourceHealth {
                self.0.health()
            }
        }
    };
}
pub(crate) use forward_source;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_of_a_mode_is_the_number_after_at() {
        for (mode, fps) in [
            ("YUYV 640x360 at 30.00", Some(30.0)),
            ("MJPEG 640x480 at 25 through nokhwa, stamped at arrival less half a period", Some(25.0)),
            ("96x96 at 0.50", Some(0.5)),
            ("", None),
            ("Mjpeg 640x480", None),
            ("x at rest", None),
            ("x at 0", None),
            ("x at 1.2.3", None),
        ] {
            let health = SourceHealth { mode: mode.into(), ..SourceHealth::default() };
            assert_eq!(health.mode_fps(), fps, "{mode}");
        }
    }
}

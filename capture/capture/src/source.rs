//! The one trait behind which every camera stands.

use std::{sync::Arc, time::Duration};

use flyrig_types::{CameraId, Frame};

use crate::CaptureError;

/// What a source knows of itself beyond its frames and errors; counts since it was made.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SourceHealth {
    /// Frames that the driver numbered and nobody got.
    pub lost_by_driver: u64,
    /// Times that the camera came back after it was gone.
    pub reconnects: u64,
    /// Times that it went silent without an error.
    pub silences: u64,
    /// Time stamps that could not be right and were replaced.
    pub stamps_replaced: u64,
    /// Format, size and rate in force, as text; empty where it says nothing.
    pub mode: Arc<str>,
    /// Of a camera on another computer.
    pub network: Option<NetworkHealth>,
}

/// What happens to a camera's frames between its computer and this one; counts since this one listens.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NetworkHealth {
    /// Frames that stayed on the camera's computer: newer ones overtook them, nobody listened, or sending failed.
    pub overtaken_before: u64,
    /// Frames that left and never came.
    pub lost_on_the_way: u64,
    /// Frames that came and were overtaken before they were read.
    pub overtaken_here: u64,
    /// Messages that could not be used: damaged, hostile, of another publisher, with a stamp that cannot be right.
    pub refused: u64,
    /// Frames that came before the other computer's clock was known.
    pub before_clock: u64,
    /// Clock of the camera's computer minus ours, nanoseconds; none as long as it is not known.
    pub clock_offset_nanos: Option<i64>,
    /// How much faster that clock runs than ours, parts in 10^9.
    pub clock_drift_ppb: i64,
    /// Shortest round trip of late: half of it bounds the error of the offset, nanoseconds.
    pub round_trip_nanos: u64,
}

/// A camera, real, recorded or simulated, read by one thread.
pub trait CameraSource: Send {
    /// Name of the camera; never changes.
    fn camera(&self) -> &CameraId;

    /// The next frame in the order of capture; waits at most about `timeout` for a camera, while a
    /// recording may take as long as decoding takes.
    ///
    /// # Errors
    /// After an error of a recoverable kind ([`crate::CaptureErrorKind::is_recoverable`]) the next
    /// call goes on: with the next frame after `Corrupt`, with an attempt to reconnect after
    /// `Disconnected` and `Io`. Every other kind is final for this source, `EndOfStream` for its camera.
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError>;

    /// Time by which [`crate::Pacing::Lossless`] puts the frame given last in order with those of other
    /// cameras, nanoseconds: its capture time, unless the source knows that its stamps are wrong.
    fn order_nanos(&self, frame: &Frame) -> i64 {
        frame.capture_nanos
    }

    /// Earliest [`Self::order_nanos`] that the next frame can have, nanoseconds, where the source knows it after an error: the others
    /// then go on without it.
    fn next_nanos(&self) -> Option<i64> {
        None
    }

    /// Counts beyond frames and errors.
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

//! State of the link to a camera of another computer.

use crate::cameras::{frame::CameraStatus, host_clock::ClockEstimate};

/// Fate of a camera's frames; counts since this side was opened.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CameraLink {
    /// Frames that arrived and could be used.
    pub frames: u64,
    /// Frames replaced before they left the camera's computer, or not sent for lack of a subscriber.
    pub withheld: u64,
    /// Frames that were sent and never arrived.
    pub lost: u64,
    /// Frames replaced by newer ones before they were read, or dropped because too many bytes waited over all cameras.
    pub overtaken: u64,
    /// Messages that could not be used; the errors state why.
    pub refused: u64,
    /// Frames that arrived before the clock of their computer was known.
    pub before_clock: u64,
    /// Number of times that another program began to publish the camera: a restart, or another computer.
    pub restarts: u64,
    /// Clock of the camera's computer.
    pub clock: Option<ClockEstimate>,
    /// Status of the camera as its computer reports it.
    pub status: Option<CameraStatus>,
}

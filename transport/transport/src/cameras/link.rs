//! State of the line to a camera.

use crate::cameras::{frame::CameraStatus, host_clock::ClockEstimate};

/// What became of a camera's frames on their way; counts since this side was opened.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CameraLink {
    /// Frames that came and could be used.
    pub frames: u64,
    /// Frames overtaken before they left the camera's computer, or not sent because nobody listened.
    pub withheld: u64,
    /// Frames that left and never came.
    pub lost: u64,
    /// Frames that newer ones overtook here before they were read, or that were dropped because too many bytes waited over
    /// all cameras.
    pub overtaken: u64,
    /// Messages that could not be used; the errors tell why.
    pub refused: u64,
    /// Frames that came before their computer's clock was known.
    pub before_clock: u64,
    /// Times that another program began to publish the camera: a restart, or another computer.
    pub restarts: u64,
    /// The clock of the camera's computer.
    pub clock: Option<ClockEstimate>,
    /// What that computer says of the camera.
    pub status: Option<CameraStatus>,
}

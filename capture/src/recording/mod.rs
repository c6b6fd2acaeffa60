//! Recordings: MCAP files of foxglove messages, which other programs open too.
//!
//! `camera/<name>` holds foxglove `CompressedImage` (JPEG pictures as the camera sent them) or `RawImage` (every other
//! format, bytes as they came), protobuf, logged at capture time. Nothing is encoded anew, so a replay gives the very
//! frames that were recorded. What else a program wants to find (calibrations) stands before the first frame.

mod message;
mod reader;
#[cfg(test)]
mod tests;
mod writer;

pub use self::{
    reader::{McapReplay, recorded_notes},
    writer::{Note, Recorded, Recorder, Recording},
};

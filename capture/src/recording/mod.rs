//! Recordings: MCAP files of foxglove messages, which other programs open too.
//!
//! `camera/<name>` holds foxglove `CompressedImage` (JPEG pictures as the camera sent them, and what a [`Compression`] made
//! of others) or `RawImage` (every other format, bytes as they came), protobuf, logged at capture time. A replay gives the
//! very frames that are in the file. What else a program wants to find (calibrations) stands before the first frame.

mod compress;
mod message;
mod reader;
mod tap;
#[cfg(test)]
mod tests;
mod writer;

pub use self::{
    compress::Compression,
    reader::{McapReplay, recorded_messages, recorded_notes},
    tap::{MessageTap, Recording},
    writer::{Note, Recorded, Recorder},
};

//! Recordings: MCAP files of foxglove messages, which other programs open too.
//!
//! `camera/<name>` holds foxglove `CompressedImage` (JPEG images as the camera sent them, and what a [`Compression`] made
//! of others) or `RawImage` (every other format, bytes as they came), protobuf, logged at capture time. A replay gives the
//! very frames that are in the file. What else a program wants to find (calibrations) stands before the first frame.
//! A [`Rotation`] divides a long recording into files that are complete each by itself.

mod compress;
mod disk;
mod message;
mod outlet;
mod part;
mod parts;
mod reader;
mod rotation;
#[cfg(test)]
mod rotation_tests;
mod tap;
#[cfg(test)]
mod tests;
mod writer;

pub use self::{
    compress::Compression,
    outlet::{Note, Recorded},
    reader::{McapReplay, RecordedSpan, recorded_messages, recorded_notes, recorded_spans},
    rotation::{Rotation, RotationError},
    tap::{MessageTap, Recording, SourceTap},
    writer::{RESERVE_BYTES, Recorder, RecorderConfig},
};

//! Recordings: MCAP files of foxglove messages, which other programs open too.
//!
//! `camera/<name>` holds foxglove `CompressedImage` (JPEG images from the camera, or made of others by a
//! [`Compression`]) or `RawImage` (every other format, unchanged bytes), in protobuf, logged at capture time. A replay
//! returns exactly the frames in the file. Further data of a program (calibrations) precedes the first frame. A
//! [`Rotation`] divides a long recording into files that are each complete; files are synced every 2 s and ended before
//! the disk is full. Recordings of other programs are read too ([`foreign`]).

mod compress;
mod disk;
mod foreign;
mod message;
mod messages;
mod outlet;
mod part;
mod parts;
mod reader;
mod rotation;
#[cfg(test)]
mod rotation_tests;
mod schemas;
mod tap;
#[cfg(test)]
mod tests;
mod writer;

pub use self::{
    compress::Compression,
    foreign::{ForeignCamera, ForeignCameras, foreign_cameras},
    outlet::{Note, Recorded},
    reader::{FrameTimes, McapReplay, RecordedCamera, RecordedSpan, recorded_messages, recorded_notes, recorded_spans},
    rotation::{Rotation, RotationError},
    tap::{MessageTap, Recording, SourceTap},
    writer::{RESERVE_BYTES, Recorder, RecorderConfig},
};

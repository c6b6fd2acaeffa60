//! Stamp: template, person and frame of a message.

use alloc::vec::Vec;

use crate::{
    bytes::Fields,
    error::StreamError,
    message::{CODEC_VERSION, COLOR_MAGIC, MOTION_MAGIC},
};

/// Bytes before a stamp: magic letters and version.
const STAMP_AT: usize = 4;
/// Bytes of a stamp.
const STAMP_BYTES: usize = 28;

/// Template, person and frame of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stamp {
    /// Hash of the template.
    pub template: u64,
    /// Number of the person; it stays the same while the person is tracked.
    pub person: u32,
    /// Frame number of the rig.
    pub frame: u64,
    /// Capture time of the frame set, `CLOCK_MONOTONIC` of the capturing host.
    pub capture_nanos: i64,
}

impl Stamp {
    /// Returns the first bytes of a message.
    pub(crate) fn begin(&self, magic: [u8; 3]) -> Vec<u8> {
        let mut bytes = Vec::new();
        bytes.extend(magic);
        bytes.push(CODEC_VERSION);
        bytes.extend(self.template.to_le_bytes());
        bytes.extend(self.person.to_le_bytes());
        bytes.extend(self.frame.to_le_bytes());
        bytes.extend(self.capture_nanos.to_le_bytes());
        bytes
    }

    /// Reads the stamp off the front of a message.
    pub(crate) fn read(fields: &mut Fields<'_>) -> Result<Self, StreamError> {
        Ok(Self { template: fields.u64()?, person: fields.u32()?, frame: fields.u64()?, capture_nanos: fields.i64()? })
    }
}

/// Reads the stamp of a motion or of a message of colours.
///
/// # Errors
/// [`StreamError::Version`] or [`StreamError::Malformed`].
pub fn stamp_of(bytes: &[u8]) -> Result<Stamp, StreamError> {
    let magic = if bytes.starts_with(&COLOR_MAGIC) { COLOR_MAGIC } else { MOTION_MAGIC };
    Stamp::read(&mut Fields::new("message of the person stream", magic, bytes)?)
}

/// Changes the capture time of a motion or a message of colours, and the epoch of colours, to replay recordings. A decoder takes the
/// colours of another epoch as those of a new encoder.
///
/// # Errors
/// As [`stamp_of`]; the bytes are then unchanged.
pub fn restamp(bytes: &mut [u8], capture_nanos: i64, epochs_later: u32) -> Result<(), StreamError> {
    stamp_of(bytes)?;
    let end = STAMP_AT + STAMP_BYTES;
    if let Some(field) = bytes.get_mut(end - 8..end) {
        field.copy_from_slice(&capture_nanos.to_le_bytes());
    }
    if bytes.starts_with(&COLOR_MAGIC)
        && let Some(field) = bytes.get_mut(end..).and_then(<[u8]>::first_chunk_mut::<4>)
    {
        *field = u32::from_le_bytes(*field).wrapping_add(epochs_later).to_le_bytes();
    }
    Ok(())
}

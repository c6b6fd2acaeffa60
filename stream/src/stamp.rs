//! What a message of a frame belongs to.

use alloc::vec::Vec;

use crate::{CODEC_VERSION, StreamError, bytes::Fields};

/// The template, person and frame of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stamp {
    /// Hash of the template.
    pub template: u64,
    /// Number of the person; the same number is the same person as long as it is followed.
    pub person: u32,
    /// The rig's frame number.
    pub frame: u64,
    /// Capture time of the frame set, `CLOCK_MONOTONIC` of the capturing host.
    pub capture_nanos: i64,
}

impl Stamp {
    /// Begins a message.
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

    /// Reads it off the front of a message.
    pub(crate) fn read(fields: &mut Fields<'_>) -> Result<Self, StreamError> {
        Ok(Self { template: fields.u64()?, person: fields.u32()?, frame: fields.u64()?, capture_nanos: fields.i64()? })
    }
}

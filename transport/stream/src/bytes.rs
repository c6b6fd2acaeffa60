//! Little-endian fields of a message.

use crate::{error::StreamError, message::CODEC_VERSION};

/// Reader of fields off the front of a message.
pub(crate) struct Fields<'a> {
    /// Name of the message, for errors.
    pub what: &'static str,
    pub bytes: &'a [u8],
}

impl<'a> Fields<'a> {
    /// Reads the magic letters and the codec's version of a message; refuses others.
    pub fn new(what: &'static str, magic: [u8; 3], bytes: &'a [u8]) -> Result<Self, StreamError> {
        let mut fields = Self { what, bytes };
        if fields.take::<3>()? != magic {
            return Err(StreamError::Malformed { what, problem: "it does not begin with the message's three letters" });
        }
        match fields.take::<1>()? {
            [CODEC_VERSION] => Ok(fields),
            [found] => Err(StreamError::Version { what, found }),
        }
    }

    pub fn take<const N: usize>(&mut self) -> Result<[u8; N], StreamError> {
        let short = StreamError::Malformed { what: self.what, problem: "it is cut short" };
        let (field, rest) = self.bytes.split_first_chunk().ok_or(short)?;
        self.bytes = rest;
        Ok(*field)
    }

    pub fn u8(&mut self) -> Result<u8, StreamError> {
        self.take().map(u8::from_le_bytes)
    }

    pub fn u16(&mut self) -> Result<u16, StreamError> {
        self.take().map(u16::from_le_bytes)
    }

    pub fn u32(&mut self) -> Result<u32, StreamError> {
        self.take().map(u32::from_le_bytes)
    }

    pub fn u64(&mut self) -> Result<u64, StreamError> {
        self.take().map(u64::from_le_bytes)
    }

    pub fn i64(&mut self) -> Result<i64, StreamError> {
        self.take().map(i64::from_le_bytes)
    }

    /// Reads a finite number.
    pub fn f32(&mut self) -> Result<f32, StreamError> {
        let number = self.take().map(f32::from_le_bytes)?;
        self.check(number.is_finite(), "a number is not finite")?;
        Ok(number)
    }

    /// Refuses the message unless `holds`.
    pub fn check(&self, holds: bool, problem: &'static str) -> Result<(), StreamError> {
        if holds { Ok(()) } else { Err(StreamError::Malformed { what: self.what, problem }) }
    }
}

//! Header that every message carries as its zenoh attachment.

use crate::{
    error::TransportError,
    host::{monotonic_nanos, unix_nanos},
    schema::SCHEMA_VERSION,
};

/// Bytes of an encoded [`Header`].
pub const HEADER_BYTES: usize = 64;

/// Longest attachment that is read, bytes.
pub(crate) const MAX_ATTACHMENT: usize = 4 * HEADER_BYTES;

const MAGIC: [u8; 4] = *b"FLYR";

/// Kind of a message's payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MessageKind {
    /// foxglove `CompressedImage`.
    View,
    /// [`flyrig_stream::SplatState`].
    Splats,
    /// foxglove `CameraCalibration`.
    Calibration,
    /// foxglove `FrameTransforms`.
    Transforms,
    /// [`crate::RigStats`].
    Stats,
    /// Image of a camera, see [`crate::FrameHeader`].
    Frame,
    /// [`crate::CameraStatus`].
    CameraStatus,
    /// [`flyrig_stream::Motion`].
    Motion,
    /// Layer of a person's colours, for [`flyrig_stream::ColorDecoder`].
    Colors,
}

impl MessageKind {
    const ALL: [Self; 9] = [
        Self::View,
        Self::Splats,
        Self::Calibration,
        Self::Transforms,
        Self::Stats,
        Self::Frame,
        Self::CameraStatus,
        Self::Motion,
        Self::Colors,
    ];

    /// Returns whether the header holds the size of an image; otherwise it holds the monotonic time in its place.
    fn has_size(self) -> bool {
        matches!(self, Self::View | Self::Frame)
    }

    fn code(self) -> u8 {
        match self {
            Self::View => 1,
            Self::Splats => 2,
            Self::Calibration => 3,
            Self::Transforms => 4,
            Self::Stats => 5,
            Self::Frame => 6,
            Self::CameraStatus => 7,
            Self::Motion => 8,
            Self::Colors => 9,
        }
    }
}

/// Message header with a fixed little-endian layout of 64 bytes: magic `FLYR`, version u16, kind u8, 0, then the fields in
/// this order, where `publish_nanos` takes the place of width and height in messages without an image.
///
/// ```
/// use flyrig_transport::{Header, MessageKind};
///
/// let header = Header {
///     kind: MessageKind::Stats,
///     sequence: 7,
///     frame: 120,
///     capture_nanos: 4_000_000_000,
///     publish_unix_nanos: 1_700_000_000_000_000_000,
///     host: 1,
///     publisher: 2,
///     width: 0,
///     height: 0,
///     publish_nanos: 3_000_000_000,
/// };
/// assert_eq!(Header::decode("stats", &header.encode())?, header);
/// # Ok::<(), flyrig_transport::TransportError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// Kind of the payload.
    pub kind: MessageKind,
    /// Sequence number within the topic, from 0; a gap is a message that was lost, or replaced by a newer one.
    pub sequence: u64,
    /// Frame number of the rig.
    pub frame: u64,
    /// Capture time, `CLOCK_MONOTONIC` of the capturing host.
    pub capture_nanos: i64,
    /// Time at which the message was handed to the publisher, by its wall clock, nanoseconds since 1970. That clock may be set at any
    /// time: for display only.
    pub publish_unix_nanos: i64,
    /// Identity of the host since its boot: only within one host is the latency exact. 0 when unknown.
    pub host: u64,
    /// Identity of the publisher since its start.
    pub publisher: u64,
    /// Width of an image, pixels; otherwise 0.
    pub width: u32,
    /// Height of an image, pixels; otherwise 0.
    pub height: u32,
    /// The time of `publish_unix_nanos` by `CLOCK_MONOTONIC` of that host; 0 for images, and from older programs.
    pub publish_nanos: i64,
}

impl Header {
    /// Encodes the header.
    #[must_use]
    pub fn encode(&self) -> [u8; HEADER_BYTES] {
        let mut bytes = [0; HEADER_BYTES];
        bytes[..4].copy_from_slice(&MAGIC);
        bytes[4..6].copy_from_slice(&SCHEMA_VERSION.to_le_bytes());
        bytes[6] = self.kind.code();
        let words = [
            self.sequence.to_le_bytes(),
            self.frame.to_le_bytes(),
            self.capture_nanos.to_le_bytes(),
            self.publish_unix_nanos.to_le_bytes(),
            self.host.to_le_bytes(),
            self.publisher.to_le_bytes(),
        ];
        for (at, word) in bytes[8..56].chunks_exact_mut(8).zip(words) {
            at.copy_from_slice(&word);
        }
        if self.kind.has_size() {
            bytes[56..60].copy_from_slice(&self.width.to_le_bytes());
            bytes[60..].copy_from_slice(&self.height.to_le_bytes());
        } else {
            bytes[56..].copy_from_slice(&self.publish_nanos.to_le_bytes());
        }
        bytes
    }

    /// Decodes a header; errors name `topic`.
    ///
    /// # Errors
    /// `UnknownVersion` for another schema version, otherwise `Malformed`.
    pub fn decode(topic: &str, bytes: &[u8]) -> Result<Self, TransportError> {
        let malformed = |message: String| TransportError::malformed(topic, message);
        let mut reader = Reader(bytes);
        if reader.take::<4>() != Some(MAGIC) {
            return Err(malformed("the message has no flyrig header; something else publishes on this key".to_owned()));
        }
        // The version is checked first: the rest may have another layout.
        let version = reader.take().map(u16::from_le_bytes);
        if version.is_some_and(|version| version != SCHEMA_VERSION) {
            return Err(TransportError::version(topic, version.unwrap_or_default()));
        }
        if bytes.len() != HEADER_BYTES {
            return Err(malformed(format!("header of {} bytes, expected {HEADER_BYTES}", bytes.len())));
        }
        let short = || malformed("the header is cut short".to_owned());
        let [code, _reserved] = reader.take::<2>().ok_or_else(short)?;
        let kind = MessageKind::ALL.into_iter().find(|kind| kind.code() == code);
        let kind = kind.ok_or_else(|| malformed(format!("message kind {code} is not known")))?;
        let mut word = || reader.take::<8>().ok_or_else(short);
        let header = Self {
            kind,
            sequence: u64::from_le_bytes(word()?),
            frame: u64::from_le_bytes(word()?),
            capture_nanos: i64::from_le_bytes(word()?),
            publish_unix_nanos: i64::from_le_bytes(word()?),
            host: u64::from_le_bytes(word()?),
            publisher: u64::from_le_bytes(word()?),
            width: 0,
            height: 0,
            publish_nanos: 0,
        };
        let last = word()?;
        Ok(if kind.has_size() {
            let [w0, w1, w2, w3, h0, h1, h2, h3] = last;
            let (width, height) = (u32::from_le_bytes([w0, w1, w2, w3]), u32::from_le_bytes([h0, h1, h2, h3]));
            Self { width, height, ..header }
        } else {
            Self { publish_nanos: i64::from_le_bytes(last), ..header }
        })
    }
}

/// Returns a header for [`crate::topic::Topic::offer`] to fill in.
pub(crate) fn empty_header() -> Header {
    Header {
        kind: MessageKind::Stats,
        sequence: 0,
        frame: 0,
        capture_nanos: 0,
        publish_unix_nanos: unix_nanos(),
        host: 0,
        publisher: 0,
        width: 0,
        height: 0,
        publish_nanos: monotonic_nanos(),
    }
}

/// Reader of fixed-size pieces off the front of a byte slice.
pub(crate) struct Reader<'a>(pub &'a [u8]);

impl Reader<'_> {
    pub(crate) fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (piece, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*piece)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{error::TransportErrorKind, host::host_id};

    fn header() -> Header {
        Header {
            kind: MessageKind::View,
            sequence: u64::MAX,
            frame: 7,
            capture_nanos: -5,
            publish_unix_nanos: 1 << 60,
            host: host_id(),
            publisher: 3,
            width: 640,
            height: u32::MAX,
            publish_nanos: 0,
        }
    }

    #[test]
    fn a_header_survives_the_wire() {
        let timed = Header { kind: MessageKind::Motion, width: 0, height: 0, publish_nanos: i64::MIN + 7, ..header() };
        for sent in [header(), timed] {
            assert_eq!(Header::decode("x", &sent.encode()).unwrap(), sent);
        }
    }

    #[test]
    fn another_version_is_named_whatever_its_length() {
        let mut bytes = header().encode().to_vec();
        bytes[4] = 9;
        for end in [6, 20, HEADER_BYTES] {
            let error = Header::decode("flyrig/v1/a/splats", &bytes[..end]).unwrap_err();
            assert_eq!(error.kind, TransportErrorKind::UnknownVersion);
            assert!(error.to_string().contains("schema version 9, this program knows version 1"), "{error}");
        }
    }

    #[test]
    fn cut_long_and_foreign_headers_are_refused() {
        let good = header().encode();
        for end in 0..HEADER_BYTES {
            assert_eq!(Header::decode("x", &good[..end]).unwrap_err().kind, TransportErrorKind::Malformed);
        }
        assert!(Header::decode("x", &[good.as_slice(), &[0]].concat()).is_err());
        let mut kind = good;
        kind[6] = 200;
        assert!(Header::decode("x", &kind).unwrap_err().message.contains("kind 200"));
    }
}

//! Image of a camera on the wire: its bytes as the payload, their description as the attachment.

use flyrig_types::{CameraId, Frame, Image, PixelFormat};
use serde::{Deserialize, Serialize};

use crate::{
    error::TransportError,
    header::{HEADER_BYTES, Header, MessageKind, Reader},
    json::{from_json, to_json},
    printable::clean,
};

/// Largest image of a camera, bytes: 16 million pixels of three.
pub const MAX_FRAME_BYTES: usize = 48 << 20;

/// Bytes of an encoded [`FrameHeader`].
pub const FRAME_HEADER_BYTES: usize = HEADER_BYTES + TAIL_BYTES;
const TAIL_BYTES: usize = 24;
/// Code of an unknown exposure.
const UNKNOWN: u64 = u64::MAX;

/// Codes of pixel formats on the wire; never reuse one.
const FORMATS: [(u8, PixelFormat); 12] = [
    (1, PixelFormat::Rgb8),
    (2, PixelFormat::Bgr8),
    (3, PixelFormat::Rgba8),
    (4, PixelFormat::Gray8),
    (5, PixelFormat::Yuyv),
    (6, PixelFormat::Uyvy),
    (7, PixelFormat::Nv12),
    (8, PixelFormat::BayerRggb8),
    (9, PixelFormat::BayerGrbg8),
    (10, PixelFormat::BayerGbrg8),
    (11, PixelFormat::BayerBggr8),
    (12, PixelFormat::Mjpeg),
];

/// Attachment of a camera's image: a [`Header`] (`frame` is the camera's own sequence number, `capture_nanos` the middle of the exposure by
/// the clock of the camera's computer), then 24 bytes, little-endian: exposure u64 (nanoseconds, all ones when unknown), number of messages
/// of this topic that were not sent u64, pixel format u8, seven zeros.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameHeader {
    /// Header as in every message.
    pub header: Header,
    /// Exposure time, nanoseconds; `None` where the camera's source does not report it.
    pub exposure_nanos: Option<u64>,
    /// Number of earlier messages that were not sent: replaced, unwatched or failed.
    pub withheld: u64,
    /// Pixel format of the bytes.
    pub format: PixelFormat,
}

impl FrameHeader {
    /// Encodes the attachment.
    #[must_use]
    pub fn encode(&self) -> [u8; FRAME_HEADER_BYTES] {
        let mut bytes = [0; FRAME_HEADER_BYTES];
        bytes[..HEADER_BYTES].copy_from_slice(&self.header.encode());
        let code = FORMATS.iter().find(|(_, format)| *format == self.format).map_or(0, |(code, _)| *code);
        let tail = &mut bytes[HEADER_BYTES..];
        tail[..8].copy_from_slice(&self.exposure_nanos.unwrap_or(UNKNOWN).to_le_bytes());
        tail[8..16].copy_from_slice(&self.withheld.to_le_bytes());
        tail[16] = code;
        bytes
    }

    /// Decodes an attachment; errors name `topic`.
    ///
    /// # Errors
    /// `UnknownVersion` or `Malformed`.
    pub fn decode(topic: &str, bytes: &[u8]) -> Result<Self, TransportError> {
        let (head, tail) = bytes.split_at(bytes.len().min(HEADER_BYTES));
        let header = Header::decode(topic, head)?;
        let malformed = |text: String| TransportError::malformed(topic, text);
        if header.kind != MessageKind::Frame {
            return Err(malformed(format!("holds {:?}, expected a camera's image", header.kind)));
        }
        let mut reader = Reader(tail);
        let parts = (tail.len() == TAIL_BYTES)
            .then(|| Some((reader.take::<8>()?, reader.take::<8>()?, reader.take::<1>()?)))
            .flatten();
        let Some((exposure, withheld, [code])) = parts else {
            return Err(malformed(format!("attachment of {} bytes, expected {FRAME_HEADER_BYTES}", bytes.len())));
        };
        let format = FORMATS.iter().find(|(known, _)| *known == code);
        let (_, format) = format.ok_or_else(|| malformed(format!("pixel format {code} is not known")))?;
        let exposure = u64::from_le_bytes(exposure);
        Ok(Self {
            header,
            exposure_nanos: (exposure != UNKNOWN).then_some(exposure),
            withheld: u64::from_le_bytes(withheld),
            format: *format,
        })
    }

    /// Returns the frame; its capture time is still by the clock of the camera's computer.
    ///
    /// # Errors
    /// `Malformed` when the bytes do not fit format and size.
    pub fn frame(&self, topic: &str, camera: &CameraId, bytes: Vec<u8>) -> Result<Frame, TransportError> {
        let Header { width, height, frame, capture_nanos, .. } = self.header;
        if bytes.is_empty() || bytes.len() > MAX_FRAME_BYTES {
            let text = format!("image of {} bytes, expected 1 to {MAX_FRAME_BYTES}", bytes.len());
            return Err(TransportError::malformed(topic, text));
        }
        let image = Image::new(width, height, self.format, bytes)
            .map_err(|error| TransportError::malformed(topic, error.to_string()))?;
        Ok(Frame {
            camera: camera.clone(),
            sequence: frame,
            capture_nanos,
            exposure_nanos: self.exposure_nanos,
            image,
            mask: None,
        })
    }
}

/// Status of a camera as its computer reports it once per second; counts since the program there started.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CameraStatus {
    /// Name of the camera's computer.
    pub host: String,
    /// Format, size and rate in use.
    pub mode: String,
    /// Present fault; empty when frames flow.
    pub problem: String,
    /// Frames read.
    pub frames: u64,
    /// Errors of every kind.
    pub errors: u64,
    /// Frames that the driver numbered and never delivered.
    pub lost_by_driver: u64,
    /// Number of times that the camera came back.
    pub reconnects: u64,
    /// Number of times that it stopped without an error.
    pub silences: u64,
    /// Implausible timestamps that were replaced.
    pub stamps_replaced: u64,
    /// Frames replaced before they were sent, in that program and its outlet.
    pub overtaken: u64,
}

impl CameraStatus {
    /// Encodes the status as JSON.
    ///
    /// # Errors
    /// `Config` when the JSON is too long.
    pub fn encode(&self) -> Result<Vec<u8>, TransportError> {
        to_json("camera status", self)
    }

    /// Decodes a status from JSON; the texts are made [`crate::printable()`].
    ///
    /// # Errors
    /// `UnknownVersion` or `Malformed`.
    pub fn decode(bytes: &[u8]) -> Result<Self, TransportError> {
        let mut status: Self = from_json("camera status", bytes)?;
        for text in [&mut status.host, &mut status.mode, &mut status.problem] {
            clean(text);
        }
        Ok(status)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{error::TransportErrorKind, header::empty_header};

    fn header(format: PixelFormat) -> FrameHeader {
        let header = Header {
            kind: MessageKind::Frame,
            sequence: 9,
            frame: 12,
            capture_nanos: -5,
            width: 4,
            height: 2,
            publish_nanos: 0,
            ..empty_header()
        };
        FrameHeader { header, exposure_nanos: Some(8_000_000), withheld: 3, format }
    }

    #[test]
    fn every_format_survives_the_wire() {
        for (_, format) in FORMATS {
            for exposure_nanos in [None, Some(0), Some(77)] {
                let sent = FrameHeader { exposure_nanos, ..header(format) };
                assert_eq!(FrameHeader::decode("x", &sent.encode()).unwrap(), sent);
            }
            let bytes = vec![7; format.byte_len(4, 2).unwrap_or(5)];
            let frame = header(format).frame("x", &"left".into(), bytes).unwrap();
            assert_eq!((frame.sequence, frame.capture_nanos, frame.exposure_nanos), (12, -5, Some(8_000_000)));
            assert_eq!((frame.image.format(), frame.image.width(), frame.image.height()), (format, 4, 2));
        }
    }

    #[test]
    fn what_does_not_fit_is_refused_in_words() {
        let good = header(PixelFormat::Yuyv);
        for end in 0..FRAME_HEADER_BYTES {
            assert_eq!(
                FrameHeader::decode("x", &good.encode()[..end]).unwrap_err().kind,
                TransportErrorKind::Malformed
            );
        }
        let mut code = good.encode();
        code[HEADER_BYTES + 16] = 99;
        let refused = |bytes: &[u8]| FrameHeader::decode("x", bytes).unwrap_err().to_string();
        assert!(refused(&code).contains("pixel format 99 is not known"));
        assert!(refused(&[good.encode().as_slice(), &[0]].concat()).contains("attachment of 89 bytes, expected 88"));
        let mut kind = good;
        kind.header.kind = MessageKind::View;
        assert!(refused(&kind.encode()).contains("holds View"));
        let mut version = good.encode();
        version[4] = 7;
        assert_eq!(FrameHeader::decode("x", &version).unwrap_err().kind, TransportErrorKind::UnknownVersion);
        for (bytes, text) in [(0, "image of 0 bytes"), (15, "needs 16 bytes but has 15"), (17, "has 17")] {
            let error = good.frame("x", &"left".into(), vec![0; bytes]).unwrap_err();
            assert!(error.to_string().contains(text), "{error}");
        }
        let mut absurd = good;
        (absurd.header.width, absurd.header.height) = (u32::MAX, u32::MAX);
        assert!(absurd.frame("x", &"left".into(), vec![0; 16]).is_err());
    }

    #[test]
    fn a_status_comes_back_without_what_harms_terminals() {
        let (host, mode) = ("pi\x1b[2J".into(), "\u{202e}GPJM\n".into());
        let status = CameraStatus { host, mode, problem: "x".repeat(5000), frames: 3, ..Default::default() };
        let found = CameraStatus::decode(&status.encode().unwrap()).unwrap();
        assert_eq!((found.host.as_str(), found.problem.len(), found.frames), ("pi\\u{1b}[2J", 500, 3));
        assert_eq!(found.mode, "\\u{202e}GPJM\\n");
        assert!(CameraStatus::decode(b"{\"schema_version\":1}").is_err());
    }
}

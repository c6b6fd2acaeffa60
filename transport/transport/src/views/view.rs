//! Images of views on the wire: foxglove `CompressedImage`.

use foxglove::{
    Decode, Encode,
    messages::{CompressedImage, Timestamp},
};
use prost::bytes::Bytes;

use crate::{error::TransportError, header::Header};

/// Largest compressed image, bytes.
pub const MAX_IMAGE_BYTES: usize = 32 << 20;

/// Largest message of a view, bytes: the image and the few fields around it.
pub(crate) const MAX_MESSAGE_BYTES: usize = MAX_IMAGE_BYTES + (4 << 10);

/// Compression of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageFormat {
    /// JPEG.
    Jpeg,
    /// PNG.
    Png,
}

impl ImageFormat {
    /// Returns foxglove's name of the format.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Jpeg => "jpeg",
            Self::Png => "png",
        }
    }

    fn from_name(name: &str) -> Option<Self> {
        [Self::Jpeg, Self::Png].into_iter().find(|format| format.name() == name)
    }
}

/// Compressed image of a view; the caller compresses and decompresses.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewFrame {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Compression of `bytes`.
    pub format: ImageFormat,
    /// Compressed image; `Bytes::from(vec)` takes a `Vec<u8>` without copying.
    pub bytes: Bytes,
    /// Frame number of the rig.
    pub frame: u64,
    /// Capture time of the frame set that it shows, `CLOCK_MONOTONIC` of the capturing host.
    pub capture_nanos: i64,
}

/// Converts a time to foxglove's, clamped to its range of 0 to 2^32 s.
pub(crate) fn timestamp(nanos: i64) -> Timestamp {
    let nanos = nanos.max(0);
    let seconds = u32::try_from(nanos / 1_000_000_000).unwrap_or(u32::MAX);
    Timestamp::new(seconds, (nanos % 1_000_000_000) as u32)
}

/// Encodes a foxglove message.
pub(crate) fn to_bytes<M: Encode>(topic: &str, message: &M) -> Result<Vec<u8>, TransportError> {
    let mut bytes = Vec::with_capacity(message.encoded_len().unwrap_or(0));
    message.encode(&mut bytes).map_err(|error| TransportError::malformed(topic, error.to_string()))?;
    Ok(bytes)
}

impl ViewFrame {
    /// Checks an image that a publisher hands in.
    pub(crate) fn validate(&self, view: &str) -> Result<(), TransportError> {
        let side = 1..=flyrig_types::MAX_IMAGE_SIDE;
        if !side.contains(&self.width) || !side.contains(&self.height) {
            let (width, height) = (self.width, self.height);
            return Err(TransportError::config(
                format!("view {view}"),
                format!("is {width}x{height} pixels; sides are 1 to 16384"),
            ));
        }
        check_len(view, self.bytes.len())
    }

    /// Encodes the image as foxglove `CompressedImage`; size and frame number travel in the [`Header`].
    ///
    /// # Errors
    /// `Malformed` when it cannot be encoded as protobuf.
    pub fn encode(&self, view: &str) -> Result<Vec<u8>, TransportError> {
        let image = CompressedImage {
            timestamp: Some(timestamp(self.capture_nanos)),
            frame_id: view.to_owned(),
            data: self.bytes.clone(),
            format: self.format.name().to_owned(),
        };
        to_bytes(view, &image)
    }

    /// Decodes an image; size, frame and time come from the header of its message.
    ///
    /// # Errors
    /// `Malformed` for another message, format, size or length.
    pub fn decode(view: &str, header: &Header, payload: Bytes) -> Result<Self, TransportError> {
        if payload.len() > MAX_MESSAGE_BYTES {
            return Err(TransportError::malformed(view, format!("{} bytes are too many for an image", payload.len())));
        }
        let image = CompressedImage::decode(payload)
            .map_err(|error| TransportError::malformed(view, format!("not a CompressedImage: {error}")))?;
        let format = ImageFormat::from_name(&image.format).ok_or_else(|| {
            TransportError::malformed(view, format!("format {:?}, expected jpeg or png", image.format))
        })?;
        let frame = Self {
            width: header.width,
            height: header.height,
            format,
            bytes: image.data,
            frame: header.frame,
            capture_nanos: header.capture_nanos,
        };
        frame.validate(view).map_err(|error| TransportError::malformed(error.topic, error.message))?;
        Ok(frame)
    }
}

fn check_len(view: &str, len: usize) -> Result<(), TransportError> {
    if (1..=MAX_IMAGE_BYTES).contains(&len) {
        return Ok(());
    }
    Err(TransportError::config(
        format!("view {view}"),
        format!("image of {len} bytes; it must hold 1 to {MAX_IMAGE_BYTES} bytes"),
    ))
}

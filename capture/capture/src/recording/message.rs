//! Conversion of frames to foxglove messages and back.

use std::collections::BTreeMap;

use flyrig_types::{CameraId, Frame, Image, PixelFormat};
use foxglove::{
    Decode as _, Encode,
    messages::{CompressedImage, RawImage, Timestamp},
};
use prost::bytes::Bytes;

use crate::error::{CaptureError, CaptureErrorKind};
use crate::mjpeg;

/// Prefix of the topics of images.
pub(super) const TOPIC: &str = "camera/";
const EXPOSURE: &str = "exposure_nanos";

/// Properties of a camera's messages that stay the same from frame to frame.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Channel {
    pub topic: String,
    pub schema: (String, String, Vec<u8>),
    pub metadata: BTreeMap<String, String>,
}

/// Names of the pixel formats in foxglove.
const ENCODINGS: [(PixelFormat, &str); 11] = [
    (PixelFormat::Rgb8, "rgb8"),
    (PixelFormat::Bgr8, "bgr8"),
    (PixelFormat::Rgba8, "rgba8"),
    (PixelFormat::Gray8, "mono8"),
    (PixelFormat::Yuyv, "yuyv"),
    (PixelFormat::Uyvy, "uyvy"),
    (PixelFormat::Nv12, "nv12"),
    (PixelFormat::BayerRggb8, "bayer_rggb8"),
    (PixelFormat::BayerGrbg8, "bayer_grbg8"),
    (PixelFormat::BayerGbrg8, "bayer_gbrg8"),
    (PixelFormat::BayerBggr8, "bayer_bggr8"),
];

fn schema<M: Encode>() -> (String, String, Vec<u8>) {
    M::get_schema().map(|schema| (schema.name, schema.encoding, schema.data.into_owned())).unwrap_or_default()
}

impl Channel {
    /// Returns the channel for frames with the format of `frame`.
    pub fn of(frame: &Frame) -> Self {
        let exposure = frame.exposure_nanos.map(|nanos| (EXPOSURE.to_owned(), nanos.to_string()));
        Self {
            topic: format!("{TOPIC}{}", frame.camera),
            schema: match frame.image.format() {
                PixelFormat::Mjpeg => schema::<CompressedImage>(),
                _ => schema::<RawImage>(),
            },
            metadata: exposure.into_iter().collect(),
        }
    }
}

/// Encodes the payload of a frame.
///
/// # Errors
/// `Corrupt` when protobuf rejects it.
pub(super) fn encode(frame: &Frame) -> Result<Vec<u8>, CaptureError> {
    let (image, nanos) = (&frame.image, frame.capture_nanos.max(0));
    let seconds = u32::try_from(nanos / 1_000_000_000).unwrap_or(u32::MAX);
    let timestamp = Some(Timestamp::new(seconds, (nanos % 1_000_000_000) as u32));
    let (frame_id, data) = (frame.camera.to_string(), Bytes::copy_from_slice(image.bytes()));
    let mut bytes = Vec::with_capacity(image.bytes().len() + 128);
    let encoding = ENCODINGS.iter().find(|(format, _)| *format == image.format()).map(|(_, word)| (*word).to_owned());
    let encoded = match encoding {
        None => CompressedImage { timestamp, frame_id, data, format: "jpeg".to_owned() }.encode(&mut bytes),
        Some(encoding) => {
            let row = match image.format() {
                PixelFormat::Nv12 => image.width() as usize,
                format => format.byte_len(image.width(), 1).unwrap_or(0),
            };
            let (width, height, step) = (image.width(), image.height(), row as u32);
            RawImage { timestamp, frame_id, width, height, encoding, step, data }.encode(&mut bytes)
        }
    };
    encoded.map_err(|error| CaptureError::new(&frame.camera, CaptureErrorKind::Corrupt, error.to_string()))?;
    Ok(bytes)
}

/// Returns the exposure in a channel's metadata, nanoseconds.
pub(super) fn exposure_nanos(metadata: &BTreeMap<String, String>) -> Option<u64> {
    metadata.get(EXPOSURE)?.parse().ok()
}

/// Decodes the image of a message.
///
/// # Errors
/// `Corrupt` for an invalid image, `Unsupported` for other kinds of messages and encodings.
pub(super) fn decode(camera: &CameraId, schema: &str, payload: Vec<u8>) -> Result<Image, CaptureError> {
    let corrupt = |text: String| CaptureError::new(camera, CaptureErrorKind::Corrupt, text);
    let payload = Bytes::from(payload);
    match schema {
        "foxglove.CompressedImage" => {
            let image = CompressedImage::decode(payload).map_err(|error| corrupt(error.to_string()))?;
            let Some((width, height)) = mjpeg::jpeg_size(&image.data) else {
                return Err(corrupt(format!("an image of format {:?} that is no JPEG", image.format)));
            };
            let (width, height) = (width as u32, height as u32);
            Image::new(width, height, PixelFormat::Mjpeg, Vec::from(image.data))
                .map_err(|error| corrupt(error.to_string()))
        }
        "foxglove.RawImage" => {
            let image = RawImage::decode(payload).map_err(|error| corrupt(error.to_string()))?;
            let Some((format, _)) = ENCODINGS.iter().find(|(_, word)| *word == image.encoding) else {
                let text = format!("encoding {:?} cannot be read", image.encoding);
                return Err(CaptureError::new(camera, CaptureErrorKind::Unsupported, text));
            };
            Image::new(image.width, image.height, *format, Vec::from(image.data))
                .map_err(|error| corrupt(error.to_string()))
        }
        other => {
            let text = format!("its messages are {other:?}; expected foxglove.CompressedImage or foxglove.RawImage");
            Err(CaptureError::new(camera, CaptureErrorKind::Unsupported, text))
        }
    }
}

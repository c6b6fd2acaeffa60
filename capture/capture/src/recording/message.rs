//! Conversion of frames to foxglove messages and back.

use std::collections::BTreeMap;

use flyrig_types::{CameraId, Frame, Image, PixelFormat, shortened};
use foxglove::{
    Encode,
    messages::{CompressedImage, RawImage, Timestamp},
};
use prost::bytes::Bytes;

use super::schemas::{ImageMessage, Pixels, Schema};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::image_file;
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

/// Other names that other programs use.
const FOREIGN_ENCODINGS: [(PixelFormat, &str); 7] = [
    (PixelFormat::Rgba8, "bgra8"),
    (PixelFormat::Bgr8, "8UC3"),
    (PixelFormat::Gray8, "8UC1"),
    (PixelFormat::Uyvy, "yuv422"),
    (PixelFormat::Yuyv, "yuv422_yuy2"),
    (PixelFormat::Gray8, "mono"),
    (PixelFormat::Gray8, "gray8"),
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
pub(super) fn decode(
    camera: &CameraId,
    channel: &mcap::Channel<'_>,
    payload: Vec<u8>,
) -> Result<(ImageTime, Image), CaptureError> {
    let unsupported = |text: String| CaptureError::new(camera, CaptureErrorKind::Unsupported, text);
    let schema = match Schema::of(channel) {
        Some(schema) => schema.map_err(unsupported)?,
        None => return Err(not_an_image(camera, channel)),
    };
    if !schema.is_image() {
        return Err(not_an_image(camera, channel));
    }
    let message = schema.image(payload).map_err(|text| CaptureError::new(camera, CaptureErrorKind::Corrupt, text))?;
    Ok((ImageTime(message.stamp_nanos), to_image(camera, message)?))
}

/// Time in an image's message, nanoseconds.
pub(super) struct ImageTime(pub i64);

fn not_an_image(camera: &CameraId, channel: &mcap::Channel<'_>) -> CaptureError {
    let name = channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
    let text =
        format!("its messages are {:?}; expected foxglove.CompressedImage or foxglove.RawImage", shortened(name));
    CaptureError::new(camera, CaptureErrorKind::Unsupported, text)
}

/// Decodes an image: JPEG stays as it is, PNG becomes RGB, and raw images lose the padding of their rows.
///
/// # Errors
/// `Corrupt` for an invalid image, `Unsupported` for other encodings.
pub(super) fn to_image(camera: &CameraId, message: ImageMessage) -> Result<Image, CaptureError> {
    let corrupt = |text: String| CaptureError::new(camera, CaptureErrorKind::Corrupt, text);
    let unsupported = |text: String| CaptureError::new(camera, CaptureErrorKind::Unsupported, text);
    match message.pixels {
        Pixels::Compressed { data, .. } if data.starts_with(b"\x89PNG") => {
            let rgb = image_file::decode(&data).map_err(|error| error.of(camera))?.into_rgb8();
            let (width, height) = rgb.dimensions();
            Image::new(width, height, PixelFormat::Rgb8, rgb.into_raw()).map_err(|error| corrupt(error.to_string()))
        }
        Pixels::Compressed { format, data } => {
            let Some((width, height)) = mjpeg::jpeg_size(&data) else {
                let text = format!("an image of format {:?} that is neither JPEG nor PNG", shortened(&format));
                return Err(corrupt(text));
            };
            let (width, height) = (width as u32, height as u32);
            Image::new(width, height, PixelFormat::Mjpeg, Vec::from(data)).map_err(|error| corrupt(error.to_string()))
        }
        Pixels::Raw { width, height, encoding, step, data } => {
            let is_bgra = encoding == "bgra8";
            let known = ENCODINGS.iter().chain(&FOREIGN_ENCODINGS).find(|(_, word)| *word == encoding);
            let Some((format, _)) = known else {
                return Err(unsupported(format!("encoding {:?} cannot be read", shortened(&encoding))));
            };
            let mut bytes = without_padding(*format, [width, height, step], data.into());
            if is_bgra {
                bytes.chunks_exact_mut(4).for_each(|pixel| pixel.swap(0, 2));
            }
            Image::new(width, height, *format, bytes).map_err(|error| corrupt(error.to_string()))
        }
    }
}

/// Removes the padding at the end of each row of `step` bytes; returns other bytes unchanged.
fn without_padding(format: PixelFormat, [width, height, step]: [u32; 3], bytes: Vec<u8>) -> Vec<u8> {
    let (row, rows) = match format {
        PixelFormat::Nv12 => (width as usize, height as usize + (height as usize).div_ceil(2)),
        format => (format.byte_len(width, 1).unwrap_or(0), height as usize),
    };
    let step = step as usize;
    // The last row may come without its padding.
    if step <= row || row == 0 || bytes.len() < step.saturating_mul(rows.saturating_sub(1)).saturating_add(row) {
        return bytes;
    }
    bytes.chunks(step).take(rows).flat_map(|line| &line[..row.min(line.len())]).copied().collect()
}

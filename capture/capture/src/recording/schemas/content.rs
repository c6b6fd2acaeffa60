//! Content of messages, whatever their encoding.

use flyrig_types::Isometry;
use prost::bytes::Bytes;

/// Image of a camera.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ImageMessage {
    /// Time of the image, nanoseconds; 0 if unknown.
    pub stamp_nanos: i64,
    /// Coordinate frame of the camera.
    pub frame_id: String,
    pub pixels: Pixels,
}

/// Encoded image.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Pixels {
    Compressed { format: String, data: Bytes },
    Raw { width: u32, height: u32, encoding: String, step: u32, data: Bytes },
}

/// Intrinsic calibration of a camera: ROS `CameraInfo` or foxglove `CameraCalibration`, which have the same meaning.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct LensMessage {
    pub frame_id: String,
    pub width: u32,
    pub height: u32,
    pub model: String,
    pub d: Vec<f64>,
    /// Rows of K (3x3), R (3x3) and P (3x4).
    pub k: Vec<f64>,
    pub r: Vec<f64>,
    pub p: Vec<f64>,
    /// Pixels of the sensor per pixel of the image, in x and y; 0 is 1.
    pub binning: [u32; 2],
    /// Region of the sensor: x, y, height, width; zeros for all of it.
    pub region: [u32; 4],
}

/// Transform between two coordinate frames.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Link {
    pub parent: String,
    pub child: String,
    pub parent_from_child: Isometry,
}

/// Origin of a schema, which decides the order of its fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Family {
    Foxglove,
    Ros,
}

/// Meaning of a schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    CompressedImage,
    RawImage,
    Lens,
    Link,
    Links,
    /// Video that is compressed over time.
    Video,
}

//! Options of a physical camera, independent of the capture API.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Identity of a camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CameraIdentity {
    /// Serial number of the USB device.
    Serial(String),
    /// Name of a link in `/dev/v4l/by-path`: identifies the socket the camera is plugged into.
    Path(String),
    /// V4L2 bus information, such as `usb-0000:00:14.0-3` or `platform:vivid-000`: identifies the socket and works
    /// without udev.
    Bus(String),
}

impl fmt::Display for CameraIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Serial(serial) => write!(f, "serial \"{serial}\""),
            Self::Path(path) => write!(f, "path \"{path}\""),
            Self::Bus(bus) => write!(f, "bus \"{bus}\""),
        }
    }
}

/// Requested pixel format.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FormatChoice {
    /// First available of YUYV, UYVY, NV12, RGB24, MJPEG, Bayer and grey; MJPEG first where uncompressed images would
    /// exceed the bandwidth of the bus.
    #[default]
    Auto,
    /// 4:2:2, `YUYV`.
    Yuyv,
    /// 4:2:2, `UYVY`.
    Uyvy,
    /// 4:2:0 in one memory plane (`NV12`) or two (`NM12`).
    Nv12,
    /// One JPEG image per frame, `MJPG` or `JPEG`.
    Mjpeg,
    /// 8 bits of luminance, `GREY`.
    Grey,
    /// 8-bit Bayer mosaic in any phase: `RGGB`, `GRBG`, `GBRG` or `BA81`.
    Bayer8,
    /// 3 bytes per pixel, `RGB3` or `BGR3`.
    Rgb24,
}

/// Manual controls of a camera; `None` leaves a control unchanged. Setting a value disables the camera's automatic
/// control of it.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CameraControls {
    /// Seconds, in steps of 0.1 ms.
    pub exposure_secs: Option<f64>,
    /// Camera-specific unit.
    pub gain: Option<i32>,
    /// Kelvin.
    pub white_balance_kelvin: Option<i32>,
    /// Camera-specific unit; 0 is usually infinity.
    pub focus: Option<i32>,
}

/// Options with which a V4L2 camera is opened.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraOptions {
    /// Device to open.
    pub identity: CameraIdentity,
    /// Pixels. Other sizes are rejected, since the calibration holds for this one.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Frames per second.
    pub fps: f64,
    /// Pixel format.
    pub format: FormatChoice,
    /// Manual controls; applied again after every reconnect.
    pub controls: CameraControls,
    /// Time between the exposures of the first and the last row, seconds; 0 for a global shutter or when unknown.
    pub readout_secs: f64,
    /// Latency of this camera's timestamps, seconds; subtracted from them.
    pub lag_secs: f64,
    /// Buffers queued in the driver; with too few, frames are lost whenever this process is late.
    pub buffers: u32,
}

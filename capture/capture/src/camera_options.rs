//! What a real camera is asked for, whichever system it is connected to.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Identity of a camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CameraIdentity {
    /// Serial number of the USB device.
    Serial(String),
    /// Name of a link in `/dev/v4l/by-path`: the socket that it is plugged into.
    Path(String),
    /// V4L2's bus information, like `usb-0000:00:14.0-3` or `platform:vivid-000`: the socket too, and known without udev.
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

/// What a camera is asked to send.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FormatChoice {
    /// The first that the camera has of YUYV, UYVY, NV12, RGB24, MJPEG, Bayer and grey; MJPEG first where uncompressed
    /// images would not fit the bus.
    #[default]
    Auto,
    /// 4:2:2, `YUYV`.
    Yuyv,
    /// 4:2:2, `UYVY`.
    Uyvy,
    /// 4:2:0 in one memory plane (`NV12`) or two (`NM12`).
    Nv12,
    /// A JPEG image a frame, `MJPG` or `JPEG`.
    Mjpeg,
    /// 8 bits of luminance, `GREY`.
    Grey,
    /// Bayer mosaic of 8 bits in any phase: `RGGB`, `GRBG`, `GBRG` or `BA81`.
    Bayer8,
    /// 3 bytes a pixel, `RGB3` or `BGR3`.
    Rgb24,
}

/// What is set on a camera; `None` leaves it as it is. Setting one turns the camera's own judgement of it off.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CameraControls {
    /// Seconds, in steps of 0.1 ms.
    pub exposure_secs: Option<f64>,
    /// In the camera's own unit.
    pub gain: Option<i32>,
    /// Kelvin.
    pub white_balance_kelvin: Option<i32>,
    /// In the camera's own unit; 0 is usually infinity.
    pub focus: Option<i32>,
}

/// What a camera is opened as.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraOptions {
    /// Which camera.
    pub identity: CameraIdentity,
    /// Pixels; the calibration belongs to this size, so nothing else is taken.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Frames a second.
    pub fps: f64,
    /// Pixel format.
    pub format: FormatChoice,
    /// Exposure and the like; set again whenever the camera comes back.
    pub controls: CameraControls,
    /// Time from the first row's exposure to the last one's, seconds; 0 for a global shutter or when unknown.
    pub readout_secs: f64,
    /// How much later than the truth this camera's stamps are, seconds; taken off.
    pub lag_secs: f64,
    /// Buffers in the driver's hands: with too few, frames are lost whenever this process is late.
    pub buffers: u32,
}

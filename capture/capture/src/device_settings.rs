//! Settings of a physical camera as a configuration file holds them.

use flyrig_types::CameraId;
use serde::{Deserialize, Serialize};

use crate::camera_options::{CameraControls, CameraIdentity, CameraOptions, FormatChoice};
use crate::error::{CaptureError, CaptureErrorKind};
use crate::nokhwa_camera::{NokhwaCamera, NokhwaDevice, NokhwaOptions};
use crate::source::CameraSource;

/// Capture API of a camera, with its options.
#[derive(Debug, Clone, PartialEq)]
pub enum DeviceOptions {
    /// Linux V4L2.
    V4l2(CameraOptions),
    /// The crate nokhwa, on any system.
    Nokhwa(NokhwaOptions),
}

/// Settings of a physical camera, identified by one of `serial`, `path`, `bus` and `nokhwa`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeviceSettings {
    /// Name of the camera in calibration, logs and topics.
    pub name: String,
    /// Serial number, as [`CameraIdentity::Serial`].
    #[serde(default)]
    pub serial: String,
    /// Path of the device, as [`CameraIdentity::Path`].
    #[serde(default)]
    pub path: String,
    /// Place on the bus, as [`CameraIdentity::Bus`].
    #[serde(default)]
    pub bus: String,
    /// Name or number of a nokhwa device.
    #[serde(default)]
    pub nokhwa: String,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Frames per second.
    #[serde(default = "default_fps")]
    pub fps: f64,
    /// Pixel format.
    #[serde(default)]
    pub format: FormatChoice,
    /// Fixed exposure, milliseconds; automatic if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_ms: Option<f64>,
    /// Fixed gain, in the driver's unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<i32>,
    /// Fixed white balance, kelvin; automatic if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub white_balance_kelvin: Option<i32>,
    /// Fixed focus, in the driver's unit; automatic if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focus: Option<i32>,
    /// Time between the exposures of the first and the last row, milliseconds.
    #[serde(default)]
    pub readout_ms: f64,
    /// Latency of the camera's timestamps, milliseconds; subtracted from them.
    #[serde(default)]
    pub lag_ms: f64,
    /// Buffers queued in the driver.
    #[serde(default = "default_buffers")]
    pub buffers: u32,
}

fn default_fps() -> f64 {
    30.0
}

fn default_buffers() -> u32 {
    6
}

impl DeviceSettings {
    /// Validates every value.
    ///
    /// # Errors
    /// Names the camera, the key and the valid range.
    pub fn check(&self) -> Result<(), CaptureError> {
        let range = |key: &str, value: f64, low: f64, high: f64| {
            if value.is_finite() && (low..=high).contains(&value) {
                return Ok(());
            }
            Err(self.wrong(format!("{key} is {value}, it must lie between {low} and {high}")))
        };
        CameraId::from(self.name.as_str())
            .check()
            .map_err(|error| CaptureError::general(CaptureErrorKind::Unsupported, error.to_string()))?;
        self.options()?;
        range("size[0]", f64::from(self.size[0]), 16.0, 16_384.0)?;
        range("size[1]", f64::from(self.size[1]), 16.0, 16_384.0)?;
        range("fps", self.fps, 0.1, 1000.0)?;
        range("exposure_ms", self.exposure_ms.unwrap_or(1.0), 0.1, 10_000.0)?;
        range("white_balance_kelvin", self.white_balance_kelvin.unwrap_or(5000).into(), 1000.0, 20_000.0)?;
        range("readout_ms", self.readout_ms, 0.0, 1000.0)?;
        range("lag_ms", self.lag_ms, -10_000.0, 10_000.0)?;
        range("buffers", self.buffers.into(), 3.0, 32.0)
    }

    /// Returns the options with which the camera is opened.
    ///
    /// # Errors
    /// When no identity or several are given, when nokhwa does not support an option, and when V4L2 is requested on
    /// another system than Linux.
    pub fn options(&self) -> Result<DeviceOptions, CaptureError> {
        let given = [&self.serial, &self.path, &self.bus, &self.nokhwa];
        let count = given.iter().filter(|text| !text.is_empty()).count();
        if count > 1 {
            return Err(self.wrong("name it by one of serial, path, bus and nokhwa, not by several"));
        }
        let identity = if !self.serial.is_empty() {
            CameraIdentity::Serial(self.serial.clone())
        } else if !self.path.is_empty() {
            CameraIdentity::Path(self.path.clone())
        } else if !self.bus.is_empty() {
            CameraIdentity::Bus(self.bus.clone())
        } else if self.nokhwa.is_empty() {
            return Err(self.wrong("serial, path, bus and nokhwa are all empty; set one (`flyrig doctor` lists them)"));
        } else {
            return Ok(DeviceOptions::Nokhwa(self.nokhwa_options()?));
        };
        if !cfg!(target_os = "linux") {
            return Err(self.wrong(format!("{identity} needs Linux; name it by its name or number in the key nokhwa")));
        }
        Ok(DeviceOptions::V4l2(CameraOptions {
            identity,
            width: self.size[0],
            height: self.size[1],
            fps: self.fps,
            format: self.format,
            controls: CameraControls {
                exposure_secs: self.exposure_ms.map(|ms| ms / 1e3),
                gain: self.gain,
                white_balance_kelvin: self.white_balance_kelvin,
                focus: self.focus,
            },
            readout_secs: self.readout_ms / 1e3,
            lag_secs: self.lag_ms / 1e3,
            buffers: self.buffers,
        }))
    }

    fn nokhwa_options(&self) -> Result<NokhwaOptions, CaptureError> {
        let set = [
            ("exposure_ms", self.exposure_ms.is_some()),
            ("gain", self.gain.is_some()),
            ("white_balance_kelvin", self.white_balance_kelvin.is_some()),
            ("focus", self.focus.is_some()),
            ("readout_ms", self.readout_ms > 0.0),
            ("buffers", self.buffers != default_buffers()),
        ];
        if let Some((key, _)) = set.into_iter().find(|(_, is_set)| *is_set) {
            return Err(self.wrong(format!(
                "{key} cannot be set through nokhwa; leave it out, or name the camera by serial, path or bus"
            )));
        }
        for (format, text) in [(FormatChoice::Uyvy, "uyvy"), (FormatChoice::Bayer8, "bayer8")] {
            if self.format == format {
                return Err(self.wrong(format!(
                    "format \"{text}\" is not available through nokhwa; set another, or name the camera by serial, path or bus"
                )));
            }
        }
        Ok(NokhwaOptions {
            device: NokhwaDevice::from(self.nokhwa.as_str()),
            width: self.size[0],
            height: self.size[1],
            fps: self.fps,
            format: self.format,
            lag_secs: self.lag_ms / 1e3,
        })
    }

    /// Builds the error of an invalid setting.
    fn wrong(&self, message: impl Into<String>) -> CaptureError {
        CaptureError::new(&CameraId::from(self.name.as_str()), CaptureErrorKind::Unsupported, message)
    }
}

impl DeviceOptions {
    /// Opens the camera.
    ///
    /// # Errors
    /// Those of [`V4l2Camera::open`](crate::V4l2Camera::open) and [`NokhwaCamera::open`].
    pub fn open(&self, camera: &CameraId) -> Result<Box<dyn CameraSource>, CaptureError> {
        Ok(match self {
            #[cfg(target_os = "linux")]
            Self::V4l2(options) => Box::new(crate::V4l2Camera::open(camera, options)?),
            // `options` makes none of these elsewhere.
            #[cfg(not(target_os = "linux"))]
            Self::V4l2(_) => return Err(CaptureError::new(camera, CaptureErrorKind::Unsupported, "V4L2 needs Linux")),
            Self::Nokhwa(options) => Box::new(NokhwaCamera::open(camera, options)?),
        })
    }
}

//! `source.cameras`: names of simulated or recorded cameras, tables of real ones.

use std::fmt;

use anyhow::{Result, ensure};
use flyrig_capture::{CameraControls, CameraIdentity, CameraOptions, FormatChoice, NokhwaDevice, NokhwaOptions};
use serde::{
    Deserialize, Deserializer, Serialize,
    de::{MapAccess, Visitor, value::MapAccessDeserializer},
};

/// One entry of `source.cameras`.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum CameraEntry {
    Named(String),
    Device(Box<CameraSection>),
}

/// How a real camera is opened.
#[derive(Debug, Clone, PartialEq)]
pub enum DeviceOptions {
    V4l2(CameraOptions),
    Nokhwa(NokhwaOptions),
}

/// A real camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraSection {
    pub name: String,
    #[serde(default)]
    pub serial: String,
    #[serde(default)]
    pub path: String,
    #[serde(default)]
    pub bus: String,
    #[serde(default)]
    pub nokhwa: String,
    pub size: [u32; 2],
    #[serde(default = "default_fps")]
    pub fps: f64,
    #[serde(default)]
    pub format: FormatChoice,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_ms: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<i32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub white_balance_kelvin: Option<i32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focus: Option<i32>,
    #[serde(default)]
    pub readout_ms: f64,
    #[serde(default)]
    pub lag_ms: f64,
    #[serde(default = "default_buffers")]
    pub buffers: u32,
}

fn default_fps() -> f64 {
    30.0
}

fn default_buffers() -> u32 {
    6
}

/// Not derived: an untagged enum would swallow the names of unknown keys.
impl<'de> Deserialize<'de> for CameraEntry {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Entry;
        impl<'de> Visitor<'de> for Entry {
            type Value = CameraEntry;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the name of a camera, or a table [[source.cameras]] of a real one")
            }

            fn visit_str<E>(self, name: &str) -> Result<CameraEntry, E> {
                Ok(CameraEntry::Named(name.to_owned()))
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<CameraEntry, A::Error> {
                CameraSection::deserialize(MapAccessDeserializer::new(map))
                    .map(|section| CameraEntry::Device(Box::new(section)))
            }
        }
        deserializer.deserialize_any(Entry)
    }
}

impl CameraEntry {
    /// What the rest of the rig calls the camera.
    pub fn name(&self) -> &str {
        match self {
            Self::Named(name) => name,
            Self::Device(section) => &section.name,
        }
    }

    /// The table of a real camera.
    ///
    /// # Errors
    /// Says what to write when there is only a name.
    pub fn device(&self) -> Result<&CameraSection> {
        match self {
            Self::Device(section) => Ok(section),
            Self::Named(name) => anyhow::bail!(
                "source.kind is \"cameras\", but camera {name} of source.cameras is only a name; write a table \
                 [[source.cameras]] with name, size, and one of serial, path, bus and nokhwa (`flyrig doctor` lists them)"
            ),
        }
    }
}

impl CameraSection {
    /// Checks every value.
    pub fn check(&self) -> Result<()> {
        let range = |key: &str, value: f64, low: f64, high: f64| -> Result<()> {
            ensure!(
                value.is_finite() && (low..=high).contains(&value),
                "camera {}: {key} is {value}, it must lie between {low} and {high}",
                self.name
            );
            Ok(())
        };
        ensure!(!self.name.is_empty(), "a table [[source.cameras]] has an empty name");
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

    /// What the camera is opened as.
    ///
    /// # Errors
    /// When it is named in no way or in several, and when nokhwa cannot do what is asked for.
    pub fn options(&self) -> Result<DeviceOptions> {
        let name = &self.name;
        let given = [&self.serial, &self.path, &self.bus, &self.nokhwa];
        let count = given.iter().filter(|text| !text.is_empty()).count();
        ensure!(count < 2, "camera {name}: name it by one of serial, path, bus and nokhwa, not by several");
        let identity = if !self.serial.is_empty() {
            CameraIdentity::Serial(self.serial.clone())
        } else if !self.path.is_empty() {
            CameraIdentity::Path(self.path.clone())
        } else if !self.bus.is_empty() {
            CameraIdentity::Bus(self.bus.clone())
        } else {
            ensure!(
                count > 0,
                "camera {name}: serial, path, bus and nokhwa are all empty; set one (`flyrig doctor` lists them)"
            );
            return Ok(DeviceOptions::Nokhwa(self.nokhwa_options()?));
        };
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

    fn nokhwa_options(&self) -> Result<NokhwaOptions> {
        let set = [
            ("exposure_ms", self.exposure_ms.is_some()),
            ("gain", self.gain.is_some()),
            ("white_balance_kelvin", self.white_balance_kelvin.is_some()),
            ("focus", self.focus.is_some()),
            ("readout_ms", self.readout_ms > 0.0),
            ("buffers", self.buffers != default_buffers()),
        ];
        if let Some((key, _)) = set.into_iter().find(|(_, is_set)| *is_set) {
            anyhow::bail!(
                "camera {}: {key} cannot be set through nokhwa; leave it out, or name the camera by serial, path or bus",
                self.name
            );
        }
        for (format, text) in [(FormatChoice::Uyvy, "uyvy"), (FormatChoice::Bayer8, "bayer8")] {
            ensure!(
                self.format != format,
                "camera {}: format \"{text}\" cannot be had through nokhwa; set another, or name the camera by serial, \
                 path or bus",
                self.name
            );
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
}

#[cfg(test)]
mod tests {
    use crate::config::Config;

    use super::*;

    const RIG: &str = "[source]\nkind = \"v4l2\"\npath = \"calib\"\n[perception]\npose = \"estimated\"\n";

    fn parse(cameras: &str) -> Result<Config, String> {
        let text = RIG.replace("[perception]", &format!("{cameras}\n[perception]"));
        Config::parse(&text).map_err(|error| format!("{error:#}"))
    }

    #[test]
    fn a_table_becomes_options() {
        let table = "[[source.cameras]]\nname = \"left\"\nserial = \"A1\"\nsize = [1280, 720]\nfps = 60\nformat = \"mjpeg\"\n\
                     exposure_ms = 8\ngain = 3\nlag_ms = 2.5\n";
        let config = parse(table).unwrap();
        let DeviceOptions::V4l2(options) = config.source.cameras[0].device().unwrap().options().unwrap() else {
            panic!()
        };
        assert_eq!(options.identity, CameraIdentity::Serial("A1".into()));
        assert_eq!((options.width, options.height, options.fps), (1280, 720, 60.0));
        assert_eq!((options.format, options.buffers), (FormatChoice::Mjpeg, 6));
        assert_eq!((options.controls.exposure_secs, options.controls.gain), (Some(0.008), Some(3)));
        assert!((options.lag_secs - 0.0025).abs() < 1e-12);
        let table = "[[source.cameras]]\nname = \"left\"\nnokhwa = \"FaceTime HD Camera\"\nsize = [1280, 720]\n";
        let nokhwa = parse(table).unwrap().source.cameras[0].device().unwrap().options().unwrap();
        let DeviceOptions::Nokhwa(nokhwa) = nokhwa else { panic!() };
        assert_eq!(nokhwa.device, NokhwaDevice::Name("FaceTime HD Camera".into()));
        assert_eq!((nokhwa.width, nokhwa.height, nokhwa.fps), (1280, 720, 30.0));
        // As written, so read.
        let again = Config::parse(&toml::to_string(&config).unwrap()).unwrap();
        assert_eq!(again, config);
    }

    #[test]
    fn mistakes_name_camera_key_and_mend() {
        let table = |keys: &str| {
            parse(&format!("[[source.cameras]]\nname = \"left\"\nsize = [640, 360]\n{keys}\n")).unwrap_err()
        };
        for (keys, expected) in [
            ("", "camera left: serial, path, bus and nokhwa are all empty; set one"),
            ("serial = \"a\"\nbus = \"b\"", "by one of serial, path, bus and nokhwa, not by several"),
            ("nokhwa = \"0\"\ngain = 3", "camera left: gain cannot be set through nokhwa; leave it out"),
            ("nokhwa = \"0\"\nformat = \"uyvy\"", "format \"uyvy\" cannot be had through nokhwa"),
            ("serial = \"a\"\nfps = 0", "camera left: fps is 0, it must lie between 0.1 and 1000"),
            ("serial = \"a\"\nexposure_ms = nan", "camera left: exposure_ms is NaN"),
            ("serial = \"a\"\nbuffers = 1", "camera left: buffers is 1, it must lie between 3 and 32"),
            ("serial = \"a\"\nexposure = 3", "unknown field `exposure`"),
            ("serial = \"a\"\nformat = \"h264\"", "unknown variant `h264`"),
        ] {
            let error = table(keys);
            assert!(error.contains(expected), "{keys}: {error}");
        }
        assert!(table("serial = \"a\"\nexposure = 3").ends_with("did you mean `exposure_ms`?"));
        let error = parse("cameras = [\"left\"]").unwrap_err();
        assert!(error.contains("camera left of source.cameras is only a name"), "{error}");
        let error = parse("cameras = [3]").unwrap_err();
        assert!(error.contains("the name of a camera, or a table"), "{error}");
        let twice = "[[source.cameras]]\nname = \"a\"\nsize = [64, 64]\nbus = \"x\"\n".repeat(2);
        assert!(parse(&twice).unwrap_err().contains("camera a is listed twice"));
        assert!(parse("").unwrap_err().contains("is only a name"), "the default names are those of the simulated rig");
        let error = Config::parse("[[source.cameras]]\nname = \"a\"\nsize = [64, 64]\nbus = \"x\"\n").unwrap_err();
        assert!(error.to_string().contains("source.kind is not \"cameras\""), "{error}");
    }
}

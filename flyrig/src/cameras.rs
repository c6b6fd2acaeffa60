//! `source.cameras`: names of simulated or recorded cameras, tables of real ones.

use std::fmt;

use anyhow::{Context as _, Result, ensure};
use flyrig_capture::{CameraControls, CameraIdentity, CameraOptions, FormatChoice};
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
                "source.kind is \"v4l2\", but camera {name} of source.cameras is only a name; write a table \
                 [[source.cameras]] with name, size, and one of serial, path and bus (`flyrig doctor` lists them)"
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
        self.identity()?;
        range("size[0]", f64::from(self.size[0]), 16.0, 16_384.0)?;
        range("size[1]", f64::from(self.size[1]), 16.0, 16_384.0)?;
        range("fps", self.fps, 0.1, 1000.0)?;
        range("exposure_ms", self.exposure_ms.unwrap_or(1.0), 0.1, 10_000.0)?;
        range("white_balance_kelvin", self.white_balance_kelvin.unwrap_or(5000).into(), 1000.0, 20_000.0)?;
        range("readout_ms", self.readout_ms, 0.0, 1000.0)?;
        range("lag_ms", self.lag_ms, -10_000.0, 10_000.0)?;
        range("buffers", self.buffers.into(), 3.0, 32.0)
    }

    fn identity(&self) -> Result<CameraIdentity> {
        let given = [
            (&self.serial, CameraIdentity::Serial as fn(String) -> CameraIdentity),
            (&self.path, CameraIdentity::Path),
            (&self.bus, CameraIdentity::Bus),
        ];
        let mut given = given.into_iter().filter(|(text, _)| !text.is_empty());
        let (first, second) = (given.next(), given.next());
        ensure!(second.is_none(), "camera {}: name it by one of serial, path and bus, not by several", self.name);
        let (text, make) = first.with_context(|| {
            format!("camera {}: serial, path and bus are all empty; set one (`flyrig doctor` lists them)", self.name)
        })?;
        Ok(make(text.clone()))
    }

    /// What the camera is opened as.
    pub fn options(&self) -> Result<CameraOptions> {
        Ok(CameraOptions {
            identity: self.identity()?,
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
        })
    }
}

#[cfg(test)]
mod tests {
    use crate::config::Config;

    use super::*;

    const RIG: &str = "[source]\nkind = \"v4l2\"\npath = \"calib\"\n[body]\npose = \"estimated\"\n";

    fn parse(cameras: &str) -> Result<Config, String> {
        let text = RIG.replace("[body]", &format!("{cameras}\n[body]"));
        Config::parse(&text).map_err(|error| format!("{error:#}"))
    }

    #[test]
    fn a_table_becomes_options() {
        let table = "[[source.cameras]]\nname = \"left\"\nserial = \"A1\"\nsize = [1280, 720]\nfps = 60\nformat = \"mjpeg\"\n\
                     exposure_ms = 8\ngain = 3\nlag_ms = 2.5\n";
        let config = parse(table).unwrap();
        let options = config.source.cameras[0].device().unwrap().options().unwrap();
        assert_eq!(options.identity, CameraIdentity::Serial("A1".into()));
        assert_eq!((options.width, options.height, options.fps), (1280, 720, 60.0));
        assert_eq!((options.format, options.buffers), (FormatChoice::Mjpeg, 6));
        assert_eq!((options.controls.exposure_secs, options.controls.gain), (Some(0.008), Some(3)));
        assert!((options.lag_secs - 0.0025).abs() < 1e-12);
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
            ("", "camera left: serial, path and bus are all empty; set one"),
            ("serial = \"a\"\nbus = \"b\"", "by one of serial, path and bus, not by several"),
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
        assert!(error.to_string().contains("source.kind is not \"v4l2\""), "{error}");
    }
}

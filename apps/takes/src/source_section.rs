//! `source.cameras`: names of simulated or recorded cameras, tables of real ones.

use std::fmt;

use anyhow::Result;
use flyrig_capture::DeviceSettings;
use serde::{
    Deserialize, Deserializer, Serialize,
    de::{MapAccess, Visitor, value::MapAccessDeserializer},
};

/// One entry of `source.cameras`.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum CameraEntry {
    Named(String),
    Device(Box<DeviceSettings>),
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
                DeviceSettings::deserialize(MapAccessDeserializer::new(map))
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
    pub fn device(&self) -> Result<&DeviceSettings> {
        match self {
            Self::Device(section) => Ok(section),
            Self::Named(name) => anyhow::bail!(
                "source.kind is \"cameras\", but camera {name} of source.cameras is only a name; write a table \
                 [[source.cameras]] with name, size, and one of serial, path, bus and nokhwa (`flyrig doctor` lists them)"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use flyrig_capture::{CameraIdentity, DeviceOptions, FormatChoice, NokhwaDevice};

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

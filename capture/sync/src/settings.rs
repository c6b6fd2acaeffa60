//! Settings of the synchroniser: the table `[sync]` of a configuration.

use std::collections::BTreeMap;

use flyrig_types::{Camera, CameraId};
use serde::{Deserialize, Serialize};

use crate::clocks::ClockKind;

/// Settings of frame sets. Serialised in milliseconds, 0 meaning "automatic"; kept in whole nanoseconds.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SyncSettings {
    /// Largest distance of a frame from its frame set's time. When `None`, half of the master's current frame period
    /// (or, where a camera is faster than the master, three fifths of its own); up to that the nearest frame set of a
    /// frame is unambiguous. A camera that keeps the distance it had in the previous frame set may be half as far
    /// again: one that runs half a period beside the master would otherwise drop out of every other frame set.
    #[serde(rename = "window_ms", with = "window")]
    pub window_nanos: Option<u64>,
    /// Longest time, on the frames' own clock, that a frame set waits for a camera; three of the master's periods, but
    /// 100 ms to 1 s, when `None`. A camera silent for longer is no longer awaited, and when it is the master, the next
    /// camera's clock takes over.
    #[serde(rename = "max_wait_ms", with = "max_wait")]
    pub max_wait_nanos: Option<u64>,
    /// Time offset of each camera's timestamps against the other cameras'; subtracted before anything else. Frame sets
    /// wait longer by the spread of the offsets. Replaces the calibration's ([`Self::with_offsets_of`]).
    #[serde(rename = "lags_ms", with = "lags")]
    pub lags_nanos: BTreeMap<CameraId, i64>,
    /// Camera whose frames set the times of the frame sets; the rig's first when `None`.
    #[serde(with = "master")]
    pub master: Option<CameraId>,
    /// Whether the cameras share a clock.
    pub clocks: ClockKind,
}

impl SyncSettings {
    /// Returns the settings with the time offsets of calibrated cameras that have none here.
    #[must_use]
    pub fn with_offsets_of(&self, cameras: &[Camera]) -> Self {
        let mut settings = self.clone();
        for camera in cameras.iter().filter(|camera| camera.time_offset_nanos != 0) {
            settings.lags_nanos.entry(camera.id.clone()).or_insert(camera.time_offset_nanos);
        }
        settings
    }
}

/// Converts milliseconds within a range; `key` names the setting in the error.
fn checked_nanos<E: serde::de::Error>(key: &str, millis: f64, [low, high]: [f64; 2]) -> Result<i64, E> {
    if !(low..=high).contains(&millis) {
        return Err(E::custom(format!("sync.{key} is {millis}, it must lie between {low} and {high}")));
    }
    Ok((millis * 1e6).round() as i64)
}

/// Declares a (de)serialiser of an optional duration in milliseconds, 0 for `None`.
macro_rules! optional_millis {
    ($module:ident, $key:literal, $most:literal) => {
        mod $module {
            use serde::{Deserialize as _, Deserializer, Serializer};

            pub fn serialize<S: Serializer>(nanos: &Option<u64>, to: S) -> Result<S::Ok, S::Error> {
                to.serialize_f64(nanos.map_or(0.0, |nanos| nanos as f64 * 1e-6))
            }

            pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<u64>, D::Error> {
                let nanos = super::checked_nanos($key, f64::deserialize(from)?, [0.0, $most])?;
                Ok(u64::try_from(nanos).ok().filter(|nanos| *nanos > 0))
            }
        }
    };
}
optional_millis!(window, "window_ms", 10_000.0);
optional_millis!(max_wait, "max_wait_ms", 60_000.0);

/// (De)serialiser of milliseconds per camera.
mod lags {
    use std::collections::BTreeMap;

    use flyrig_types::CameraId;
    use serde::{Deserialize as _, Deserializer, Serializer};

    pub fn serialize<S: Serializer>(nanos: &BTreeMap<CameraId, i64>, to: S) -> Result<S::Ok, S::Error> {
        to.collect_map(nanos.iter().map(|(camera, nanos)| (camera, *nanos as f64 * 1e-6)))
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<BTreeMap<CameraId, i64>, D::Error> {
        let millis = BTreeMap::<CameraId, f64>::deserialize(from)?;
        let checked = |(camera, millis): (CameraId, f64)| {
            let key = format!("lags_ms of {camera}");
            super::checked_nanos(&key, millis, [-1000.0, 1000.0]).map(|nanos| (camera, nanos))
        };
        millis.into_iter().map(checked).collect()
    }
}

/// (De)serialiser of a name, empty for `None`.
mod master {
    use flyrig_types::CameraId;
    use serde::{Deserialize as _, Deserializer, Serializer};

    pub fn serialize<S: Serializer>(master: &Option<CameraId>, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(master.as_ref().map_or("", CameraId::as_str))
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<CameraId>, D::Error> {
        let name = String::deserialize(from)?;
        Ok((!name.is_empty()).then(|| name.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_keep_their_values_and_zero_is_automatic() {
        let text = "window_ms = 4.5\nmax_wait_ms = 0.0\nlags_ms = { \"03\" = -50.2 }\nmaster = \"\"\n";
        let settings: SyncSettings = toml::from_str(text).unwrap();
        assert_eq!((settings.window_nanos, settings.max_wait_nanos), (Some(4_500_000), None));
        assert_eq!(settings.lags_nanos, [("03".into(), -50_200_000)].into());
        assert_eq!((settings.master.clone(), settings.clocks), (None, ClockKind::Shared));
        let again: SyncSettings = toml::from_str(&toml::to_string(&settings).unwrap()).unwrap();
        assert_eq!(again, settings);
        assert_eq!(toml::from_str::<SyncSettings>("").unwrap(), SyncSettings::default());
    }

    #[test]
    fn values_out_of_range_are_named() {
        for (text, expected) in [
            ("window_ms = nan", "sync.window_ms is NaN"),
            ("window_ms = -1.0", "sync.window_ms is -1"),
            ("max_wait_ms = 1e9", "it must lie between 0 and 60000"),
            ("lags_ms = { a = 2000.0 }", "sync.lags_ms of a is 2000"),
            ("wait = 1.0", "unknown field `wait`"),
        ] {
            let error = toml::from_str::<SyncSettings>(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}

//! The rig's own figures, JSON.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{SCHEMA_VERSION, TransportError};

/// Largest JSON payload that is looked at, bytes.
pub(crate) const MAX_JSON_BYTES: usize = 1 << 18;

/// Time a stage of the pipeline takes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageTime {
    /// Name of the stage.
    pub stage: String,
    /// Mean over the interval, milliseconds.
    pub mean_millis: f64,
    /// Longest of the interval, milliseconds.
    pub max_millis: f64,
}

/// What a view costs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewRate {
    /// Name of the view.
    pub view: String,
    /// Pictures a second.
    pub per_second: f64,
    /// Bytes a second.
    pub bytes_per_second: f64,
}

/// How well the person is followed, at the last frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrackingStats {
    /// "searching", "first", "steady", "recovering" or "lost".
    pub state: String,
    /// How much of the person is where the pictures show it, 0 to 1; none when nothing was compared.
    pub quality: Option<f64>,
    /// The same by camera; one that is covered is near 0.
    pub cameras: BTreeMap<String, f64>,
}

/// How the rig is doing over its last interval (about a second).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RigStats {
    /// The rig's frame number.
    pub frame: u64,
    /// `CLOCK_MONOTONIC` of the capturing host.
    pub capture_nanos: i64,
    /// Since the rig started, seconds.
    pub uptime_secs: f64,
    /// Frame sets a second through the whole pipeline.
    pub frames_per_second: f64,
    /// In the order of the pipeline.
    pub stages: Vec<StageTime>,
    /// Frames lost since the start, by place.
    pub dropped: BTreeMap<String, u64>,
    /// Published views.
    pub views: Vec<ViewRate>,
    /// Subscribers with a viewpoint of their own.
    pub viewers: u32,
    /// How well the person is followed.
    #[serde(default)]
    pub tracking: TrackingStats,
}

/// JSON with the version first, so that a reader can tell before it understands the rest.
#[derive(Serialize)]
struct Versioned<'a, T> {
    schema_version: u16,
    #[serde(flatten)]
    body: &'a T,
}

#[derive(Deserialize)]
struct VersionOnly {
    schema_version: u64,
}

/// JSON bytes of a message with its schema version.
pub(crate) fn to_json<T: Serialize>(topic: &str, body: &T) -> Result<Vec<u8>, TransportError> {
    let bytes = serde_json::to_vec(&Versioned { schema_version: SCHEMA_VERSION, body })
        .map_err(|error| TransportError::config(topic, error.to_string()))?;
    if bytes.len() > MAX_JSON_BYTES {
        return Err(TransportError::config(topic, format!("{} bytes of JSON, at most {MAX_JSON_BYTES}", bytes.len())));
    }
    Ok(bytes)
}

/// Message out of JSON bytes of our schema version.
pub(crate) fn from_json<T: serde::de::DeserializeOwned>(topic: &str, bytes: &[u8]) -> Result<T, TransportError> {
    if bytes.len() > MAX_JSON_BYTES {
        let len = bytes.len();
        return Err(TransportError::malformed(topic, format!("{len} bytes of JSON, at most {MAX_JSON_BYTES}")));
    }
    let refuse = |error: serde_json::Error| TransportError::malformed(topic, error.to_string());
    let version: VersionOnly = serde_json::from_slice(bytes).map_err(refuse)?;
    if version.schema_version != u64::from(SCHEMA_VERSION) {
        return Err(TransportError::version(topic, version.schema_version));
    }
    serde_json::from_slice(bytes).map_err(refuse)
}

impl RigStats {
    /// As JSON.
    ///
    /// # Errors
    /// `Config` when a figure is NaN or infinite (JSON has no form for them) or it is over 256 KiB.
    pub fn encode(&self) -> Result<Vec<u8>, TransportError> {
        let finite = [self.uptime_secs, self.frames_per_second]
            .into_iter()
            .chain(self.stages.iter().flat_map(|stage| [stage.mean_millis, stage.max_millis]))
            .chain(self.tracking.quality)
            .chain(self.tracking.cameras.values().copied())
            .chain(self.views.iter().flat_map(|view| [view.per_second, view.bytes_per_second]))
            .all(f64::is_finite);
        if !finite {
            return Err(TransportError::config("stats", "a figure is NaN or infinite; leave it out or send 0"));
        }
        to_json("stats", self)
    }

    /// Out of JSON.
    ///
    /// # Errors
    /// `UnknownVersion` or `Malformed`.
    pub fn decode(bytes: &[u8]) -> Result<Self, TransportError> {
        from_json("stats", bytes)
    }
}

//! Scripted faults of cameras and clocks.
//!
//! ```toml
//! seed = 7
//!
//! [[fault]]
//! kind = "drift"
//! camera = "01"
//! ppm = 80.0
//!
//! [[fault]]
//! kind = "drop"
//! from_frame = 30
//! frames = 60
//! probability = 0.1
//! ```

use flyrig_types::{CameraId, Isometry};
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::name::camera_name;
use crate::camera::sensor::{gaussian, hash, uniform};
use crate::error::SimError;
use crate::error::check;

/// Kind of a [`Fault`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// The camera's clock is `ms` ahead: timestamps are later than the instants.
    Offset,
    /// The camera's clock runs fast by `ppm`: timestamps advance against the instants over time.
    Drift,
    /// Timestamps have a Gaussian error of standard deviation `ms`.
    Jitter,
    /// The camera exposes `ms` after the others, with matching timestamps.
    Lag,
    /// The frame is lost; the sequence numbers show a gap.
    Drop,
    /// The previous image is repeated under this frame's sequence number and timestamp.
    Duplicate,
    /// The source times out instead of yielding the frame.
    Stall,
    /// The source is disconnected instead of yielding the frame; afterwards its sequence numbers restart at 0.
    Disconnect,
    /// The timestamp of a single frame is off by `ms`.
    WrongTimestamp,
    /// The lower part of the image, from a random row on, is noise.
    Corrupt,
    /// The frame cannot be decoded: an error takes its place.
    Undecodable,
    /// The exposure is multiplied by `factor`.
    ExposureJump,
    /// The camera was bumped: it is displaced by `mm` and rotated by `deg`, both in directions drawn by the seed, while
    /// its calibration stays the same.
    Bump,
}

/// Fault of a script.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// Kind of the fault.
    pub kind: FaultKind,
    /// Name of the camera; all when `None`.
    #[serde(default)]
    pub camera: Option<String>,
    /// First frame that it can affect.
    #[serde(default)]
    pub from_frame: u64,
    /// Number of frames from there on that it can affect; all when `None`.
    #[serde(default)]
    pub frames: Option<u64>,
    /// Probability per frame, drawn by the seed for each camera and frame.
    #[serde(default = "always")]
    pub probability: f64,
    /// Milliseconds of offset, jitter, lag and wrong-timestamp.
    #[serde(default)]
    pub ms: Option<f64>,
    /// Parts per million of drift.
    #[serde(default)]
    pub ppm: Option<f64>,
    /// Factor of an exposure-jump.
    #[serde(default)]
    pub factor: Option<f64>,
    /// Millimetres of a bump.
    #[serde(default)]
    pub mm: Option<f64>,
    /// Degrees of a bump.
    #[serde(default)]
    pub deg: Option<f64>,
}

impl Fault {
    /// Creates a fault that affects every frame of every camera, without numbers.
    #[must_use]
    pub fn new(kind: FaultKind) -> Self {
        Self {
            kind,
            camera: None,
            from_frame: 0,
            frames: None,
            probability: always(),
            ms: None,
            ppm: None,
            factor: None,
            mm: None,
            deg: None,
        }
    }
}

fn always() -> f64 {
    1.0
}

/// Seeded list of faults. A script affects the same frames in every run.
///
/// ```
/// use flyrig_sim::{Delivery, FaultScript};
///
/// let script = FaultScript::parse(
///     "[[fault]]
///      kind = \"drop\"
///      camera = \"01\"
///      from_frame = 30
///      frames = 60",
/// )?;
/// let period = 33_333_333;
/// let plan = |camera: &str, frame| script.plan(&camera.into(), frame, |index| index as i64 * period);
/// assert_eq!(plan("01", 30).delivery, Delivery::Dropped);
/// assert_eq!(plan("00", 30).delivery, Delivery::Frame);
/// # Ok::<(), flyrig_sim::SimError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FaultScript {
    /// Seed of the affected frames and random values.
    pub seed: u64,
    /// Faults of the script.
    #[serde(rename = "fault")]
    pub faults: Vec<Fault>,
}

/// Result of a source for one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// The frame is delivered.
    Frame,
    /// The frame is lost; the next frame follows.
    Dropped,
    /// The source times out.
    Stalled,
    /// The source is disconnected.
    Disconnected,
    /// The frame cannot be decoded.
    Undecodable,
}

/// Effect of the script on one frame of one camera: the truth about its time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FramePlan {
    /// Result of the source.
    pub delivery: Delivery,
    /// True time of the image.
    pub true_nanos: i64,
    /// Timestamp of the frame.
    pub stamp_nanos: i64,
    /// Factor on the sensor's exposure.
    pub exposure: f64,
    /// Fraction of the image's rows above the noise, where there is some.
    pub sound_share: Option<f64>,
    /// Transform from the axes of the camera as set up to those of the camera after a bump.
    pub bump: Option<Isometry>,
}

impl FaultScript {
    /// Parses and validates a script.
    ///
    /// # Errors
    /// [`SimError::Script`] for malformed text (it names unknown keys), [`SimError::Config`] for numbers out of range.
    pub fn parse(text: &str) -> Result<Self, SimError> {
        let script: Self = toml::from_str(text)?;
        script.validate()?;
        Ok(script)
    }

    /// Checks that every fault's camera exists in a ring of `count` cameras.
    pub(crate) fn check_cameras(&self, count: usize) -> Result<(), SimError> {
        let stands = |name: &String| (0..count).any(|slot| camera_name(slot) == *name);
        match self.faults.iter().filter_map(|fault| fault.camera.as_ref()).find(|name| !stands(name)) {
            None => Ok(()),
            Some(name) => Err(SimError::Config {
                field: "fault.camera",
                found: format!("'{name}' beside cameras {} to {}", camera_name(0), camera_name(count.max(1) - 1)),
                expected: "one of those, or no name for all of them",
            }),
        }
    }

    pub(crate) fn validate(&self) -> Result<(), SimError> {
        use FaultKind::{Bump, Drift, ExposureJump, Jitter, Lag, Offset, WrongTimestamp};
        for fault in &self.faults {
            let kind = fault.kind;
            check("fault.probability", fault.probability, 0.0, 1.0, "a share from 0 to 1")?;
            let number = |name, value: Option<f64>, belongs: bool, low, high, expected| match (value, belongs) {
                (Some(value), true) => check(name, value, low, high, expected),
                (None, false) => Ok(()),
                (None, true) => Err(SimError::Config { field: name, found: format!("missing for {kind:?}"), expected }),
                (Some(value), false) => Err(SimError::Config {
                    field: name,
                    found: value.to_string(),
                    expected: "no such number: this kind of fault has no use for it",
                }),
            };
            let timed = matches!(kind, Offset | Jitter | Lag | WrongTimestamp);
            let low = if matches!(kind, Jitter) { 0.0 } else { -1e5 };
            number("fault.ms", fault.ms, timed, low, 1e5, "-100000 to 100000 milliseconds (jitter: from 0)")?;
            number("fault.ppm", fault.ppm, kind == Drift, -1e5, 1e5, "-100000 to 100000 parts per million")?;
            number("fault.factor", fault.factor, kind == ExposureJump, 0.0, 64.0, "0 to 64")?;
            number("fault.mm", fault.mm, kind == Bump, 0.0, 1000.0, "0 to 1000 millimetres")?;
            number("fault.deg", fault.deg, kind == Bump, 0.0, 180.0, "0 to 180 degrees")?;
        }
        Ok(())
    }

    /// Returns the script's effect on frame `index` of a camera; all cameras without faults take it at
    /// `nanos_of(index)`.
    #[must_use]
    pub fn plan(&self, camera: &CameraId, index: u64, nanos_of: impl Fn(u64) -> i64) -> FramePlan {
        let mut shown = index;
        let (mut lag, mut stamp, mut exposure, mut sound_share) = (0.0, 0.0, 1.0, None);
        let mut bump: Option<Isometry> = None;
        let mut delivery = Delivery::Frame;
        let name = camera.as_str().bytes().fold(self.seed, |key, byte| hash(key, byte.into()));
        for (place, fault) in (0u64..).zip(&self.faults) {
            let key = hash(name, place);
            let since = index.checked_sub(fault.from_frame);
            let within = since.is_some_and(|since| fault.frames.is_none_or(|frames| since < frames));
            let here = fault.camera.as_deref().is_none_or(|name| name == camera.as_str());
            if !(within && here && uniform(key, index) < fault.probability) {
                continue;
            }
            let nanos = fault.ms.unwrap_or(0.0) * 1e6;
            match fault.kind {
                FaultKind::Offset | FaultKind::WrongTimestamp => stamp += nanos,
                FaultKind::Drift => {
                    let elapsed = nanos_of(index) - nanos_of(fault.from_frame);
                    stamp += elapsed as f64 * fault.ppm.unwrap_or(0.0) * 1e-6;
                }
                FaultKind::Jitter => stamp += nanos * f64::from(gaussian(hash(key, 1), index)),
                FaultKind::Lag => lag += nanos,
                FaultKind::Duplicate => shown = index.saturating_sub(1),
                FaultKind::Corrupt => sound_share = Some(0.9 * uniform(hash(key, 2), index)),
                FaultKind::ExposureJump => exposure *= fault.factor.unwrap_or(1.0),
                FaultKind::Bump => {
                    // The same in every frame: the camera stays where it was pushed to.
                    let direction =
                        |stream| DVec3::from([0, 1, 2].map(|axis| f64::from(gaussian(hash(key, stream), axis))));
                    let turn = direction(4).normalize_or(DVec3::X) * fault.deg.unwrap_or(0.0).to_radians();
                    let push = direction(5).normalize_or(DVec3::X) * fault.mm.unwrap_or(0.0) * 1e-3;
                    let before = bump.unwrap_or(Isometry::IDENTITY);
                    let rotation = DQuat::from_scaled_axis(turn);
                    bump = Some(Isometry::new(rotation * before.rotation, rotation * before.translation + push));
                }
                FaultKind::Drop => delivery = Delivery::Dropped,
                FaultKind::Stall => delivery = Delivery::Stalled,
                FaultKind::Disconnect => delivery = Delivery::Disconnected,
                FaultKind::Undecodable => delivery = Delivery::Undecodable,
            }
        }
        FramePlan {
            delivery,
            true_nanos: nanos_of(shown) + lag as i64,
            stamp_nanos: nanos_of(index) + (lag + stamp) as i64,
            exposure,
            sound_share,
            bump,
        }
    }

    /// Overwrites the rows of an RGB image below `sound_share` of its height with noise.
    pub(crate) fn corrupt(&self, rgb: &mut [u8], sound_share: f64, index: u64) {
        let from = (rgb.len() as f64 * sound_share) as usize;
        let key = hash(hash(self.seed, 3), index);
        for (place, byte) in (0u64..).zip(rgb.iter_mut().skip(from)) {
            *byte = hash(key, place / 16) as u8;
        }
    }
}

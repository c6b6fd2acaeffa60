//! Tracking quality of one person, and the remedies for bad tracking: the state degrades and recovers by itself.
//!
//! Views that cannot be right are left out before they are assessed here; state and quality are published.

use std::collections::BTreeMap;

use flyrig_tracker::FIRST_FRAMES;
use flyrig_types::{CameraId, Pose};
use serde::Serialize;

/// Quality below which a frame set is bad.
const BAD_QUALITY: f64 = 0.4;
/// Number of bad frame sets in a row after which the deformation starts anew.
const BAD_FRAMES: u32 = 5;
/// Least quality at which the person counts as followed again.
const GOOD_QUALITY: f64 = 0.6;
/// Absence after which a person who appears may be another one, nanoseconds.
const LOST_AFTER_NANOS: u64 = 1_000_000_000;
/// Largest speed of a person, metres per second; a faster one is a leap.
const FASTEST_M_A_SEC: f64 = 12.0;
/// Least distance of a leap, metres.
const LEAST_LEAP_M: f64 = 0.3;

/// State of the tracking of one person.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TrackState {
    /// Not seen yet.
    #[default]
    Searching,
    /// In the first frame sets of a person.
    First,
    /// Followed.
    Steady,
    /// After a leap, a short loss or bad frame sets.
    Recovering,
    /// Not seen now.
    Lost,
}

impl TrackState {
    /// Returns the name of the state in statistics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Searching => "searching",
            Self::First => "first",
            Self::Steady => "steady",
            Self::Recovering => "recovering",
            Self::Lost => "lost",
        }
    }
}

/// Action that must happen before the next update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Remedy {
    /// Nothing.
    None,
    /// The deformation is kept, but the next frame sets get the iterations of a start.
    Restart,
    /// Clothes and colours are forgotten.
    Forget,
}

/// Tracking state and quality of one person over the frame sets.
#[derive(Debug, Clone, Default)]
pub struct TrackWatch {
    state: TrackState,
    /// Frame sets since the last start or restart.
    since: u32,
    /// Bad frame sets in a row.
    bad: u32,
    /// Last pose and its time, nanoseconds.
    last: Option<(i64, Pose)>,
    /// Time since which the person is away, nanoseconds.
    away_since: Option<i64>,
    /// Whether the person is known from an earlier session.
    resumed: bool,
    quality: Option<f64>,
    cameras: BTreeMap<CameraId, f64>,
}

impl TrackWatch {
    /// Returns the tracking state.
    pub fn state(&self) -> TrackState {
        self.state
    }

    /// Returns the fraction of the person that the images of the last frame set confirm, 0..=1: the median over the cameras. `None` when
    /// nothing was compared.
    pub fn quality(&self) -> Option<f64> {
        self.quality
    }

    /// Returns that fraction for each camera; it is near 0 for one that is covered or sees something else.
    pub fn cameras(&self) -> &BTreeMap<CameraId, f64> {
        &self.cameras
    }

    /// Lets the first person to arrive keep clothes and colours, which are known from an earlier session.
    pub fn resume(&mut self) {
        self.resumed = true;
    }

    /// Returns whether a person of an earlier session is still awaited.
    #[must_use]
    pub fn is_resumed(&self) -> bool {
        self.resumed
    }

    /// Notes that the person was not seen in a frame set.
    pub fn leave(&mut self, nanos: i64) {
        self.away_since.get_or_insert(nanos);
        (self.quality, self.bad) = (None, 0);
        self.cameras.clear();
        if self.state != TrackState::Searching {
            self.state = TrackState::Lost;
        }
    }

    /// Notes that the person was seen in this pose, and returns the remedy that must come first.
    pub fn arrive(&mut self, nanos: i64, pose: &Pose) -> Remedy {
        let away = self.away_since.take();
        let last = self.last.replace((nanos, pose.clone()));
        let remedy = match (self.state, away, last) {
            _ if std::mem::take(&mut self.resumed) => Remedy::Restart,
            (TrackState::Searching, ..) | (_, _, None) => Remedy::Forget,
            (_, Some(since), _) if since.abs_diff(nanos) > LOST_AFTER_NANOS => Remedy::Forget,
            (_, Some(_), _) => Remedy::Restart,
            (_, None, Some((before, old))) => {
                let leap = (pose.root_translation - old.root_translation).length();
                let secs = before.abs_diff(nanos) as f64 * 1e-9;
                if leap > (FASTEST_M_A_SEC * secs).max(LEAST_LEAP_M) || self.bad >= BAD_FRAMES {
                    Remedy::Restart
                } else {
                    Remedy::None
                }
            }
        };
        match remedy {
            Remedy::Forget => (self.state, self.since, self.bad) = (TrackState::First, 0, 0),
            Remedy::Restart => (self.state, self.since, self.bad) = (TrackState::Recovering, 0, 0),
            Remedy::None => {}
        }
        remedy
    }

    /// Assesses an update by the agreement of each camera, 0..=1.
    pub fn assess(&mut self, cameras: impl IntoIterator<Item = (CameraId, f64)>) {
        self.cameras =
            cameras.into_iter().map(|(id, q)| (id, if q.is_finite() { q.clamp(0.0, 1.0) } else { 0.0 })).collect();
        // The median, since one covered camera is not informative for the person.
        let mut sorted: Vec<f64> = self.cameras.values().copied().collect();
        sorted.sort_by(f64::total_cmp);
        self.quality = sorted.get(sorted.len() / 2).copied();
        self.since = self.since.saturating_add(1);
        let good = self.quality.is_none_or(|q| q >= GOOD_QUALITY);
        self.bad = if self.quality.is_some_and(|q| q < BAD_QUALITY) { self.bad.saturating_add(1) } else { 0 };
        if u64::from(self.since) >= FIRST_FRAMES && good && self.state != TrackState::Lost {
            self.state = TrackState::Steady;
        } else if self.state == TrackState::Steady && self.bad > 0 {
            self.state = TrackState::Recovering;
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    const FRAME: i64 = 33_333_333;

    fn pose(x: f64) -> Pose {
        Pose { root_translation: DVec3::new(x, 0.0, 1.0), joint_rotations: vec![DQuat::IDENTITY] }
    }

    /// Follows the person for `frames` frame sets with these qualities of three cameras.
    fn follow(watch: &mut TrackWatch, from: i64, frames: i64, x: f64, quality: [f64; 3]) -> Vec<Remedy> {
        (from..from + frames)
            .map(|i| {
                let remedy = watch.arrive(i * FRAME, &pose(x));
                watch.assess((0..3).map(|c| (format!("0{c}").as_str().into(), quality[c])));
                remedy
            })
            .collect()
    }

    #[test]
    fn first_frames_steady_short_loss_and_long_loss() {
        let mut watch = TrackWatch::default();
        watch.leave(0);
        assert_eq!((watch.state(), watch.quality()), (TrackState::Searching, None));
        let remedies = follow(&mut watch, 1, 10, 0.0, [0.9; 3]);
        assert_eq!(remedies[0], Remedy::Forget);
        assert!(remedies[1..].iter().all(|r| *r == Remedy::None));
        assert_eq!((watch.state(), watch.quality()), (TrackState::Steady, Some(0.9)));
        for i in 11..20 {
            watch.leave(i * FRAME);
        }
        assert_eq!((watch.state(), watch.quality()), (TrackState::Lost, None));
        assert_eq!(follow(&mut watch, 20, 12, 0.0, [0.9; 3])[0], Remedy::Restart, "still the same person");
        assert_eq!(watch.state(), TrackState::Steady);
        for i in 40..80 {
            watch.leave(i * FRAME);
        }
        assert_eq!(follow(&mut watch, 80, 12, 0.0, [0.9; 3])[0], Remedy::Forget, "perhaps another");
        assert_eq!(watch.state(), TrackState::Steady);
    }

    #[test]
    fn a_leap_and_bad_frames_start_anew_and_a_covered_camera_does_not() {
        let mut watch = TrackWatch::default();
        follow(&mut watch, 0, 15, 0.0, [0.9; 3]);
        assert_eq!(follow(&mut watch, 15, 1, 2.0, [0.9; 3]), [Remedy::Restart], "two metres in a frame");
        assert_eq!(watch.state(), TrackState::Recovering);
        follow(&mut watch, 16, 12, 2.0, [0.9; 3]);
        assert_eq!(watch.state(), TrackState::Steady);
        let covered = follow(&mut watch, 28, 150, 2.0, [0.9, 0.0, 0.8]);
        assert!(covered.iter().all(|r| *r == Remedy::None));
        assert_eq!((watch.state(), watch.quality()), (TrackState::Steady, Some(0.8)));
        assert_eq!(watch.cameras().values().copied().collect::<Vec<_>>(), [0.9, 0.0, 0.8]);
        let bad = follow(&mut watch, 178, 12, 2.0, [0.1, 0.2, f64::NAN]);
        assert_eq!(bad.iter().filter(|r| **r == Remedy::Restart).count(), 2, "once in five frames: {bad:?}");
        assert_eq!((watch.state(), watch.quality()), (TrackState::Recovering, Some(0.1)));
        follow(&mut watch, 190, 12, 2.0, [0.9; 3]);
        assert_eq!(watch.state(), TrackState::Steady);
    }
}

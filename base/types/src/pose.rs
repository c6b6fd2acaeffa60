//! Body poses and how they move in time.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Pose of a skeleton: where its root is in the world, and how each joint is turned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Position of the root joint in the world, metres.
    pub root_translation: DVec3,
    /// Per joint `parent_from_joint` rotation in the skeleton's order; of the root joint `world_from_joint`.
    pub joint_rotations: Vec<DQuat>,
}

/// Why poses are refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PoseError {
    /// No key poses at all.
    #[error("the pose track is empty")]
    Empty,
    /// Times must grow.
    #[error("pose {index} of the track is at {nanos} ns, not after the pose before it")]
    Order {
        /// Which pose.
        index: usize,
        /// Its time.
        nanos: i64,
    },
    /// A pose of another skeleton.
    #[error("pose {index} of the track has {found} joints, the first pose has {expected}")]
    JointCount {
        /// Which pose.
        index: usize,
        /// Joints found.
        found: usize,
        /// Joints of the first pose.
        expected: usize,
    },
    /// NaN, infinite or not a rotation.
    #[error("pose {index} of the track holds a number that is not finite or a rotation that is not of unit length")]
    NotFinite {
        /// Which pose.
        index: usize,
    },
}

impl Pose {
    /// Whether every number is finite and every rotation is of unit length.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        self.root_translation.is_finite()
            && self.joint_rotations.iter().all(|q| q.is_finite() && (q.length_squared() - 1.0).abs() < 1e-4)
    }

    /// Between two poses of one skeleton, `t` in 0..=1 (shortest arc a joint).
    #[must_use]
    pub fn interpolate(&self, other: &Self, t: f64) -> Self {
        Self {
            root_translation: self.root_translation.lerp(other.root_translation, t),
            joint_rotations: self
                .joint_rotations
                .iter()
                .zip(&other.joint_rotations)
                .map(|(a, b)| a.slerp(*b, t).normalize())
                .collect(),
        }
    }
}

/// A pose as a curve in time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseTrack {
    keys: Vec<(i64, Pose)>,
}

impl PoseTrack {
    /// From poses at growing times (nanoseconds).
    ///
    /// # Errors
    /// [`PoseError`] names the pose.
    pub fn new(keys: Vec<(i64, Pose)>) -> Result<Self, PoseError> {
        let expected = keys.first().ok_or(PoseError::Empty)?.1.joint_rotations.len();
        for (index, (nanos, pose)) in keys.iter().enumerate() {
            if index > 0 && *nanos <= keys[index - 1].0 {
                return Err(PoseError::Order { index, nanos: *nanos });
            }
            let found = pose.joint_rotations.len();
            if found != expected {
                return Err(PoseError::JointCount { index, found, expected });
            }
            if !pose.is_valid() {
                return Err(PoseError::NotFinite { index });
            }
        }
        Ok(Self { keys })
    }

    /// Pose at a time; held constant before the first and after the last key.
    #[must_use]
    pub fn at(&self, nanos: i64) -> Pose {
        let next = self.keys.partition_point(|(t, _)| *t <= nanos);
        let Some((t0, before)) = next.checked_sub(1).map(|i| &self.keys[i]) else { return self.keys[0].1.clone() };
        let Some((t1, after)) = self.keys.get(next) else { return before.clone() };
        // In i128 no distance between two times overflows.
        let since = |t: i64| (i128::from(t) - i128::from(*t0)) as f64;
        before.interpolate(after, since(nanos) / since(*t1))
    }

    /// Pose at a time of a motion that starts over after its end, and ran before its start too.
    #[must_use]
    pub fn at_repeated(&self, nanos: i64) -> Pose {
        let (first, last) = self.span_nanos();
        let span = i128::from(last) - i128::from(first);
        let into = if span > 0 { (i128::from(nanos) - i128::from(first)).rem_euclid(span) } else { 0 };
        self.at(i64::try_from(i128::from(first) + into).unwrap_or(first))
    }

    /// The motion laid end to end until it covers `until_nanos` too; where its end does not meet its start it jumps
    /// within a nanosecond, as [`Self::at_repeated`] does.
    #[must_use]
    pub fn repeated_until(&self, until_nanos: i64) -> Self {
        let (first, last) = self.span_nanos();
        let mut keys = self.keys.clone();
        let span = last.saturating_sub(first);
        let mut shift: i64 = 0;
        while span > 1 && last.saturating_add(shift) < until_nanos {
            shift = shift.saturating_add(span);
            // The last key and the first of the next round would have one time.
            if let Some((end, _)) = keys.last_mut() {
                *end -= 1;
            }
            keys.extend(self.keys.iter().map(|(nanos, pose)| (nanos.saturating_add(shift), pose.clone())));
        }
        Self { keys }
    }

    /// Time of the first and the last key.
    #[must_use]
    pub fn span_nanos(&self) -> (i64, i64) {
        (self.keys[0].0, self.keys[self.keys.len() - 1].0)
    }

    /// The keys.
    #[must_use]
    pub fn keys(&self) -> &[(i64, Pose)] {
        &self.keys
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(x: f64, angle: f64) -> Pose {
        Pose { root_translation: DVec3::new(x, 0.0, 0.0), joint_rotations: vec![DQuat::from_rotation_z(angle)] }
    }

    #[test]
    fn a_track_interpolates_and_holds_its_ends() {
        let track = PoseTrack::new(vec![(0, pose(0.0, 0.0)), (100, pose(1.0, 1.0))]).unwrap();
        assert!((track.at(25).root_translation.x - 0.25).abs() < 1e-12);
        assert!(track.at(25).joint_rotations[0].angle_between(DQuat::from_rotation_z(0.25)) < 1e-6);
        assert_eq!(track.at(-5), pose(0.0, 0.0));
        assert_eq!(track.at(500), pose(1.0, 1.0));
    }

    #[test]
    fn a_repeated_track_runs_before_its_start_and_after_its_end() {
        let track = PoseTrack::new(vec![(100, pose(0.0, 0.0)), (200, pose(1.0, 1.0))]).unwrap();
        let x = |nanos| track.at_repeated(nanos).root_translation.x;
        for (nanos, expected) in [(100, 0.0), (125, 0.25), (200, 0.0), (325, 0.25), (75, 0.75), (-25, 0.75)] {
            assert!((x(nanos) - expected).abs() < 1e-12, "{nanos}: {}", x(nanos));
        }
        // i64::MAX - 100 is 7 above a multiple of 100, i64::MIN - 100 is 92 above one.
        assert!((x(i64::MAX) - 0.07).abs() < 1e-12 && (x(i64::MIN) - 0.92).abs() < 1e-12);
        let single = PoseTrack::new(vec![(100, pose(3.0, 0.0))]).unwrap();
        assert_eq!(single.at_repeated(i64::MIN), pose(3.0, 0.0));
        let widest = PoseTrack::new(vec![(i64::MIN, pose(0.0, 0.0)), (i64::MAX, pose(1.0, 0.0))]).unwrap();
        assert!((widest.at_repeated(0).root_translation.x - 0.5).abs() < 1e-6);
    }

    #[test]
    fn a_motion_laid_end_to_end_is_the_repeated_one() {
        let keys = vec![(100, pose(0.0, 0.0)), (900, pose(0.5, 0.3)), (2100, pose(2.0, 1.0))];
        let track = PoseTrack::new(keys).unwrap();
        let long = track.repeated_until(9000);
        assert!(long.span_nanos().1 >= 9000 && PoseTrack::new(long.keys().to_vec()).is_ok());
        for nanos in (100..9000).step_by(37) {
            let (a, b) = (long.at(nanos), track.at_repeated(nanos));
            assert!((a.root_translation.x - b.root_translation.x).abs() < 0.002, "{nanos}");
        }
        assert_eq!(track.repeated_until(0), track);
        let single = PoseTrack::new(vec![(100, pose(3.0, 0.0))]).unwrap();
        assert_eq!(single.repeated_until(9000), single);
    }

    #[test]
    fn bad_tracks_are_refused() {
        assert_eq!(PoseTrack::new(vec![]).unwrap_err(), PoseError::Empty);
        let twice = vec![(5, pose(0.0, 0.0)), (5, pose(0.0, 0.0))];
        assert_eq!(PoseTrack::new(twice).unwrap_err(), PoseError::Order { index: 1, nanos: 5 });
        let poisoned = vec![(0, pose(f64::NAN, 0.0))];
        assert_eq!(PoseTrack::new(poisoned).unwrap_err(), PoseError::NotFinite { index: 0 });
        let mut two = pose(0.0, 0.0);
        two.joint_rotations.push(DQuat::IDENTITY);
        assert!(matches!(
            PoseTrack::new(vec![(0, pose(0.0, 0.0)), (1, two)]),
            Err(PoseError::JointCount { index: 1, .. })
        ));
    }
}

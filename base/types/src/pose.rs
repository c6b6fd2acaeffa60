//! Poses of a body and their course over time.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Pose of a skeleton: position of its root in the world and rotation of each joint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Position of the root joint in the world, metres.
    pub root_translation: DVec3,
    /// Rotation `parent_from_joint` of each joint in the skeleton's order; `world_from_joint` for the root.
    pub joint_rotations: Vec<DQuat>,
}

/// Error of poses that form no [`PoseTrack`].
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PoseError {
    /// The track has no keys.
    #[error("the pose track is empty")]
    Empty,
    /// Times do not increase.
    #[error("pose {index} of the track is at {nanos} ns, not after the pose before it")]
    Order {
        /// Index of the pose.
        index: usize,
        /// Time of the pose, nanoseconds.
        nanos: i64,
    },
    /// A pose has another number of joints than the first.
    #[error("pose {index} of the track has {found} joints, the first pose has {expected}")]
    JointCount {
        /// Index of the pose.
        index: usize,
        /// Joints found.
        found: usize,
        /// Joints of the first pose.
        expected: usize,
    },
    /// A number is NaN or infinite, or a quaternion is no rotation.
    #[error("pose {index} of the track holds a number that is not finite or a rotation that is not of unit length")]
    NotFinite {
        /// Index of the pose.
        index: usize,
    },
}

impl Pose {
    /// Returns whether all numbers are finite and all rotations have unit length.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        self.root_translation.is_finite()
            && self.joint_rotations.iter().all(|q| q.is_finite() && (q.length_squared() - 1.0).abs() < 1e-4)
    }

    /// Interpolates between two poses of one skeleton, `t` in 0..=1, along the shortest arc of each joint.
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

/// Motion of a skeleton: key poses with times, at least one.
///
/// ```
/// use flyrig_types::{Pose, PoseTrack};
/// use glam::{DQuat, DVec3};
///
/// let pose = |x: f64| Pose { root_translation: DVec3::X * x, joint_rotations: vec![DQuat::IDENTITY] };
/// let track = PoseTrack::new(vec![(0, pose(0.0)), (1_000_000_000, pose(2.0))])?;
/// assert_eq!(track.at(250_000_000).root_translation.x, 0.5);
/// assert_eq!(track.at(5_000_000_000).root_translation.x, 2.0);
/// # Ok::<(), flyrig_types::PoseError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseTrack {
    keys: Vec<(i64, Pose)>,
}

impl PoseTrack {
    /// Creates a track from poses at increasing times, nanoseconds.
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

    /// Returns the pose at a time, nanoseconds; constant before the first and after the last key.
    #[must_use]
    pub fn at(&self, nanos: i64) -> Pose {
        let next = self.keys.partition_point(|(t, _)| *t <= nanos);
        let Some((t0, before)) = next.checked_sub(1).map(|i| &self.keys[i]) else { return self.keys[0].1.clone() };
        let Some((t1, after)) = self.keys.get(next) else { return before.clone() };
        // In i128 no distance between two times overflows.
        let since = |t: i64| (i128::from(t) - i128::from(*t0)) as f64;
        before.interpolate(after, since(nanos) / since(*t1))
    }

    /// Returns the pose at a time, nanoseconds, of the motion repeated without end in both directions.
    #[must_use]
    pub fn at_repeated(&self, nanos: i64) -> Pose {
        let (first, last) = self.span_nanos();
        let span = i128::from(last) - i128::from(first);
        let into = if span > 0 { (i128::from(nanos) - i128::from(first)).rem_euclid(span) } else { 0 };
        self.at(i64::try_from(i128::from(first) + into).unwrap_or(first))
    }

    /// Returns the motion repeated until it covers `until_nanos`. Where its end does not meet its start it jumps within a
    /// nanosecond, as [`Self::at_repeated`] does.
    #[must_use]
    pub fn repeated_until(&self, until_nanos: i64) -> Self {
        let (first, last) = self.span_nanos();
        let mut keys = self.keys.clone();
        let span = last.saturating_sub(first);
        let mut shift: i64 = 0;
        while span > 1 && last.saturating_add(shift) < until_nanos {
            shift = shift.saturating_add(span);
            // Otherwise the last key and the first of the next repetition would have the same time.
            if let Some((end, _)) = keys.last_mut() {
                *end -= 1;
            }
            keys.extend(self.keys.iter().map(|(nanos, pose)| (nanos.saturating_add(shift), pose.clone())));
        }
        Self { keys }
    }

    /// Returns the times of the first and last key, nanoseconds.
    #[must_use]
    pub fn span_nanos(&self) -> (i64, i64) {
        (self.keys[0].0, self.keys[self.keys.len() - 1].0)
    }

    /// Returns the keys: time, nanoseconds, and pose.
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

//! Poses between and shortly after the times at which poses were estimated.

use flyrig_types::Pose;

/// Farthest extrapolation beyond the last pose, as a share of the time between the last two.
const FARTHEST: f64 = 1.0;
/// Longest time between two poses that are interpolated, nanoseconds.
const MAX_GAP_NANOS: u64 = 150_000_000;

/// Last two poses with their times, nanoseconds.
#[derive(Debug, Clone, Default)]
pub struct PoseCurve {
    before: Option<(i64, Pose)>,
    last: Option<(i64, Pose)>,
}

impl PoseCurve {
    /// Adds the pose at a later time than all before. A time that is not later starts the curve anew.
    pub fn push(&mut self, nanos: i64, pose: &Pose) {
        self.before = self.last.take().filter(|(t, _)| *t < nanos && t.abs_diff(nanos) <= MAX_GAP_NANOS);
        self.last = Some((nanos, pose.clone()));
    }

    /// Returns the pose at a time near the last one, interpolated between the last two or extrapolated beyond them. `None` without two
    /// poses near each other.
    pub fn at(&self, nanos: i64) -> Option<Pose> {
        let ((t0, before), (t1, last)) = self.before.as_ref().zip(self.last.as_ref())?;
        let since = |t: i64| (i128::from(t) - i128::from(*t0)) as f64;
        let share = since(nanos) / since(*t1);
        if share <= 1.0 {
            return Some(before.interpolate(last, share.max(0.0)));
        }
        // Rotations from `before` to `last` go on.
        let beyond = (share - 1.0).min(FARTHEST);
        let step = last.root_translation - before.root_translation;
        let turn = |(a, b): (&glam::DQuat, &glam::DQuat)| {
            let more = glam::DQuat::IDENTITY.slerp(a.inverse() * *b, beyond);
            (*b * more).normalize()
        };
        Some(Pose {
            root_translation: last.root_translation + step * beyond,
            joint_rotations: before.joint_rotations.iter().zip(&last.joint_rotations).map(turn).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn pose(x: f64) -> Pose {
        Pose { root_translation: DVec3::new(x, 0.0, 1.0), joint_rotations: vec![DQuat::from_rotation_z(x)] }
    }

    #[test]
    fn the_curve_interpolates_goes_on_and_stops_going_on() {
        let mut curve = PoseCurve::default();
        assert!(curve.at(0).is_none());
        curve.push(1_000_000, &pose(0.1));
        assert!(curve.at(1_000_000).is_none(), "one pose is no motion");
        curve.push(34_000_000, &pose(0.4));
        for (nanos, x) in [(0, 0.1), (1_000_000, 0.1), (17_500_000, 0.25), (34_000_000, 0.4), (50_500_000, 0.55)] {
            let at = curve.at(nanos).unwrap();
            assert!((at.root_translation.x - x).abs() < 1e-9, "{nanos}: {at:?}");
            assert!(at.joint_rotations[0].angle_between(DQuat::from_rotation_z(x)) < 1e-6 && at.is_valid());
        }
        assert!((curve.at(i64::MAX).unwrap().root_translation.x - 0.7).abs() < 1e-9, "no farther than one step");
        curve.push(900_000_000, &pose(3.0));
        assert!(curve.at(880_000_000).is_none(), "a gap is no motion");
        curve.push(5, &pose(0.0));
        assert!(curve.at(5).is_none(), "time that runs backwards starts anew");
    }
}

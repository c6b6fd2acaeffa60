//! Frame sets that a person is learnt from.

use flyrig_body::Skeleton;
use flyrig_fit::TrainingView;
use flyrig_types::Pose;
use glam::DVec3;

/// Most key sets that are kept.
const KEY_SETS: usize = 32;
/// One of so many key sets is held back from the fit.
const HELD_BACK_EVERY: usize = 4;
/// Least difference between two key sets: root mean square over the joints, metres in the room, positions relative to the root. A body that
/// turns by 12 degrees differs by as much.
const NEW_M: f64 = 0.06;
/// Age from which a key set is replaced by one that shows the same, nanoseconds: light and clothes may have changed.
const OLD_NANOS: u64 = 20_000_000_000;

/// One image of a key set.
#[derive(Debug, Clone)]
pub(crate) struct KeyView {
    /// Image, cropped to the person.
    pub crop: TrainingView,
    /// Pose at the image's own time, where it differs from the frame set's.
    pub pose: Option<Pose>,
}

/// Images of one frame set, with the person as it was tracked there.
#[derive(Debug, Clone)]
pub(crate) struct KeySet {
    /// Place among the key sets.
    pub choice: Choice,
    pub pose: Pose,
    /// Translations of the deformation's nodes, canonical metres.
    pub translations: Vec<DVec3>,
    pub views: Vec<KeyView>,
}

/// Place of a frame set among the key sets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Choice {
    /// Slot; a newer key set replaces the older one there.
    pub slot: usize,
    /// Whether it shows something new, and not the same as the older one.
    pub is_new: bool,
}

/// Returns whether the key set in a slot is held back from the fit, for comparisons.
pub(crate) fn is_held_back(slot: usize) -> bool {
    slot % HELD_BACK_EVERY == HELD_BACK_EVERY - 1
}

/// Choice of the key sets: those that differ most from each other.
#[derive(Debug, Default)]
pub(crate) struct KeySetChooser {
    kept: Vec<Kept>,
}

/// Key set as the choice knows it.
#[derive(Debug)]
struct Kept {
    /// Joints relative to the root, metres.
    joints: Vec<DVec3>,
    /// Time of the frame set.
    nanos: i64,
}

impl KeySetChooser {
    /// Forgets all key sets.
    pub fn clear(&mut self) {
        self.kept.clear();
    }

    /// Returns the number of key sets.
    pub fn count(&self) -> usize {
        self.kept.len()
    }

    /// Returns the place in which a frame set of this time and pose is kept; `None` where it shows nothing new.
    pub fn choose(&mut self, skeleton: &Skeleton, pose: &Pose, nanos: i64) -> Option<Choice> {
        let joints: Vec<DVec3> = skeleton
            .world_from_joint(pose)
            .iter()
            .map(|joint| joint.w_axis.truncate() - pose.root_translation)
            .collect();
        if joints.is_empty() || !joints.iter().all(|joint| joint.is_finite()) {
            return None;
        }
        let differences = self.kept.iter().map(|kept| difference(&kept.joints, &joints)).enumerate();
        let nearest = differences.min_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((slot, _)) = nearest.filter(|(_, novelty)| *novelty < NEW_M) {
            let is_old = self.kept[slot].nanos.abs_diff(nanos) >= OLD_NANOS;
            self.kept[slot].nanos = if is_old { nanos } else { self.kept[slot].nanos };
            return is_old.then_some(Choice { slot, is_new: false });
        }
        let kept = Kept { joints, nanos };
        if self.kept.len() < KEY_SETS {
            self.kept.push(kept);
            return Some(Choice { slot: self.kept.len() - 1, is_new: true });
        }
        let (slot, gap) = self.most_alike()?;
        if nearest.is_some_and(|(_, novelty)| novelty <= gap) {
            return None;
        }
        self.kept[slot] = kept;
        Some(Choice { slot, is_new: true })
    }

    /// Notes that a chosen frame set was lost: the next one of the same pose is chosen.
    pub fn missed(&mut self, choice: Choice) {
        if let Some(kept) = self.kept.get_mut(choice.slot) {
            kept.nanos = kept.nanos.saturating_sub_unsigned(OLD_NANOS);
        }
    }

    /// Returns the key set that is most like another one, and their difference, metres.
    fn most_alike(&self) -> Option<(usize, f64)> {
        let gap = |i: usize| {
            let others = self.kept.iter().enumerate().filter(|(j, _)| *j != i);
            others.map(|(_, other)| difference(&self.kept[i].joints, &other.joints)).fold(f64::INFINITY, f64::min)
        };
        (0..self.kept.len()).map(|i| (i, gap(i))).min_by(|a, b| a.1.total_cmp(&b.1))
    }
}

/// Returns the root mean square distance of corresponding joints, metres; infinite for other numbers of joints.
fn difference(a: &[DVec3], b: &[DVec3]) -> f64 {
    if a.len() != b.len() {
        return f64::INFINITY;
    }
    let squares: f64 = a.iter().zip(b).map(|(a, b)| a.distance_squared(*b)).sum();
    (squares / a.len().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};
    use glam::DQuat;

    use super::*;

    /// Returns the standing body turned by an angle, degrees.
    fn turned(skeleton: &Skeleton, degrees: f64) -> Pose {
        let mut pose = skeleton.rest_pose();
        pose.joint_rotations[0] = DQuat::from_rotation_y(degrees.to_radians()) * pose.joint_rotations[0];
        pose
    }

    #[test]
    fn sides_and_poses_are_kept_once_and_the_most_alike_make_room() {
        let skeleton = default_template(&ShapeParams::default()).unwrap().skeleton;
        let mut chooser = KeySetChooser::default();
        let new = |slot| Some(Choice { slot, is_new: true });
        assert_eq!(chooser.choose(&skeleton, &turned(&skeleton, 0.0), 0), new(0));
        assert_eq!(chooser.choose(&skeleton, &turned(&skeleton, 2.0), 1), None, "nothing new");
        let later = OLD_NANOS as i64;
        assert_eq!(
            chooser.choose(&skeleton, &turned(&skeleton, 2.0), later),
            Some(Choice { slot: 0, is_new: false }),
            "light and clothes may have changed"
        );
        assert_eq!(chooser.choose(&skeleton, &turned(&skeleton, 1.0), later + 1), None);
        chooser.missed(Choice { slot: 0, is_new: false });
        assert!(chooser.choose(&skeleton, &turned(&skeleton, 1.0), later + 1).is_some(), "the one before was lost");
        let joints = |degrees: f64| -> Vec<DVec3> {
            let pose = turned(&skeleton, degrees);
            let world = skeleton.world_from_joint(&pose);
            world.iter().map(|joint| joint.w_axis.truncate() - pose.root_translation).collect()
        };
        let by_angle = [11.0, 13.0].map(|degrees| difference(&joints(0.0), &joints(degrees)));
        assert!(by_angle[0] < NEW_M && NEW_M < by_angle[1], "{by_angle:?}");
        let mut walked = turned(&skeleton, 0.0);
        walked.root_translation += DVec3::new(1.0, 0.0, 2.0);
        assert_eq!(chooser.choose(&skeleton, &walked, later), None, "the same side elsewhere");
        assert_eq!(chooser.choose(&skeleton, &turned(&skeleton, 40.0), later), new(1));
        // A person who turns and raises an arm fills all places.
        let reached = |i: usize| {
            let mut pose = turned(&skeleton, i as f64 * 29.0);
            let arm = skeleton.joint("upperarm.L").or(skeleton.joint("upperarm01.L")).unwrap_or(8);
            pose.joint_rotations[arm] *= DQuat::from_rotation_z(i as f64 * 0.37);
            pose
        };
        let slots: Vec<_> = (1..400).filter_map(|i| chooser.choose(&skeleton, &reached(i), later)).collect();
        assert_eq!(chooser.kept.len(), KEY_SETS);
        assert!(slots.iter().all(|choice| choice.slot < KEY_SETS) && slots.len() > KEY_SETS, "{}", slots.len());
        let (_, gap) = chooser.most_alike().unwrap();
        assert!(gap >= NEW_M, "{gap}");
        let held = (0..KEY_SETS).filter(|slot| is_held_back(*slot)).count();
        assert_eq!(held, KEY_SETS / HELD_BACK_EVERY);
        chooser.clear();
        assert_eq!(chooser.choose(&skeleton, &turned(&skeleton, 2.0), later), new(0));
    }

    #[test]
    fn poses_that_are_no_numbers_are_not_kept() {
        let skeleton = default_template(&ShapeParams::default()).unwrap().skeleton;
        let mut chooser = KeySetChooser::default();
        let mut pose = skeleton.rest_pose();
        pose.joint_rotations[3] = DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0);
        assert_eq!(chooser.choose(&skeleton, &pose, 0), None);
        pose.root_translation = DVec3::INFINITY;
        assert_eq!(chooser.choose(&skeleton, &pose, 0), None);
        assert!(difference(&[DVec3::ZERO], &[]).is_infinite());
    }
}

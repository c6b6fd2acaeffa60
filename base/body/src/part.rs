//! Body parts by joint names.

use crate::{Part, Skeleton};

/// Returns the part of each joint, by its name in the usual rigs (CMU, Mixamo, SMPL, VRM, Unreal). A joint with another name belongs
/// to its parent's part, a root to the torso.
pub(crate) fn part_of_joints(skeleton: &Skeleton) -> Vec<Part> {
    let mut parts: Vec<Part> = Vec::with_capacity(skeleton.joints().len());
    for joint in skeleton.joints() {
        let parent = joint.parent.map_or(Part::Torso, |parent| parts[parent]);
        parts.push(part_of_name(&joint.name).unwrap_or(parent));
    }
    parts
}

fn part_of_name(name: &str) -> Option<Part> {
    // "mixamorig:LeftArm" -> "leftarm"
    let name = name.rsplit(':').next().unwrap_or(name).to_lowercase();
    let has = |words: &[&str]| words.iter().any(|word| name.contains(word));
    if has(&["hipjoint", "hips", "pelvis", "spine", "chest", "lowerback", "torso", "shoulder", "collar", "clavicle"]) {
        return Some(Part::Torso);
    }
    if has(&["head", "neck", "jaw", "eye"]) {
        return Some(Part::Head);
    }
    let left = is_left(&name);
    let side = |l, r| Some(if left { l } else { r });
    if has(&["hand", "wrist", "thumb", "finger", "index", "pinky"]) {
        side(Part::LeftHand, Part::RightHand)
    } else if has(&["foot", "ankle", "toe"]) {
        side(Part::LeftFoot, Part::RightFoot)
    } else if has(&["arm", "elbow"]) {
        side(Part::LeftArm, Part::RightArm)
    } else if has(&["leg", "thigh", "knee", "calf", "shin", "hip"]) {
        side(Part::LeftLeg, Part::RightLeg)
    } else {
        None
    }
}

pub(crate) fn is_left(name: &str) -> bool {
    if name.contains("right") || name.contains("left") {
        return name.contains("left");
    }
    if let Some(ending) = name.strip_suffix(['l', 'r'])
        && ending.ends_with(['_', '.'])
    {
        return name.ends_with('l');
    }
    name.starts_with('l')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_the_usual_rigs_are_understood() {
        for (name, part) in [
            ("LeftUpLeg", Part::LeftLeg),
            ("RHipJoint", Part::Torso),
            ("RThumb", Part::RightHand),
            ("LeftToeBase", Part::LeftFoot),
            ("mixamorig:RightForeArm", Part::RightArm),
            ("thigh_r", Part::RightLeg),
            ("calf_l", Part::LeftLeg),
            ("L_Wrist", Part::LeftHand),
            ("lowerarm_r", Part::RightArm),
            ("right_elbow", Part::RightArm),
            ("right_leg", Part::RightLeg),
            ("upper_leg.R", Part::RightLeg),
            ("LeftShoulder", Part::Torso),
            ("Neck1", Part::Head),
        ] {
            assert_eq!(part_of_name(name), Some(part), "{name}");
        }
        assert_eq!(part_of_name("bone_17"), None);
    }
}

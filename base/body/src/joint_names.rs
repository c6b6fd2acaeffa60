//! Correspondence of the joints of another skeleton with those of ours, by the names of the usual rigs.

use crate::{BodyError, Skeleton};

/// Names of the joints of one side, lower case without separators and without the side's word, which stands before or behind: those of
/// CMU, Mixamo, SMPL, VRM, Unreal, 3ds Max, Blender, Poser, DAZ, Second Life, Xsens and BVH clips. Where two rigs give different joints one
/// name, the joint that stands first here takes it: SMPL's shoulder is an arm and its foot a toe.
const SIDED: [(&str, &[&str]); 8] = [
    ("UpLeg", &["upleg", "upperleg", "thigh", "thighbend", "femur", "hip"]),
    ("Leg", &["lowerleg", "lowleg", "knee", "calf", "shin", "tibia", "leg"]),
    ("Foot", &["ankle", "foot"]),
    ("ToeBase", &["toebase", "toes", "toe", "toe0", "ball", "foot"]),
    ("Arm", &["upperarm", "uparm", "uarm", "shldr", "shldrbend", "humerus", "arm", "shoulder"]),
    ("ForeArm", &["forearm", "forearmbend", "lowerarm", "lowarm", "farm", "radius", "elbow"]),
    ("Hand", &["wrist", "hand"]),
    ("Shoulder", &["collar", "collarbone", "clavicle", "shoulder"]),
];

/// Names of joints on the middle line, those of the hips first.
const HIPS: [&str; 4] = ["hips", "pelvis", "hip", "hipcenter"];
const NECK: [&str; 6] = ["neck", "neck01", "lowerneck", "necklower", "neckbase", "neck1"];
const UPPER_NECK: [&str; 5] = ["neck1", "neck02", "neck2", "upperneck", "neckupper"];

/// Prefixes of names that not all joints of a file need to have; digits after them are dropped.
const PREFIXES: [&str; 9] = ["mixamorig", "jbip", "valvebipedbip", "bip", "ccbase", "avatar", "def", "org", "joint"];

/// Part of a file's joints that share the first or last word of their names for it to be dropped.
const SHARED: f64 = 0.8;

/// Joints whose lack is worth a warning; without the others the body is followed well.
const WANTED: [&str; 6] = ["LeftArm", "LeftForeArm", "LeftHand", "RightArm", "RightForeArm", "RightHand"];

/// Names that a message lists.
const SHOWN: usize = 12;

/// Required joints, without which there is no scale and no gait.
const NEEDED: [&str; 6] = ["LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot"];

/// Joint of another skeleton.
pub(crate) struct Named<'a> {
    pub name: &'a str,
    pub parent: Option<usize>,
}

/// Returns for each joint of `skeleton` the index of the foreign joint that drives it; the roots correspond.
///
/// # Errors
/// [`BodyError::Skeleton`] lists missing joints of the legs.
pub(crate) fn match_joints(
    skeleton: &Skeleton,
    foreign: &[Named<'_>],
    what: &str,
) -> Result<Vec<Option<usize>>, BodyError> {
    let plain_names = plain_names(foreign);
    let mut source: Vec<Option<usize>> = vec![None; skeleton.joints().len()];
    let mut taken = vec![false; foreign.len()];
    // Equal names first, then the names of other rigs.
    for (index, joint) in skeleton.joints().iter().enumerate().skip(1) {
        let same =
            (0..foreign.len()).find(|&theirs| !taken[theirs] && plain_names[theirs] == words(&joint.name).concat());
        if let Some(theirs) = same {
            (source[index], taken[theirs]) = (Some(theirs), true);
        }
    }
    for (joint, names) in SIDED {
        for (side, words) in [("Left", ["left", "l"]), ("Right", ["right", "r"])] {
            let Some(index) = skeleton.joint(&format!("{side}{joint}")) else { continue };
            if joint == "Foot" {
                // A rig with ankles calls its toes feet.
                let ankle = find(&plain_names, &taken, &["ankle"], words);
                if let (Some(_), Some(toe)) = (ankle, skeleton.joint(&format!("{side}ToeBase"))) {
                    if source[toe].is_none() {
                        source[toe] = source[index];
                    }
                    source[index] = None;
                }
            }
            if source[index].is_none()
                && let Some(theirs) = find(&plain_names, &taken, names, words)
            {
                (source[index], taken[theirs]) = (Some(theirs), true);
            }
            // Where knees have a name of their own, the leg is the thigh.
            if joint == "Leg"
                && let Some(thigh) = skeleton.joint(&format!("{side}UpLeg"))
                && source[thigh].is_none()
                && let Some(knee) = find(&plain_names, &taken, names, words)
            {
                (source[thigh], source[index], taken[knee]) = (source[index], Some(knee), true);
            }
            // A rig that names only a shoulder means the upper arm.
            if joint == "Arm"
                && source[index].is_none()
                && let Some(shoulder) = skeleton.joint(&format!("{side}Shoulder"))
            {
                (source[index], source[shoulder]) = (source[shoulder], None);
            }
        }
    }
    // Some rigs have joints above the hips.
    let hips = HIPS.iter().find_map(|hips| plain_names.iter().position(|name| name == hips));
    let thighs = ["LeftUpLeg", "RightUpLeg"].map(|name| skeleton.joint(name).and_then(|joint| source[joint]));
    let hips = hips.or_else(|| common_parent(foreign, thighs[0]?, thighs[1]?)).unwrap_or(0);
    if let (Some(root), false) = (source.first_mut(), foreign.is_empty()) {
        *root = Some(hips);
    }
    match_spine(skeleton, foreign, &plain_names, hips, &mut source);
    let missing =
        |found: &dyn Fn(&str) -> bool| -> Vec<&str> { NEEDED.into_iter().filter(|name| !found(name)).collect() };
    let ours = missing(&|name| skeleton.joint(name).is_some());
    if !ours.is_empty() {
        return Err(BodyError::Skeleton(format!("the body has no joint '{}'", ours.join("', '"))));
    }
    let theirs = missing(&|name| skeleton.joint(name).is_some_and(|joint| source[joint].is_some()));
    if !theirs.is_empty() {
        return Err(BodyError::Skeleton(format!(
            "{what} has no joint '{}' (nor one with that joint's name in Mixamo, SMPL, VRM, Poser or Unreal rigs; its joints \
             are called {}); rename them",
            theirs.join("', '"),
            shown(&foreign.iter().map(|joint| joint.name).collect::<Vec<_>>(), 6)
        )));
    }
    match unmatched(skeleton, foreign, &source) {
        Some((true, which)) => tracing::warn!("{what}: {which}"),
        Some((false, which)) => tracing::info!("{what}: {which}"),
        None => {}
    }
    Ok(source)
}

/// Names in one line the joints of either side that have no counterpart and should have one, and returns whether a limb of ours, the
/// trunk or the head is among them.
fn unmatched(skeleton: &Skeleton, foreign: &[Named<'_>], source: &[Option<usize>]) -> Option<(bool, String)> {
    let is_matched = |name: &str| skeleton.joint(name).is_none_or(|joint| source[joint].is_some());
    let mut ours: Vec<&str> = WANTED.into_iter().filter(|name| !is_matched(name)).collect();
    if ["LowerBack", "Spine", "Spine1"].iter().all(|name| !is_matched(name)) {
        ours.push("Spine");
    }
    if !is_matched("Neck") && !is_matched("Head") {
        ours.push("Head");
    }
    // Fingers, face and tips lie below matched ends, helpers above matched joints.
    let mut is_known = vec![false; foreign.len()];
    for &joint in source.iter().flatten() {
        let mut next = Some(joint);
        while let Some(joint) = next.filter(|&joint| !is_known[joint]) {
            is_known[joint] = true;
            next = foreign[joint].parent;
        }
    }
    let ends = ["LeftHand", "RightHand", "Head", "LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase"];
    let ends: Vec<usize> = ends.iter().filter_map(|end| source[skeleton.joint(end)?]).collect();
    let is_below_end = |joint: usize| {
        let mut up = std::iter::successors(Some(joint), |&joint| foreign[joint].parent).take(foreign.len());
        up.any(|joint| ends.contains(&joint))
    };
    let rest = (0..foreign.len()).filter(|&joint| !is_known[joint] && !is_below_end(joint));
    let theirs: Vec<&str> = rest.map(|joint| foreign[joint].name).collect();
    let unknown = |names: &[&str]| format!("joints with unknown names: {}", shown(names, SHOWN));
    match (ours.is_empty(), theirs.is_empty()) {
        (true, true) => None,
        (true, false) => Some((false, unknown(&theirs))),
        (false, _) => {
            let unknown =
                if theirs.is_empty() { String::new() } else { format!("; {}; rename them", unknown(&theirs)) };
            Some((true, format!("no joints found for {}, which stay at rest{unknown}", ours.join(", "))))
        }
    }
}

/// Joins names, at most `limit` of them.
fn shown(names: &[&str], limit: usize) -> String {
    let more = if names.len() > limit { format!(" and {} more", names.len() - limit) } else { String::new() };
    let cut = |name: &&str| name.chars().take(100).collect::<String>().escape_debug().to_string();
    format!("{}{more}", names.iter().take(limit).map(cut).collect::<Vec<_>>().join(", "))
}

/// Returns the lowest joint above or at both.
fn common_parent(foreign: &[Named<'_>], a: usize, b: usize) -> Option<usize> {
    let up = |joint: usize| std::iter::successors(Some(joint), |&joint| foreign[joint].parent).take(foreign.len());
    let above: Vec<usize> = up(a).collect();
    up(b).find(|joint| above.contains(joint))
}

/// Returns the free foreign joint with the first of these names that occurs, with the side's word before or behind it.
fn find(plain_names: &[String], taken: &[bool], names: &[&str], side: [&str; 2]) -> Option<usize> {
    let called = |name: &&str| {
        side.iter().find_map(|word| {
            let wanted = [format!("{word}{name}"), format!("{name}{word}")];
            (0..plain_names.len()).find(|&joint| !taken[joint] && wanted.contains(&plain_names[joint]))
        })
    };
    names.iter().find_map(called)
}

/// Distributes the joints between hips and neck over our spine where their names differ from ours.
fn match_spine(
    skeleton: &Skeleton,
    foreign: &[Named<'_>],
    plain_names: &[String],
    hips: usize,
    source: &mut [Option<usize>],
) {
    let ours: Vec<usize> = ["LowerBack", "Spine", "Spine1"].iter().filter_map(|name| skeleton.joint(name)).collect();
    // Ours are Neck and Neck1; a file's "neck1" may be either.
    let is_numbered = !plain_names.iter().any(|name| name == "neck");
    if is_numbered && let Some(upper) = skeleton.joint("Neck1") {
        source[upper] = None;
    }
    for (ours, names) in [("Neck", NECK.as_slice()), ("Neck1", &UPPER_NECK)] {
        let Some(joint) = skeleton.joint(ours) else { continue };
        let free = |theirs: &usize| !source.contains(&Some(*theirs));
        let called = |name: &&str| plain_names.iter().position(|plain| plain == name).filter(free);
        source[joint] = source[joint].or_else(|| names.iter().find_map(called));
    }
    let neck = skeleton.joint("Neck").and_then(|joint| source[joint]);
    let arms = ["LeftArm", "RightArm"].map(|name| skeleton.joint(name).and_then(|joint| source[joint]));
    let top = neck.or_else(|| source[skeleton.joint("Head")?]).and_then(|joint| foreign[joint].parent);
    let top = top.or_else(|| common_parent(foreign, arms[0]?, arms[1]?));
    let Some(top) = top.filter(|_| !ours.iter().all(|&joint| source[joint].is_some())) else { return };
    let mut chain: Vec<usize> = std::iter::successors(Some(top), |&joint| foreign[joint].parent)
        .take(foreign.len())
        .take_while(|&joint| joint != hips && joint != 0)
        .collect();
    chain.reverse();
    if chain.is_empty() {
        return;
    }
    let count = ours.len();
    for (place, joint) in ours.into_iter().enumerate() {
        let upto = ((place + 1) * chain.len()).div_ceil(count);
        source[joint] = upto.checked_sub(1).and_then(|index| chain.get(index)).copied();
    }
}

/// Normalises names: "mixamorig:Left_Arm" -> "leftarm", "J_Bip_L_UpperLeg" -> "lupperleg", "Bip01 L Thigh" -> "lthigh". Words that most joints
/// share at the front or the back are dropped.
fn plain_names(foreign: &[Named<'_>]) -> Vec<String> {
    let mut names: Vec<Vec<String>> = foreign.iter().map(|joint| words(joint.name)).collect();
    for at_end in [false, true] {
        let word = |words: &Vec<String>| match (words.len() > 1, at_end) {
            (false, _) => None,
            (true, false) => words.first().cloned(),
            (true, true) => words.last().cloned(),
        };
        loop {
            let mut counts = std::collections::BTreeMap::new();
            names.iter().filter_map(word).for_each(|word| *counts.entry(word).or_insert(0usize) += 1);
            let Some((shared, _)) = counts.into_iter().find(|(_, count)| *count as f64 > SHARED * names.len() as f64)
            else {
                break;
            };
            for words in names.iter_mut().filter(|words| word(words).as_ref() == Some(&shared)) {
                words.remove(if at_end { words.len() - 1 } else { 0 });
            }
        }
    }
    names.into_iter().map(|words| plain(&words.concat())).collect()
}

/// Splits a name into its words, lower case, without a namespace.
fn words(name: &str) -> Vec<String> {
    let name = name.rsplit([':', '|']).next().unwrap_or(name);
    // Second Life: "mHipLeft".
    let plain = |word: &str| {
        word.strip_prefix('m').filter(|rest| rest.starts_with(char::is_uppercase)).unwrap_or(word).to_lowercase()
    };
    name.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()).map(plain).collect()
}

fn plain(name: &str) -> String {
    let mut name = name;
    for prefix in PREFIXES {
        let rest = name.strip_prefix(prefix).map(|rest| rest.trim_start_matches(|c: char| c.is_ascii_digit()));
        name = rest.filter(|rest| !rest.is_empty()).unwrap_or(name);
    }
    name.strip_prefix('c').filter(|rest| matches!(*rest, "hips" | "spine" | "neck" | "head")).unwrap_or(name).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ShapeParams, default_template};

    fn matched(names: &[(&'static str, Option<usize>)]) -> Result<Vec<(String, &'static str)>, BodyError> {
        let skeleton = default_template(&ShapeParams::default()).unwrap().skeleton;
        let foreign: Vec<Named<'_>> = names.iter().map(|&(name, parent)| Named { name, parent }).collect();
        let source = match_joints(&skeleton, &foreign, "clip")?;
        let pair = |(joint, theirs): (&crate::Joint, Option<usize>)| Some((joint.name.clone(), names[theirs?].0));
        Ok(skeleton.joints().iter().zip(source).filter_map(pair).collect())
    }

    fn rig(names: [&'static str; 12]) -> Vec<(String, &'static str)> {
        let [hips, spine, neck, legs @ ..] = names;
        let mut joints = vec![(hips, None), (spine, Some(0)), (neck, Some(1))];
        joints.extend(legs.map(|name| (name, Some(0))));
        matched(&joints).unwrap()
    }

    #[test]
    fn the_usual_rigs_are_understood() {
        let wanted = ["LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "LeftShoulder", "LeftArm", "LeftForeArm"];
        for (prefix, names) in [
            (
                "mixamorig:",
                ["LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "LeftShoulder", "LeftArm", "LeftForeArm"],
            ),
            ("", ["L_Hip", "L_Knee", "L_Ankle", "L_Foot", "L_Collar", "L_Shoulder", "L_Elbow"]),
            ("", ["left_hip", "left_knee", "left_ankle", "left_foot", "left_collar", "left_shoulder", "left_elbow"]),
            ("J_Bip_", ["L_UpperLeg", "L_LowerLeg", "L_Foot", "L_ToeBase", "L_Shoulder", "L_UpperArm", "L_LowerArm"]),
            ("", ["thigh_l", "calf_l", "foot_l", "ball_l", "clavicle_l", "upperarm_l", "lowerarm_l"]),
            ("", ["upper_leg.L", "lower_leg.L", "foot.L", "toe.L", "shoulder.L", "upper_arm.L", "forearm.L"]),
            ("DEF-", ["thigh.L", "shin.L", "foot.L", "toe.L", "shoulder.L", "upper_arm.L", "forearm.L"]),
            ("Bip01 ", ["L Thigh", "L Calf", "L Foot", "L Toe0", "L Clavicle", "L UpperArm", "L Forearm"]),
            ("ValveBiped.Bip01_", ["L_Thigh", "L_Calf", "L_Foot", "L_Toe0", "L_Clavicle", "L_UpperArm", "L_Forearm"]),
            ("CC_Base_", ["L_Thigh", "L_Calf", "L_Foot", "L_ToeBase", "L_Clavicle", "L_Upperarm", "L_Forearm"]),
            (
                "Character1_",
                ["LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "LeftShoulder", "LeftArm", "LeftForeArm"],
            ),
            (
                "mixamorig7:",
                ["LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "LeftShoulder", "LeftArm", "LeftForeArm"],
            ),
            ("m_avg_", ["L_Hip", "L_Knee", "L_Ankle", "L_Foot", "L_Collar", "L_Shoulder", "L_Elbow"]),
            ("", ["lThigh", "lShin", "lFoot", "lToe", "lCollar", "lShldr", "lForeArm"]),
            ("", ["lThighBend", "lShin", "lFoot", "lToe", "lCollar", "lShldrBend", "lForearmBend"]),
            ("m", ["HipLeft", "KneeLeft", "AnkleLeft", "FootLeft", "CollarLeft", "ShoulderLeft", "ElbowLeft"]),
            ("avatar_m", ["HipLeft", "KneeLeft", "AnkleLeft", "FootLeft", "CollarLeft", "ShoulderLeft", "ElbowLeft"]),
            ("avatar_", ["lThigh", "lShin", "lFoot", "lToe", "lCollar", "lShldr", "lForeArm"]),
            ("", ["lfemur", "ltibia", "lfoot", "ltoes", "lclavicle", "lhumerus", "lradius"]),
            ("", ["LeftHip", "LeftKnee", "LeftAnkle", "LeftToe", "LeftCollar", "LeftShoulder", "LeftElbow"]),
            ("", ["LeftThigh", "LeftShin", "LeftFoot", "LeftToe", "LeftShoulder", "LeftArm", "LeftForeArm"]),
            ("", ["LThigh", "LShin", "LFoot", "LToe", "LCollar", "LUArm", "LFArm"]),
            ("", ["UpperLeg_L", "LowerLeg_L", "Foot_L", "Toes_L", "Shoulder_L", "UpperArm_L", "LowerArm_L"]),
            ("", ["Left leg", "Left knee", "Left ankle", "Left toe", "Left shoulder", "Left arm", "Left elbow"]),
            (
                "rig:body|",
                ["LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "LeftShoulder", "LeftArm", "LeftForeArm"],
            ),
        ] {
            let mirrored = |name: &str| {
                let swap =
                    [("Left", "Right"), ("left", "right"), ("L_", "R_"), ("L ", "R "), ("_l", "_r"), (".L", ".R")];
                let swap = swap.into_iter().chain([("_L", "_R"), ("Left", "Right"), ("L", "R"), ("l", "r")]);
                let found = swap.into_iter().find(|(left, _)| match *left {
                    "_l" | "_L" | ".L" => name.ends_with(left),
                    "Left" => name.contains(left),
                    _ => name.starts_with(left),
                });
                found.map_or_else(|| name.to_owned(), |(left, right)| name.replacen(left, right, 1))
            };
            let mut joints: Vec<(&'static str, Option<usize>)> = vec![("root", None)];
            for name in names.iter().map(|n| (*n).to_owned()).chain(names.iter().map(|n| mirrored(n))) {
                joints.push((Box::leak(format!("{prefix}{name}").into_boxed_str()), Some(0)));
            }
            let found = matched(&joints).unwrap();
            for (ours, theirs) in wanted.iter().zip(names) {
                let pair = ((*ours).to_owned(), format!("{prefix}{theirs}"));
                assert!(found.iter().any(|(a, b)| *a == pair.0 && **b == pair.1), "{pair:?} in {found:?}");
            }
            assert_eq!(found.len(), 15, "{found:?}");
        }
    }

    #[test]
    fn a_spine_of_other_names_is_spread_over_ours() {
        let found = rig([
            "pelvis", "spine_01", "neck_01", "thigh_l", "calf_l", "foot_l", "thigh_r", "calf_r", "foot_r", "a", "b",
            "c",
        ]);
        for ours in ["LowerBack", "Spine", "Spine1"] {
            assert!(found.contains(&(ours.to_owned(), "spine_01")), "{found:?}");
        }
        assert!(found.contains(&("Neck".to_owned(), "neck_01")));
    }

    /// Returns which joints of a rig with these names of hips, trunk, arms and legs are not matched.
    fn unmatched_of(arm: [&'static str; 3], more: &[(&'static str, usize)]) -> Option<(bool, String)> {
        let skeleton = default_template(&ShapeParams::default()).unwrap().skeleton;
        let mut joints = vec![("Hips", None), ("Spine", Some(0)), ("Neck", Some(1)), ("RightArm", Some(1))];
        joints.extend([("RightForeArm", Some(3)), ("RightHand", Some(4)), (arm[0], Some(1)), (arm[1], Some(6))]);
        joints.extend([(arm[2], Some(7)), ("LeftUpLeg", Some(0)), ("LeftLeg", Some(9)), ("LeftFoot", Some(10))]);
        joints.extend([("RightUpLeg", Some(0)), ("RightLeg", Some(12)), ("RightFoot", Some(13))]);
        joints.extend(more.iter().map(|&(name, parent)| (name, Some(parent))));
        let foreign: Vec<Named<'_>> = joints.iter().map(|&(name, parent)| Named { name, parent }).collect();
        unmatched(&skeleton, &foreign, &match_joints(&skeleton, &foreign, "clip").unwrap())
    }

    #[test]
    fn joints_without_a_counterpart_are_named() {
        let usual = ["LeftArm", "LeftForeArm", "LeftHand"];
        // Fingers and toes are expected.
        assert_eq!(unmatched_of(usual, &[("LeftHandThumb1", 8), ("Toe_End", 11)]), None);
        assert_eq!(unmatched_of(usual, &[("Tail", 0)]), Some((false, "joints with unknown names: Tail".to_owned())));
        let (is_limb, which) = unmatched_of(["limb5", "limb6", "limb7"], &[]).unwrap();
        assert!(is_limb);
        assert_eq!(
            which,
            "no joints found for LeftArm, LeftForeArm, LeftHand, which stay at rest; joints with unknown names: limb5, limb6, \
             limb7; rename them"
        );
        // A forearm without an upper arm.
        let (_, which) = unmatched_of(["xShldr", "LeftForeArm", "LeftHand"], &[]).unwrap();
        assert!(which.starts_with("no joints found for LeftArm, which"), "{which}");
    }

    #[test]
    fn unknown_names_are_listed() {
        let error = matched(&[("bone0", None), ("LeftUpLeg", Some(0)), ("bone2", Some(1))]).unwrap_err().to_string();
        for word in ["'LeftLeg', 'LeftFoot', 'RightUpLeg', 'RightLeg', 'RightFoot'", "bone2", "clip"] {
            assert!(error.contains(word), "{error}");
        }
    }
}

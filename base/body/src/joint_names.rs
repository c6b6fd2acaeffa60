//! Correspondence of the joints of another skeleton with those of ours, by the names of the usual rigs.

use crate::{BodyError, Skeleton};

/// Names of the joints of one side, lower case without separators, with `?` for the side's word: those of CMU, Mixamo, SMPL, VRM,
/// Unreal, Blender and BVH clips. Where two rigs give different joints one name, the joint that stands first here takes it:
/// SMPL's shoulder is an arm and its foot a toe.
const SIDED: [(&str, &[&str]); 8] = [
    ("UpLeg", &["?upleg", "?upperleg", "upperleg?", "?thigh", "thigh?", "?hip"]),
    ("Leg", &["?lowerleg", "lowerleg?", "?knee", "?calf", "calf?", "?shin", "shin?", "?leg"]),
    ("Foot", &["?ankle", "?foot", "foot?"]),
    ("ToeBase", &["?toebase", "?toes", "toes?", "?toe", "toe?", "ball?", "?ball", "?foot"]),
    ("Arm", &["?upperarm", "upperarm?", "?arm", "?shoulder"]),
    ("ForeArm", &["?forearm", "forearm?", "?lowerarm", "lowerarm?", "?elbow"]),
    ("Hand", &["?wrist", "?hand", "hand?"]),
    ("Shoulder", &["?collar", "?clavicle", "clavicle?", "?shoulder", "shoulder?"]),
];

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
    let plain_names: Vec<String> = foreign.iter().map(|joint| plain(joint.name)).collect();
    let mut source: Vec<Option<usize>> = vec![None; skeleton.joints().len()];
    // Some rigs have a joint above the hips.
    let hips = plain_names.iter().position(|name| name == "hips" || name == "pelvis").unwrap_or(0);
    if let (Some(root), false) = (source.first_mut(), foreign.is_empty()) {
        *root = Some(hips);
    }
    let mut taken = vec![false; foreign.len()];
    // Equal names first, then the names of other rigs.
    for (index, joint) in skeleton.joints().iter().enumerate().skip(1) {
        let same = (0..foreign.len()).find(|&theirs| !taken[theirs] && plain_names[theirs] == plain(&joint.name));
        if let Some(theirs) = same {
            (source[index], taken[theirs]) = (Some(theirs), true);
        }
    }
    for (joint, names) in SIDED {
        for (side, words) in [("Left", ["left", "l"]), ("Right", ["right", "r"])] {
            let Some(index) = skeleton.joint(&format!("{side}{joint}")) else { continue };
            if joint == "Foot" {
                // A rig with ankles calls its toes feet.
                let ankle = find(&plain_names, &taken, &["?ankle"], words);
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
            // A rig that names only a shoulder means the upper arm.
            if joint == "Arm"
                && source[index].is_none()
                && let Some(shoulder) = skeleton.joint(&format!("{side}Shoulder"))
            {
                (source[index], source[shoulder]) = (source[shoulder], None);
            }
        }
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
        let some: Vec<&str> = foreign.iter().take(6).map(|joint| joint.name).collect();
        return Err(BodyError::Skeleton(format!(
            "{what} has no joint '{}' (nor one with that joint's name in Mixamo, SMPL, VRM or Unreal rigs; its joints \
             are called {}, ...); rename them",
            theirs.join("', '"),
            some.join(", ")
        )));
    }
    Ok(source)
}

/// Returns the free foreign joint with the first of these names that occurs.
fn find(plain_names: &[String], taken: &[bool], names: &[&str], side: [&str; 2]) -> Option<usize> {
    let called = |name: &&str| {
        side.iter().find_map(|word| {
            let wanted = name.replace('?', word);
            (0..plain_names.len()).find(|&joint| !taken[joint] && plain_names[joint] == wanted)
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
    let neck = plain_names.iter().position(|name| name == "neck" || name == "neck01");
    if let (Some(our_neck), Some(neck)) = (skeleton.joint("Neck"), neck) {
        source[our_neck] = source[our_neck].or(Some(neck));
    }
    let Some(neck) = neck.filter(|_| !ours.iter().all(|&joint| source[joint].is_some())) else { return };
    let mut chain: Vec<usize> = std::iter::successors(foreign[neck].parent, |&joint| foreign[joint].parent)
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

/// Normalises a name: "mixamorig:Left_Arm" -> "leftarm", "J_Bip_L_UpperLeg" -> "lupperleg".
fn plain(name: &str) -> String {
    let name: String =
        name.rsplit(':').next().unwrap_or(name).to_lowercase().chars().filter(char::is_ascii_alphanumeric).collect();
    let name = name.strip_prefix("mixamorig").unwrap_or(&name);
    let name = name.strip_prefix("jbip").unwrap_or(name);
    let name = name.strip_prefix("bip001").or_else(|| name.strip_prefix("bip01")).unwrap_or(name);
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
        ] {
            let mirrored = |name: &str| {
                let swap = [("Left", "Right"), ("left", "right"), ("L_", "R_"), ("_l", "_r"), (".L", ".R")];
                let found = swap.iter().find(|(left, _)| match *left {
                    "_l" | ".L" => name.ends_with(left),
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

    #[test]
    fn unknown_names_are_listed() {
        let error = matched(&[("bone0", None), ("LeftUpLeg", Some(0)), ("bone2", Some(1))]).unwrap_err().to_string();
        for word in ["'LeftLeg', 'LeftFoot', 'RightUpLeg', 'RightLeg', 'RightFoot'", "bone2", "clip"] {
            assert!(error.contains(word), "{error}");
        }
    }
}

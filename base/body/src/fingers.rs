//! Finger joints, found by name in any skeleton and added to the built-in body.

use std::io::Read;
use std::sync::OnceLock;

use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;

use crate::body_asset::body_asset;
use crate::part::is_left;
use crate::{BodyError, Joint, Skeleton, SkinWeights, Template};

static FILE: &[u8] = include_bytes!("../assets/fingers.json.gz");

/// Words in the joint names of each finger, thumb first.
const FINGER_WORDS: [&[&str]; 5] = [&["thumb"], &["index"], &["middle"], &["ring"], &["pinky", "little"]];

/// Joint indices of the fingers of both hands: left, right; thumb to little finger; from the palm to the tip.
pub type FingerJoints = [[[usize; 3]; 5]; 2];

/// Finds three joints of each finger by their names: "LeftHandIndex1" (Mixamo), "leftIndexProximal" (VRM), "index_01_l"
/// (Unreal) and the like. `None` unless both hands have five such fingers. Metacarpal joints do not count, except the
/// thumb's.
#[must_use]
pub fn find_fingers(skeleton: &Skeleton) -> Option<FingerJoints> {
    let mut chains: [[Vec<usize>; 5]; 2] = Default::default();
    for (index, joint) in skeleton.joints().iter().enumerate() {
        let name = joint.name.rsplit(':').next().unwrap_or_default().to_lowercase();
        let name = name.strip_prefix("j_bip_").unwrap_or(&name);
        let Some(finger) = FINGER_WORDS.iter().position(|words| words.iter().any(|word| name.contains(word))) else {
            continue;
        };
        if finger > 0 && name.contains("metacarpal") {
            continue;
        }
        let chain = &mut chains[usize::from(!is_left(name))][finger];
        // Parents come before their children; a joint outside the chain is a helper.
        let below = |ancestor: usize| {
            std::iter::successors(joint.parent, |&p| skeleton.joints()[p].parent).any(|p| p == ancestor)
        };
        if chain.last().is_none_or(|&last| below(last)) {
            chain.push(index);
        }
    }
    let mut found: FingerJoints = Default::default();
    for (side, chains) in chains.iter().enumerate() {
        for (finger, chain) in chains.iter().enumerate() {
            found[side][finger] = *chain.first_chunk()?;
        }
    }
    Some(found)
}

impl Template {
    /// Returns the template with three joints in each finger: a copy where it has them, the built-in body (in any shape) with
    /// the joints of [`find_fingers`] appended to its own.
    ///
    /// The added joints share the weights of the joints that move a whole hand, so a pose without rotations for them puts
    /// every vertex where the template without fingers has it.
    ///
    /// # Errors
    /// [`BodyError::Skeleton`] for another body without finger joints, [`BodyError::Asset`].
    pub fn with_fingers(&self) -> Result<Self, BodyError> {
        if find_fingers(&self.skeleton).is_some() {
            return Ok(self.clone());
        }
        let fingers = finger_asset()?;
        let asset = body_asset()?;
        if !self.is_built_in() || self.skeleton.joints().len() != asset.joints.len() {
            return Err(BodyError::Skeleton(format!(
                "template '{}' has no finger joints; name three joints a finger after thumb, index, middle, ring and \
                 pinky, or turn hands off",
                self.name
            )));
        }
        let mut place = vec![DVec3::ZERO; asset.body_vertices];
        for (&vertex, position) in asset.corner_vertex.iter().zip(&self.positions) {
            place[usize::from(vertex)] = position.as_dvec3();
        }
        let mut joints: Vec<Joint> = self.skeleton.joints().to_vec();
        for added in &fingers.joints {
            let parent = joints.iter().position(|joint| joint.name == added.parent).ok_or_else(|| {
                BodyError::Skeleton(format!("the finger joint '{}' has no parent '{}'", added.name, added.parent))
            })?;
            let origin: DVec3 = added.vertices.iter().zip(&added.shares).map(|(&v, &share)| place[v] * share).sum();
            let rest_translation = joints[parent].joint_from_canonical.transform_point3(origin);
            joints.push(Joint {
                name: added.name.clone(),
                parent: Some(parent),
                rest_translation,
                rest_rotation: DQuat::IDENTITY,
                joint_from_canonical: DMat4::from_translation(-rest_translation) * joints[parent].joint_from_canonical,
            });
        }
        let mut new_skin: Vec<Option<SkinWeights>> = vec![None; asset.body_vertices];
        for (&vertex, pairs) in fingers.vertices.iter().zip(&fingers.skin) {
            let mut skin = SkinWeights::default();
            for (slot, &(joint, weight)) in pairs.iter().enumerate() {
                (skin.joints[slot], skin.weights[slot]) = (joint, f32::from(weight) / f32::from(u16::MAX));
            }
            new_skin[vertex] = Some(skin);
        }
        let skin = asset.corner_vertex.iter().zip(&self.skin).map(|(&v, own)| new_skin[usize::from(v)].unwrap_or(*own));
        Ok(Self { skin: skin.collect(), skeleton: Skeleton::new(joints)?, ..self.clone() })
    }
}

/// Content of the file that `assets/make_fingers.py` writes.
#[derive(Debug, Deserialize)]
struct FingerAsset {
    joints: Vec<AddedJoint>,
    /// Body vertices with new skin weights.
    vertices: Vec<usize>,
    /// Joints and weights of each vertex; the weights add up to 65535.
    skin: Vec<Vec<(u16, u16)>>,
}

#[derive(Debug, Deserialize)]
struct AddedJoint {
    name: String,
    parent: String,
    /// Body vertices whose mean with the weights `shares` is the joint's origin.
    vertices: Vec<usize>,
    shares: Vec<f64>,
}

fn finger_asset() -> Result<&'static FingerAsset, BodyError> {
    static ASSET: OnceLock<Result<FingerAsset, String>> = OnceLock::new();
    ASSET.get_or_init(|| unpack(FILE)).as_ref().map_err(|message| BodyError::Asset(message.clone()))
}

fn unpack(file: &[u8]) -> Result<FingerAsset, String> {
    let mut text = String::new();
    flate2::read::GzDecoder::new(file).read_to_string(&mut text).map_err(|error| error.to_string())?;
    let asset: FingerAsset = serde_json::from_str(&text).map_err(|error| error.to_string())?;
    let body = body_asset().map_err(|error| error.to_string())?;
    let joints = body.joints.len() + asset.joints.len();
    let ok = asset.vertices.len() == asset.skin.len()
        && asset.vertices.iter().all(|&v| v < body.body_vertices)
        && asset.skin.iter().all(|pairs| pairs.len() <= 4 && pairs.iter().all(|&(j, _)| usize::from(j) < joints))
        && asset.joints.iter().all(|joint| {
            joint.vertices.len() == joint.shares.len() && joint.vertices.iter().all(|&v| v < body.body_vertices)
        });
    if ok { Ok(asset) } else { Err("the finger joints: an index out of range".to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ShapeParams, default_template, skin_mesh};
    use flyrig_types::Pose;

    fn bodies() -> [Template; 2] {
        let tall = ShapeParams::default().with("height", 0.9).with("gender", 1.0);
        [ShapeParams::default(), tall].map(|shape| default_template(&shape).unwrap())
    }

    #[test]
    fn a_pose_without_fingers_puts_every_vertex_where_it_was() {
        for body in bodies() {
            let with = body.with_fingers().unwrap();
            with.check().unwrap();
            assert_eq!(with.skeleton.joints().len(), body.skeleton.joints().len() + 28);
            assert_eq!(with.skeleton.joints()[..31], *body.skeleton.joints());
            let mut pose = body.skeleton.rest_pose();
            for (k, rotation) in pose.joint_rotations.iter_mut().enumerate() {
                *rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.2 * (k as f64).sin(), 0.3 * (k as f64).cos(), 0.1);
            }
            let (before, _) = skin_mesh(&body, &pose);
            let extended = Pose {
                joint_rotations: pose.joint_rotations.iter().copied().chain([DQuat::IDENTITY; 28]).collect(),
                ..pose.clone()
            };
            for pose in [pose, extended] {
                let (after, _) = skin_mesh(&with, &pose);
                let moved = before.iter().zip(&after).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
                assert!(moved < 2e-6, "moved by {moved} m");
            }
        }
    }

    #[test]
    fn finger_joints_lie_inside_of_the_fingers_in_every_shape() {
        for body in bodies() {
            let with = body.with_fingers().unwrap();
            let fingers = find_fingers(&with.skeleton).unwrap();
            let origins = with.skeleton.canonical_origins();
            for (side, sign) in [(0, 1.0), (1, -1.0)] {
                for chain in fingers[side] {
                    let [a, b, c] = chain.map(|joint| origins[joint]);
                    assert!(a.x * sign > 0.2, "{a} on side {side}");
                    let (first, second) = (a.distance(b), b.distance(c));
                    // The longest is the thumb's second segment of the tall body.
                    assert!((0.015..0.07).contains(&first) && (0.008..0.06).contains(&second), "{first} {second}");
                    // Joints of a finger at rest are nearly on a line.
                    assert!((b - a).normalize().dot((c - b).normalize()) > 0.8);
                    let near = with.positions.iter().map(|p| p.as_dvec3().distance(b)).fold(f64::INFINITY, f64::min);
                    assert!((0.003..0.02).contains(&near), "the skin is {near} m from a knuckle");
                }
            }
        }
    }

    #[test]
    fn a_bent_finger_moves_its_own_tip_alone() {
        let with = bodies()[0].with_fingers().unwrap();
        let fingers = find_fingers(&with.skeleton).unwrap();
        let rest = with.skeleton.rest_pose();
        let mut bent = rest.clone();
        bent.joint_rotations[fingers[0][1][0]] = DQuat::from_rotation_z(-0.8);
        let (before, _) = skin_mesh(&with, &rest);
        let (after, _) = skin_mesh(&with, &bent);
        let moved = |joint: usize| {
            let own = with.skin.iter().enumerate().filter(|(_, skin)| usize::from(skin.joints[0]) == joint);
            own.map(|(v, _)| before[v].distance(after[v])).fold(0.0, f32::max)
        };
        assert!(moved(fingers[0][1][2]) > 0.02);
        assert!(moved(fingers[0][3][2]) < 1e-6 && moved(fingers[1][1][2]) < 1e-6);
    }

    #[test]
    fn fingers_of_other_rigs_are_found_by_name() {
        let rig = |names: &dyn Fn(&str, usize, usize) -> String, ks: std::ops::Range<usize>| {
            let joint = |name: String, parent| Joint {
                name,
                parent,
                rest_translation: DVec3::ZERO,
                rest_rotation: DQuat::IDENTITY,
                joint_from_canonical: DMat4::IDENTITY,
            };
            let mut joints = vec![joint("Hips".to_owned(), None)];
            for side in ["left", "right"] {
                for finger in 0..5 {
                    let first = joints.len();
                    for k in ks.clone() {
                        let parent = if k == ks.start { 0 } else { first + k - ks.start - 1 };
                        joints.push(joint(names(side, finger, k), Some(parent)));
                    }
                }
            }
            find_fingers(&Skeleton::new(joints).unwrap())
        };
        let words = ["Thumb", "Index", "Middle", "Ring", "Pinky"];
        let mixamo = |side: &str, finger: usize, k: usize| {
            let side = if side == "left" { "Left" } else { "Right" };
            format!("mixamorig:{side}Hand{}{k}", words[finger])
        };
        let unreal = |side: &str, finger: usize, k: usize| {
            let name = if k == 0 { "metacarpal".to_owned() } else { format!("0{k}") };
            format!("{}_{name}_{}", words[finger].to_lowercase(), &side[..1])
        };
        let vroid = |side: &str, finger: usize, k: usize| {
            let word = if finger == 4 { "Little" } else { words[finger] };
            format!("J_Bip_{}_{word}{k}", side[..1].to_uppercase())
        };
        let found = rig(&mixamo, 1..5).unwrap();
        assert_eq!((found[0][0], found[1][4]), ([1, 2, 3], [37, 38, 39]));
        let found = rig(&unreal, 0..4).unwrap();
        assert_eq!((found[0][0], found[0][1], found[1][4]), ([1, 2, 3], [6, 7, 8], [38, 39, 40]));
        assert_eq!(rig(&vroid, 1..4).unwrap()[1][4], [28, 29, 30]);
        assert_eq!(rig(&mixamo, 1..3), None);
        assert_eq!(find_fingers(&bodies()[0].skeleton), None);
    }

    #[test]
    fn another_body_without_fingers_is_refused_and_a_damaged_file_too() {
        let mut body = bodies()[0].clone();
        body.name = "statue".to_owned();
        let error = body.with_fingers().unwrap_err().to_string();
        assert!(error.contains("statue") && error.contains("hands off"), "{error}");
        assert!(unpack(&FILE[..FILE.len() / 2]).is_err());
        assert!(unpack(b"").is_err());
    }
}

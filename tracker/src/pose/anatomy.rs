//! Joints of a skeleton by their role in the human body, found by name, and the ranges in which they turn.

use flyrig_body::Skeleton;
use glam::{DMat3, DVec3};

use crate::error::{TrackError, TrackErrorKind};

/// Joints by role; pairs are left, right.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Roles {
    pub hips: usize,
    pub head: usize,
    pub clavicle: [Option<usize>; 2],
    pub upper_arm: [usize; 2],
    pub forearm: [usize; 2],
    pub hand: [usize; 2],
    pub thigh: [usize; 2],
    pub shank: [usize; 2],
    pub foot: [usize; 2],
}

/// Accepted names in lower case without separators and namespace; `*` stands for left/l, right/r.
const HIPS: &[&str] = &["hips", "pelvis", "root"];
const HEAD: &[&str] = &["head"];
const CLAVICLE: &[&str] = &["*shoulder", "*collar", "*clavicle", "clavicle*"];
const UPPER_ARM: &[&str] = &["*arm", "*upperarm", "upperarm*", "*uparm"];
const FOREARM: &[&str] = &["*forearm", "*lowerarm", "lowerarm*", "*elbow"];
const HAND: &[&str] = &["*hand", "hand*", "*wrist"];
const THIGH: &[&str] = &["*upleg", "*upperleg", "*thigh", "thigh*", "*hip"];
const SHANK: &[&str] = &["*leg", "*lowerleg", "*shin", "*calf", "calf*", "*knee"];
const FOOT: &[&str] = &["*foot", "foot*", "*ankle"];

impl Roles {
    /// Finds the joints by their names.
    ///
    /// # Errors
    /// Kind `Template` names the missing joint and accepted names.
    pub fn find(skeleton: &Skeleton, template: &str) -> Result<Self, TrackError> {
        let names: Vec<String> = skeleton
            .joints()
            .iter()
            .map(|joint| {
                let name = joint.name.rsplit(':').next().unwrap_or_default();
                name.chars().filter(char::is_ascii_alphanumeric).collect::<String>().to_ascii_lowercase()
            })
            .collect();
        let find = |patterns: &[&str], sides: &[&str]| {
            patterns.iter().find_map(|pattern| {
                sides.iter().find_map(|side| names.iter().position(|name| *name == pattern.replace('*', side)))
            })
        };
        const SIDES: [[&str; 2]; 2] = [["left", "l"], ["right", "r"]];
        let need = |what: &str, patterns: &[&str], sides: &[&str]| {
            find(patterns, sides).ok_or_else(|| {
                TrackError::new(
                    TrackErrorKind::Template,
                    format!("template '{template}' has no joint for the {what}; rename it to one of {patterns:?}"),
                )
            })
        };
        let both = |what: &str, patterns: &[&str]| -> Result<[usize; 2], TrackError> {
            Ok([
                need(&format!("left {what}"), patterns, &SIDES[0])?,
                need(&format!("right {what}"), patterns, &SIDES[1])?,
            ])
        };
        let forearm = both("forearm", FOREARM)?;
        let upper_arm = both("upper arm", UPPER_ARM).or_else(|error| {
            // Some skeletons call the upper arm's joint "shoulder" and the clavicle "collar".
            let parents = forearm.map(|joint| skeleton.joints()[joint].parent);
            if let [Some(left), Some(right)] = parents { Ok([left, right]) } else { Err(error) }
        })?;
        let clavicle = SIDES.map(|sides| find(CLAVICLE, &sides));
        let clavicle = [0, 1].map(|side| clavicle[side].filter(|joint| *joint != upper_arm[side]));
        Ok(Self {
            hips: need("hips", HIPS, &[""])?,
            head: need("head", HEAD, &[""])?,
            clavicle,
            upper_arm,
            forearm,
            hand: both("hand", HAND)?,
            thigh: both("thigh", THIGH)?,
            shank: both("shank", SHANK)?,
            foot: both("foot", FOOT)?,
        })
    }
}

/// Range of a joint's rotation away from the bind pose: limits and standard deviations of the components of its rotation
/// vector.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct JointRange {
    /// Columns: flexion axis, twist axis, third axis; canonical axes.
    pub axes: DMat3,
    /// Smallest comfortable component, radians.
    pub low: DVec3,
    /// Largest comfortable component, radians.
    pub high: DVec3,
    /// Standard deviation of each component, radians.
    pub sigma: DVec3,
}

/// Returns the ranges of all joints; `None` for joints that do not turn (fingers, joints without a role in the pose).
pub(crate) fn joint_ranges(skeleton: &Skeleton, roles: &Roles, origins: &[DVec3]) -> Vec<Option<JointRange>> {
    let mut ranges: Vec<Option<JointRange>> = vec![None; origins.len()];
    let symmetric = |axes, limit: [f64; 3], sigma: [f64; 3]| {
        Some(JointRange { axes, low: -DVec3::from(limit), high: DVec3::from(limit), sigma: DVec3::from(sigma) })
    };
    // Trunk and neck: every joint between the hips and the head or an arm.
    let upright = DMat3::IDENTITY; // flexion about x, twist about y, side bend about z
    let chain = |mut joint: usize| {
        let mut joints = Vec::new();
        while let Some(parent) = skeleton.joints()[joint].parent {
            joint = parent;
            joints.push(joint);
        }
        joints
    };
    let above_arm: Vec<usize> = chain(roles.upper_arm[0]);
    for joint in chain(roles.head) {
        let neck = !above_arm.contains(&joint);
        ranges[joint] = if neck {
            symmetric(upright, [0.6, 0.6, 0.5], [0.2, 0.25, 0.2])
        } else {
            symmetric(upright, [0.7, 0.5, 0.5], [0.25, 0.2, 0.2])
        };
    }
    ranges[roles.head] = symmetric(upright, [0.6, 0.7, 0.5], [0.25, 0.3, 0.2]);
    for (side, sign) in [(0, 1.0), (1, -1.0)] {
        // Axes are mirrored so that a positive component means the same on both sides.
        let frame = |flexion: DVec3, along: DVec3| {
            let twist = (along - flexion * along.dot(flexion)).normalize_or(DVec3::Y);
            DMat3::from_cols(flexion, twist * sign, flexion.cross(twist) * sign)
        };
        let [arm, elbow, wrist] = [roles.upper_arm[side], roles.forearm[side], roles.hand[side]];
        let [hip, knee, ankle] = [roles.thigh[side], roles.shank[side], roles.foot[side]];
        let upper = (origins[elbow] - origins[arm]).normalize_or(DVec3::X * sign);
        let lower = (origins[wrist] - origins[elbow]).normalize_or(upper);
        // The elbow may be bent at rest; the bend then gives its axis.
        let bent = upper.cross(lower);
        let forward = upper.cross(DVec3::Z).normalize_or(DVec3::NEG_Y * sign);
        let elbow_axis = if bent.length() > 0.17 { bent.normalize() } else { forward };
        let elbow_rest = bent.dot(elbow_axis).atan2(upper.dot(lower));
        ranges[arm] = symmetric(frame(forward, upper), [2.6, 1.6, 2.4], [1.2, 0.6, 1.2]);
        ranges[elbow] = Some(JointRange {
            axes: frame(elbow_axis, lower),
            low: DVec3::new(-0.05 - elbow_rest, -1.4, -0.1),
            high: DVec3::new(2.6 - elbow_rest, 1.4, 0.1),
            sigma: DVec3::new(1.5, 0.6, 0.06),
        });
        ranges[wrist] = symmetric(frame(elbow_axis, lower), [0.9, 0.3, 0.5], [0.35, 0.1, 0.25]);
        if let Some(clavicle) = roles.clavicle[side] {
            let along = (origins[arm] - origins[clavicle]).normalize_or(DVec3::X * sign);
            let axis = along.cross(DVec3::Z).normalize_or(DVec3::NEG_Y * sign);
            ranges[clavicle] = symmetric(frame(axis, along), [0.4, 0.1, 0.6], [0.15, 0.05, 0.2]);
        }
        let thigh = (origins[knee] - origins[hip]).normalize_or(DVec3::NEG_Y);
        let shank = (origins[ankle] - origins[knee]).normalize_or(thigh);
        let knee_rest = thigh.cross(shank).dot(DVec3::X).atan2(thigh.dot(shank));
        ranges[hip] = Some(JointRange {
            axes: frame(DVec3::X, thigh),
            low: DVec3::new(-2.2, -0.8, -1.2),
            high: DVec3::new(0.7, 0.8, 1.2),
            sigma: DVec3::new(1.0, 0.35, 0.7),
        });
        ranges[knee] = Some(JointRange {
            axes: frame(DVec3::X, shank),
            low: DVec3::new(-0.05 - knee_rest, -0.3, -0.1),
            high: DVec3::new(2.6 - knee_rest, 0.3, 0.1),
            sigma: DVec3::new(1.5, 0.12, 0.05),
        });
        ranges[ankle] = symmetric(frame(DVec3::X, DVec3::NEG_Y), [0.9, 0.4, 0.4], [0.4, 0.2, 0.15]);
    }
    // The root turns freely.
    ranges[0] = None;
    ranges
}

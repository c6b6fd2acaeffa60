//! Motion: pose and node translations of one frame, decodable without any other frame.

use alloc::{vec, vec::Vec};

use crate::{
    bytes::Fields,
    error::StreamError,
    message::{MAX_MESSAGE_BYTES, MOTION_MAGIC},
    nodes::{Prediction, code_nodes},
    quantise::quantise,
    range_coder::{RangeDecoder, RangeEncoder},
    stamp::Stamp,
    template::{EncodedTemplate, StreamTemplate},
};

const WHAT: &str = "motion";
/// Quantisation step of node translations, metres: an error of 0.12 mm.
const NODE_STEP_M: f32 = 4e-4;
/// Quantisation step of the root's translation, metres.
const ROOT_STEP_M: f64 = 1e-4;
/// Quantisation steps of a quaternion's component to either side of 0, whose range is 1/sqrt(2).
const QUATERNION_LEVELS: f32 = 16_383.0;

/// Pose and position of a person at one frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Motion {
    /// Template, person and frame.
    pub stamp: Stamp,
    /// Position of the root joint in the world, metres.
    pub root_translation: [f32; 3],
    /// Rotation of each joint relative to its parent (the root's: to the world), a unit quaternion x, y, z, w.
    pub joint_rotations: Vec<[f32; 4]>,
    /// Translation of each node in canonical space, metres; empty without a deformation graph.
    pub nodes: Vec<[f32; 3]>,
}

/// Encoder of the motion of one template.
#[derive(Debug, Clone)]
pub struct MotionEncoder {
    template: u64,
    joints: usize,
    node_order: Vec<u32>,
    predictions: Vec<Prediction>,
    levels: Vec<[i32; 3]>,
}

impl MotionEncoder {
    /// Creates an encoder for a template.
    #[must_use]
    pub fn new(template: &EncodedTemplate) -> Self {
        Self {
            template: template.template.hash,
            joints: template.template.joints.len(),
            node_order: template.node_order.clone(),
            predictions: template.template.predictions.clone(),
            levels: vec![[0; 3]; template.template.nodes],
        }
    }

    /// Encodes a motion whose nodes are in the order of the template's source; nodes that are missing or not finite count as at rest.
    /// `motion.stamp.template` is replaced by the hash of the template.
    ///
    /// # Errors
    /// [`StreamError::Malformed`] when joints are missing or a number of the pose is not finite.
    pub fn encode(&mut self, motion: &Motion) -> Result<Vec<u8>, StreamError> {
        let fail = |problem| Err(StreamError::Malformed { what: WHAT, problem });
        if motion.joint_rotations.len() != self.joints {
            return fail("it has another number of joints than its template");
        }
        let root = motion.root_translation.map(|v| libm::round(f64::from(v) / ROOT_STEP_M));
        if !root.iter().all(|v| v.abs() < f64::from(i32::MAX)) {
            return fail("the root's position is not finite");
        }
        let mut bytes = Stamp { template: self.template, ..motion.stamp }.begin(MOTION_MAGIC);
        bytes.extend(root.iter().flat_map(|v| (*v as i32).to_le_bytes()));
        for rotation in &motion.joint_rotations {
            let Some(packed) = pack(*rotation) else { return fail("a rotation is not of unit length") };
            bytes.extend(&packed.to_le_bytes()[..6]);
        }
        if self.node_order.is_empty() {
            return Ok(bytes);
        }
        for (levels, &from) in self.levels.iter_mut().zip(&self.node_order) {
            let moved = motion.nodes.get(from as usize).copied().unwrap_or_default();
            let moved = if moved.iter().all(|v| v.abs() < 1e3) { moved } else { [0.0; 3] };
            *levels = moved.map(|v| quantise(v / NODE_STEP_M, 0.5));
        }
        let mut encoder = RangeEncoder::new(bytes);
        code_nodes(&mut encoder, &self.predictions, &mut self.levels);
        let bytes = encoder.finish();
        if bytes.len() > MAX_MESSAGE_BYTES {
            return fail("it has more nodes than fit in a message; use fewer");
        }
        Ok(bytes)
    }
}

impl Motion {
    /// Decodes a motion of this template.
    ///
    /// # Errors
    /// [`StreamError`] for damaged bytes, and for a motion of another version or template.
    pub fn decode(bytes: &[u8], template: &StreamTemplate) -> Result<Self, StreamError> {
        let mut fields = Fields::new(WHAT, MOTION_MAGIC, bytes)?;
        fields.check(bytes.len() <= MAX_MESSAGE_BYTES, "it is too large")?;
        let stamp = Stamp::read(&mut fields)?;
        if stamp.template != template.hash {
            return Err(StreamError::OtherTemplate { what: WHAT });
        }
        let mut root_translation = [0.0; 3];
        for value in &mut root_translation {
            *value = (f64::from(fields.take().map(i32::from_le_bytes)?) * ROOT_STEP_M) as f32;
        }
        let mut joint_rotations = Vec::with_capacity(template.joints.len());
        for _ in 0..template.joints.len() {
            let [a, b, c, d, e, f] = fields.take()?;
            joint_rotations.push(unpack(u64::from_le_bytes([a, b, c, d, e, f, 0, 0])));
        }
        let mut levels = vec![[0; 3]; template.nodes];
        code_nodes(&mut RangeDecoder::new(fields.bytes), &template.predictions, &mut levels);
        let nodes = levels.iter().map(|levels| levels.map(|v| v as f32 * NODE_STEP_M)).collect();
        Ok(Self { stamp, root_translation, joint_rotations, nodes })
    }

    /// Interpolates between two motions of one template, `t` in 0..=1, along the shortest rotation of each joint. The stamp is that of the
    /// nearer motion, with the capture time in between.
    #[must_use]
    pub fn interpolate(&self, other: &Self, t: f32) -> Self {
        let mix = |a: f32, b: f32| a + (b - a) * t;
        let later = other.stamp.capture_nanos.saturating_sub(self.stamp.capture_nanos);
        let capture_nanos = self.stamp.capture_nanos.saturating_add((later as f64 * f64::from(t)) as i64);
        let mix3 = |a: [f32; 3], b: [f32; 3]| core::array::from_fn(|k| mix(a[k], b[k]));
        let turn = |a: [f32; 4], b: [f32; 4]| {
            let dot: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
            let b = if dot < 0.0 { b.map(|v| -v) } else { b };
            let mixed: [f32; 4] = core::array::from_fn(|k| mix(a[k], b[k]));
            let length = libm::sqrtf(mixed.iter().map(|v| v * v).sum());
            if length > 1e-6 { mixed.map(|v| v / length) } else { a }
        };
        let pairs = |a: &[[f32; 3]], b: &[[f32; 3]]| a.iter().zip(b).map(|(a, b)| mix3(*a, *b)).collect();
        Self {
            stamp: Stamp { capture_nanos, ..if t < 0.5 { self.stamp } else { other.stamp } },
            root_translation: mix3(self.root_translation, other.root_translation),
            joint_rotations: self
                .joint_rotations
                .iter()
                .zip(&other.joint_rotations)
                .map(|(a, b)| turn(*a, *b))
                .collect(),
            nodes: pairs(&self.nodes, &other.nodes),
        }
    }
}

/// Packs a rotation into 47 bits: the index of the largest component and the other three. `None` when it is not of unit length.
fn pack(rotation: [f32; 4]) -> Option<u64> {
    let length = libm::sqrtf(rotation.iter().map(|v| v * v).sum());
    if !(0.9..1.1).contains(&length) {
        return None;
    }
    let largest = (0..4).max_by(|&a, &b| rotation[a].abs().total_cmp(&rotation[b].abs())).unwrap_or(3);
    let sign = if rotation[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut packed = largest as u64;
    for k in (0..4).filter(|k| *k != largest) {
        let share = rotation[k] * sign / length * core::f32::consts::SQRT_2;
        packed = packed << 15 | ((share * QUATERNION_LEVELS + QUATERNION_LEVELS + 0.5) as u64).min(32_767);
    }
    Some(packed)
}

/// Unpacks a rotation.
fn unpack(packed: u64) -> [f32; 4] {
    let largest = (packed >> 45 & 3) as usize;
    let mut rotation = [0.0; 4];
    let mut squares = 0.0;
    for (i, k) in (0..4).filter(|k| *k != largest).enumerate() {
        let level = packed >> (15 * (2 - i)) & 0x7fff;
        let share = (level as f32 - QUATERNION_LEVELS) / QUATERNION_LEVELS * core::f32::consts::FRAC_1_SQRT_2;
        squares += share * share;
        rotation[k] = share;
    }
    rotation[largest] = libm::sqrtf((1.0f32 - squares).max(0.0));
    // In damaged bits, the three may be too large.
    let by = 1.0 / libm::sqrtf(squares.max(1.0));
    rotation.map(|v| v * by)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn rotations_come_back() {
        let mut random = StdRng::seed_from_u64(8);
        for _ in 0..20_000 {
            let v: [f32; 4] = [0; 4].map(|_| random.random_range(-1.0f32..1.0));
            let length = v.iter().map(|v| v * v).sum::<f32>().sqrt();
            if length < 0.1 {
                continue;
            }
            let rotation = v.map(|v| v / length);
            let back = unpack(pack(rotation).unwrap());
            let dot: f32 = rotation.iter().zip(back).map(|(a, b)| a * b).sum();
            // The angle between the two, radians.
            assert!(2.0 * dot.abs().min(1.0).acos() < 1.5e-3, "{rotation:?} {back:?}");
            let apart: f32 = rotation.iter().zip(back).map(|(a, b)| (a * dot.signum() - b).abs()).fold(0.0, f32::max);
            // Half a step in each of three components adds up in the largest.
            assert!(apart < 7e-5, "{apart}");
        }
        for bad in [[0.0; 4], [f32::NAN, 0.0, 0.0, 1.0], [2.0, 0.0, 0.0, 0.0]] {
            assert_eq!(pack(bad), None);
        }
        for packed in [0, u64::MAX, 0x1fff_ffff_ffff] {
            let length: f32 = unpack(packed).iter().map(|v| v * v).sum();
            assert!((length - 1.0).abs() < 1e-4, "{packed}: {length}");
        }
    }
}

//! A body at rest: mesh, skin and skeleton.

use glam::{Vec2, Vec3};

use crate::{BodyError, Skeleton};

/// Which joints move a point, the strongest four; the weights add up to 1.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SkinWeights {
    /// Joint indices; 0 where the weight is 0.
    pub joints: [u16; 4],
    /// Weights in falling order.
    pub weights: [f32; 4],
}

impl SkinWeights {
    /// The four strongest of any number of (joint, weight) pairs, scaled to the sum 1; repeated joints are added
    /// up. None when no weight is positive and finite.
    #[must_use]
    pub fn strongest(influences: &[(u16, f32)]) -> Option<Self> {
        let mut merged: Vec<(u16, f32)> = Vec::with_capacity(influences.len());
        for &(joint, weight) in influences.iter().filter(|(_, weight)| *weight > 0.0 && weight.is_finite()) {
            match merged.iter_mut().find(|(known, _)| *known == joint) {
                Some((_, sum)) => *sum += weight,
                None => merged.push((joint, weight)),
            }
        }
        merged.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        merged.truncate(4);
        let total: f32 = merged.iter().map(|(_, weight)| weight).sum();
        let mut skin = Self::default();
        for (slot, (joint, weight)) in merged.iter().enumerate() {
            skin.joints[slot] = *joint;
            skin.weights[slot] = weight / total;
        }
        (total > 0.0 && total.is_finite()).then_some(skin)
    }
}

/// Coarse part of the body, from the joint that moves a point most.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Part {
    /// Head and neck.
    Head,
    /// Chest, belly, hips.
    Torso,
    /// Left shoulder to wrist.
    LeftArm,
    /// Right shoulder to wrist.
    RightArm,
    /// Left hand and fingers.
    LeftHand,
    /// Right hand and fingers.
    RightHand,
    /// Left thigh and shank.
    LeftLeg,
    /// Right thigh and shank.
    RightLeg,
    /// Left foot.
    LeftFoot,
    /// Right foot.
    RightFoot,
}

impl Part {
    /// Every part, in the order that shipped networks know them in.
    pub const ALL: [Self; 10] = [
        Self::Head,
        Self::Torso,
        Self::LeftArm,
        Self::RightArm,
        Self::LeftHand,
        Self::RightHand,
        Self::LeftLeg,
        Self::RightLeg,
        Self::LeftFoot,
        Self::RightFoot,
    ];
}

/// A skinned human at rest. All vertex lists have the same length; vertices may be split at UV seams
/// (see [`Template::welded`]).
#[derive(Debug, Clone, PartialEq)]
pub struct Template {
    /// Name for messages.
    pub name: String,
    /// Canonical positions (bind pose), metres, y up, facing +z.
    pub positions: Vec<Vec3>,
    /// Canonical unit normals.
    pub normals: Vec<Vec3>,
    /// Texture coordinates, v down as in glTF; zero where the source had none.
    pub uvs: Vec<Vec2>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Per vertex.
    pub skin: Vec<SkinWeights>,
    /// Per vertex.
    pub parts: Vec<Part>,
    /// The joints that the skin speaks of.
    pub skeleton: Skeleton,
}

impl Template {
    /// Returns a template without vertices.
    #[must_use]
    pub fn empty(name: impl Into<String>, skeleton: Skeleton) -> Self {
        Self {
            name: name.into(),
            positions: Vec::new(),
            normals: Vec::new(),
            uvs: Vec::new(),
            triangles: Vec::new(),
            skin: Vec::new(),
            parts: Vec::new(),
            skeleton,
        }
    }

    /// Area of the canonical surface, square metres; triangles whose corners do not exist count nothing.
    #[must_use]
    pub fn area_m2(&self) -> f64 {
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| self.positions.get(i as usize).map(|p| p.as_dvec3()));
            Some(0.5 * (b? - a?).cross(c? - a?).length())
        };
        self.triangles.iter().filter_map(area).sum()
    }

    /// Whether the lists agree, every index points at something and every number is finite.
    ///
    /// # Errors
    /// [`BodyError::Mesh`] says what is wrong.
    pub fn check(&self) -> Result<(), BodyError> {
        let fail = |message: &str| Err(BodyError::Mesh { name: self.name.clone(), message: message.to_owned() });
        let count = self.positions.len();
        let lengths = [self.normals.len(), self.uvs.len(), self.skin.len(), self.parts.len()];
        if lengths != [count; 4] {
            return fail("positions, normals, texture coordinates, skin and parts differ in number");
        }
        if self.triangles.is_empty() {
            return fail("no triangles");
        }
        if self.triangles.iter().flatten().any(|&index| index as usize >= count) {
            return fail("a triangle names a vertex that does not exist");
        }
        let finite = self.positions.iter().chain(&self.normals).all(|v| v.is_finite())
            && self.uvs.iter().all(|uv| uv.is_finite())
            && self.skin.iter().flat_map(|skin| skin.weights).all(f32::is_finite);
        if !finite {
            return fail("a position, normal, texture coordinate or weight is not a finite number");
        }
        let joints = self.skeleton.joints().len();
        if self.skin.iter().flat_map(|skin| skin.joints).any(|joint| usize::from(joint) >= joints) {
            return fail("a vertex hangs on a joint that does not exist");
        }
        Ok(())
    }

    /// Checks that poses of `other` are poses of this body: joints of the same names in the same order.
    ///
    /// # Errors
    /// [`BodyError::Skeleton`] with both numbers, or the first name that differs.
    pub fn check_same_joints(&self, other: &Self) -> Result<(), BodyError> {
        let (own, others) = (self.skeleton.joints(), other.skeleton.joints());
        let differ = own.iter().zip(others).find(|(a, b)| a.name != b.name);
        let difference = match differ {
            Some((a, b)) => format!("'{}' in place of '{}' among its joints", a.name, b.name),
            None if own.len() != others.len() => format!("{} joints in place of {}", own.len(), others.len()),
            None => return Ok(()),
        };
        Err(BodyError::Skeleton(format!(
            "the body '{}' has {difference}, so that poses of '{}' do not fit it; use the same body for both",
            self.name, other.name
        )))
    }

    /// Maps each vertex to its position class: vertices split at UV seams share one.
    #[must_use]
    pub fn welded(&self) -> Vec<u32> {
        let mut classes = std::collections::HashMap::new();
        self.positions
            .iter()
            .map(|p| {
                // Adding zero turns -0.0 into 0.0.
                let next = classes.len() as u32;
                *classes.entry((*p + 0.0).to_array().map(f32::to_bits)).or_insert(next)
            })
            .collect()
    }
}

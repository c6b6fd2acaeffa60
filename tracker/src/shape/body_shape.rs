//! Shape space of a body: scale, lengths, girths and targets, their prior among people, and the template of each shape.

use std::{borrow::Cow, collections::BTreeMap};

use flyrig_body::{Joint, ShapeParams, Skeleton, Template, default_template};
use glam::{DMat3, DMat4, DVec3};

use crate::error::{TrackError, TrackErrorKind};
use crate::pose::body_model::BodyModel;

/// Standard deviation of the whole-body scale among people.
const SCALE_SIGMA: f64 = 0.15;
/// Standard deviation of the length of a group of bones at a given scale.
const LENGTH_SIGMA: f64 = 0.05;
/// Standard deviation of the girth of a limb at a given scale, clothes included.
const GIRTH_SIGMA: f64 = 0.1;
/// Standard deviation of a target of the built-in body, whose values lie in 0..=1.
const TARGET_SIGMA: f64 = 0.25;

/// Groups of bones whose length varies, shared by both sides.
pub(crate) const LENGTHS: [&str; 8] =
    ["trunk", "shoulders", "hips", "upper-arms", "forearms", "thighs", "shanks", "feet"];
/// Parts whose girth varies: the trunk from front to back, limbs around their bones, the head as a whole.
pub(crate) const GIRTHS: [&str; 5] = ["trunk-depth", "arm-girth", "thigh-girth", "shank-girth", "head-size"];
/// Targets of the built-in body.
const TARGETS: [&str; 6] = ["gender", "weight", "muscle", "age", "height", "proportions"];

/// Place of the first target among the parameters.
const FIRST_TARGET: usize = 1 + LENGTHS.len() + GIRTHS.len();

/// Template with parameters of shape: the whole-body scale, lengths, girths, and the targets of the built-in body.
#[derive(Debug, Clone)]
pub(crate) struct ShapeSpace {
    base: Template,
    has_targets: bool,
}

impl ShapeSpace {
    /// Returns the shape space of a template; targets exist for the built-in body only.
    pub fn new(base: &Template) -> Self {
        Self { base: base.clone(), has_targets: base.is_built_in() }
    }

    /// Returns name, mean and standard deviation of each parameter among people.
    pub fn prior(&self) -> Vec<(&'static str, f64, f64)> {
        let of = |names: &'static [&'static str], mean: f64, sigma: f64| names.iter().map(move |n| (*n, mean, sigma));
        std::iter::once(("scale", 1.0, SCALE_SIGMA))
            .chain(of(&LENGTHS, 1.0, LENGTH_SIGMA))
            .chain(of(&GIRTHS, 1.0, GIRTH_SIGMA))
            .chain(of(&TARGETS, 0.5, TARGET_SIGMA).filter(|_| self.has_targets))
            .collect()
    }

    /// Returns whether a parameter is a target of the built-in body.
    pub fn is_target(index: usize) -> bool {
        index >= FIRST_TARGET
    }

    /// Clamps a parameter to the range in which bodies exist.
    pub fn clamped(index: usize, value: f64) -> f64 {
        if Self::is_target(index) { value.clamp(0.0, 0.99) } else { value.clamp(0.4, 1.6) }
    }

    /// Returns the template of a shape.
    ///
    /// # Errors
    /// Kind `Template` when no such body exists.
    pub fn template(&self, values: &[f64]) -> Result<Template, TrackError> {
        self.unscaled(values)?.scaled(values)
    }

    /// Returns the body of a shape's targets before scale, lengths and girths.
    ///
    /// # Errors
    /// Kind `Template` when no such body exists.
    pub fn unscaled(&self, values: &[f64]) -> Result<UnscaledBody<'_>, TrackError> {
        let base = if self.has_targets {
            let weights = values.iter().skip(FIRST_TARGET).map(|weight| *weight as f32);
            let targets = TARGETS.iter().map(|name| (*name).to_owned()).zip(weights.chain(std::iter::repeat(0.5)));
            let shaped = default_template(&ShapeParams(targets.collect()))
                .map_err(|error| TrackError::new(TrackErrorKind::Template, format!("the built-in body: {error}")))?;
            Cow::Owned(shaped)
        } else {
            Cow::Borrowed(&self.base)
        };
        Ok(UnscaledBody { model: BodyModel::with_anatomical_marks(&base)?, base, space: self })
    }
}

/// Body of a shape's targets before scale, lengths and girths.
#[derive(Debug)]
pub(crate) struct UnscaledBody<'a> {
    space: &'a ShapeSpace,
    base: Cow<'a, Template>,
    model: BodyModel,
}

impl UnscaledBody<'_> {
    /// Returns the template of a shape with the same targets; those in `values` are not read.
    ///
    /// # Errors
    /// Kind `Template` when no such body exists.
    pub fn scaled(&self, values: &[f64]) -> Result<Template, TrackError> {
        let named = self.space.prior().into_iter().zip(values).map(|((name, ..), value)| (name.to_owned(), *value));
        scale_template(&self.base, &self.model, &named.collect())
    }
}

/// Returns the stretch of each joint's flesh, canonical axes, before the whole-body scale.
fn stretches(model: &BodyModel, factors: &BTreeMap<String, f64>) -> Vec<DMat3> {
    let factor = |name: &str| factors.get(name).copied().unwrap_or(1.0);
    let mut stretch = vec![DMat3::IDENTITY; model.parents.len()];
    let roles = &model.roles;
    // Along a bone by its length, around it by its girth.
    let limb = |from: usize, to: usize, length: f64, girth: f64| {
        let d = (model.origins[to] - model.origins[from]).normalize_or(DVec3::Y);
        DMat3::IDENTITY * girth + DMat3::from_cols(d * d.x, d * d.y, d * d.z) * (length - girth)
    };
    let (shoulders, hips, trunk) = (factor("shoulders"), factor("hips"), factor("trunk"));
    let depth = factor("trunk-depth");
    // Trunk joints: from the root up to where the arms begin, ever less hips and more shoulders.
    let mut spine = Vec::new();
    let first_of_arm = roles.clavicle[0].unwrap_or(roles.upper_arm[0]);
    let mut at = model.parents[first_of_arm];
    while let Some(joint) = at {
        spine.push(joint);
        at = model.parents[joint];
    }
    let count = (spine.len().max(2) - 1) as f64;
    for (i, &joint) in spine.iter().enumerate() {
        let t = i as f64 / count; // 0 at the chest, 1 at the root
        stretch[joint] = DMat3::from_diagonal(DVec3::new(shoulders + (hips - shoulders) * t, trunk, depth));
    }
    for (joint, stretch) in stretch.iter_mut().enumerate() {
        if model.hangs_below(joint, roles.head) {
            *stretch = DMat3::IDENTITY * factor("head-size");
        }
    }
    for side in 0..2 {
        if let Some(clavicle) = roles.clavicle[side] {
            stretch[clavicle] = DMat3::from_diagonal(DVec3::new(shoulders, 1.0, depth));
        }
        // Helper joints between the root and a thigh carry the width of the hips.
        let mut at = model.parents[roles.thigh[side]];
        while let Some(joint) = at {
            if !spine.contains(&joint) {
                stretch[joint] = DMat3::from_diagonal(DVec3::new(hips, 1.0, depth));
            }
            at = model.parents[joint];
        }
        let (upper, fore, hand) = (roles.upper_arm[side], roles.forearm[side], roles.hand[side]);
        let (thigh, shank, foot) = (roles.thigh[side], roles.shank[side], roles.foot[side]);
        stretch[upper] = limb(upper, fore, factor("upper-arms"), factor("arm-girth"));
        stretch[fore] = limb(fore, hand, factor("forearms"), factor("arm-girth"));
        stretch[thigh] = limb(thigh, shank, factor("thighs"), factor("thigh-girth"));
        stretch[shank] = limb(shank, foot, factor("shanks"), factor("shank-girth"));
        for (joint, stretch) in stretch.iter_mut().enumerate() {
            if model.hangs_below(joint, roles.foot[side]) {
                *stretch = DMat3::from_diagonal(DVec3::new(1.0, 1.0, factor("feet")));
            }
        }
    }
    stretch
}

/// Stretches a template by factors named as in [`LENGTHS`] and [`GIRTHS`], and `scale`; missing ones are 1. Vertices move
/// with the bones that carry them.
///
/// # Errors
/// Kind `Template` when the fitted skeleton is not valid.
pub(crate) fn scale_template(
    template: &Template,
    model: &BodyModel,
    factors: &BTreeMap<String, f64>,
) -> Result<Template, TrackError> {
    let scale = factors.get("scale").copied().unwrap_or(1.0);
    let stretch: Vec<DMat3> = stretches(model, factors).into_iter().map(|s| s * scale).collect();
    let mut origins: Vec<DVec3> = Vec::with_capacity(stretch.len());
    let mut joints: Vec<Joint> = Vec::with_capacity(stretch.len());
    for (index, joint) in template.skeleton.joints().iter().enumerate() {
        let bind = DMat3::from_quat(model.bind_rotation[index]);
        let (origin, rest_translation) = match joint.parent {
            None => (model.origins[index] * scale, joint.rest_translation * scale),
            Some(parent) => {
                let parent_bind = DMat3::from_quat(model.bind_rotation[parent]);
                let local = parent_bind.transpose() * stretch[parent] * parent_bind;
                let origin = origins[parent] + stretch[parent] * (model.origins[index] - model.origins[parent]);
                (origin, local * joint.rest_translation)
            }
        };
        origins.push(origin);
        let joint_from_canonical = DMat4::from_mat3(bind.transpose()) * DMat4::from_translation(-origin);
        joints.push(Joint { rest_translation, joint_from_canonical, ..joint.clone() });
    }
    let mut shaped = template.clone();
    shaped.skeleton = Skeleton::new(joints)
        .map_err(|error| TrackError::new(TrackErrorKind::Template, format!("the fitted skeleton: {error}")))?;
    let inverse: Vec<DMat3> = stretch.iter().map(DMat3::inverse).collect();
    for ((position, normal), skin) in shaped.positions.iter_mut().zip(&mut shaped.normals).zip(&template.skin) {
        let (old, old_normal) = (position.as_dvec3(), normal.as_dvec3());
        let (mut moved, mut turned, mut total) = (DVec3::ZERO, DVec3::ZERO, 0.0);
        for (&joint, &weight) in skin.joints.iter().zip(&skin.weights) {
            let (joint, weight) = (usize::from(joint), f64::from(weight));
            if weight > 0.0 {
                moved += (origins[joint] + stretch[joint] * (old - model.origins[joint])) * weight;
                turned += inverse[joint] * old_normal * weight;
                total += weight;
            }
        }
        if total > 0.0 {
            *position = (moved / total).as_vec3();
            *normal = turned.normalize_or(old_normal).as_vec3();
        } else {
            *position = (old * scale).as_vec3();
        }
    }
    Ok(shaped)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::body;

    #[test]
    fn every_corner_of_the_space_is_a_body() {
        let built_in = ShapeSpace::new(&body());
        let mut other = body();
        other.name = "imported".to_owned();
        let imported = ShapeSpace::new(&other);
        assert_eq!(built_in.prior().len(), imported.prior().len() + TARGETS.len());
        for space in [built_in, imported] {
            for (k, (name, mean, sigma)) in space.prior().into_iter().enumerate() {
                for value in [mean - 3.0 * sigma, mean + 3.0 * sigma] {
                    let mut values: Vec<f64> = space.prior().iter().map(|(_, mean, _)| *mean).collect();
                    values[k] = ShapeSpace::clamped(k, value);
                    let template = space.template(&values).unwrap();
                    assert!(template.check().is_ok(), "{name} {value}");
                    assert!(BodyModel::new(&template).is_ok(), "{name} {value}");
                }
            }
        }
    }

    #[test]
    fn girths_thicken_limbs_and_leave_the_joints() {
        let space = ShapeSpace::new(&body());
        let mean: Vec<f64> = space.prior().iter().map(|(_, mean, _)| *mean).collect();
        let mut thick = mean.clone();
        thick[space.prior().iter().position(|(name, ..)| *name == "thigh-girth").unwrap()] = 1.2;
        let (a, b) = (space.template(&mean).unwrap(), space.template(&thick).unwrap());
        assert!((b.area_m2() / a.area_m2() - 1.0) > 0.01);
        let (a, b) = (BodyModel::new(&a).unwrap(), BodyModel::new(&b).unwrap());
        for (a, b) in a.origins.iter().zip(&b.origins) {
            assert!(a.distance(*b) < 1e-6);
        }
    }
}

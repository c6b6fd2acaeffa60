//! Transfer of a change of shape from the built-in body to a body with the same texture coordinates.

use std::collections::HashMap;

use glam::{DMat4, DVec3, Quat, Vec2, Vec3};

use crate::{BodyError, Joint, ShapeParams, Skeleton, SkinWeights, Template, default_template, point_grid::PointGrid};

/// Steps per unit to which texture coordinates are rounded for comparison.
const UV_STEPS: f32 = 1e5;
/// Number of near vertices that a vertex of clothes, which the built-in body lacks, follows.
const NEAREST: usize = 4;
/// First search radius for them, metres; it doubles until vertices are found.
const NEAR_M: f32 = 0.03;
/// Smallest mean agreement of normals with the built-in body's; a body with less rests in another pose.
const LEAST_AGREEMENT: f32 = 0.7;

/// Template in another shape.
#[derive(Debug, Clone)]
pub struct Reshaped {
    /// Body in the new shape, with a refitted skeleton.
    pub template: Template,
    /// Displacement of each vertex, canonical metres.
    pub displacement: Vec<Vec3>,
}

impl Template {
    /// Changes the shape: each vertex moves as the vertex of the built-in body with the same texture coordinates does between the average
    /// shape and `change`, and joints accordingly (LoGAvatar, section 5.4). Vertices of clothes follow those of the body near them; joints that
    /// the built-in body lacks follow the vertices that they share with their parent.
    ///
    /// Local measures add up: their result is exact for a body of any shape. Macro targets (`weight`, `age`, ...) move it as they
    /// would the average body.
    ///
    /// # Errors
    /// [`BodyError::UnknownTarget`], [`BodyError::TargetWeight`]; [`BodyError::Mesh`] for a body that does not share the built-in one's
    /// texture coordinates, or rests in another pose.
    pub fn reshape(&self, change: &ShapeParams) -> Result<Reshaped, BodyError> {
        self.check()?;
        let (from, to) = (default_template(&ShapeParams::default())?, default_template(change)?);
        let fail = |message: String| BodyError::Mesh { name: self.name.clone(), message };
        let key = |uv: &Vec2| (uv * UV_STEPS).round().as_ivec2();
        let known: HashMap<_, usize> = from.uvs.iter().enumerate().map(|(i, uv)| (key(uv), i)).collect();
        let partner = |uv: &Vec2| if *uv == Vec2::ZERO { None } else { known.get(&key(uv)).copied() };
        let partners: Vec<Option<usize>> = self.uvs.iter().map(partner).collect();
        let matched = partners.iter().flatten().count();
        if 2 * matched < from.positions.len() {
            return Err(fail(format!(
                "{matched} of its vertices have the built-in body's texture coordinates, at least {} are needed; shapes are edited \
                 on the built-in body, or one with its texture coordinates",
                from.positions.len().div_ceil(2)
            )));
        }
        let pairs = || partners.iter().enumerate().filter_map(|(i, partner)| Some((i, (*partner)?)));
        let agreement =
            pairs().map(|(i, partner)| self.normals[i].dot(from.normals[partner])).sum::<f32>() / matched as f32;
        if agreement < LEAST_AGREEMENT {
            return Err(fail(
                "it rests in another pose than the built-in body; use one that rests in its A pose".to_owned(),
            ));
        }
        let mut displacement = vec![Vec3::ZERO; self.positions.len()];
        for (i, partner) in pairs() {
            displacement[i] = to.positions[partner] - from.positions[partner];
        }
        follow(&self.positions, &partners, &mut displacement);
        let positions: Vec<Vec3> = self.positions.iter().zip(&displacement).map(|(a, b)| *a + *b).collect();
        let skeleton = refit(self, &displacement, [&from.skeleton, &to.skeleton])?;
        let normals = self.normals_at(&positions);
        Ok(Reshaped { template: Self { positions, normals, skeleton, ..self.clone() }, displacement })
    }

    /// Returns the normals of the mesh with its vertices at other positions, one per vertex: rotated as the surface around each vertex is;
    /// copies of a vertex at a seam rotate alike.
    #[must_use]
    pub fn normals_at(&self, positions: &[Vec3]) -> Vec<Vec3> {
        let bits = |place: &Vec3| place.to_array().map(f32::to_bits);
        let mut first: HashMap<[u32; 3], usize> = HashMap::new();
        let same: Vec<usize> =
            self.positions.iter().enumerate().map(|(i, place)| *first.entry(bits(place)).or_insert(i)).collect();
        let area_normals = |positions: &[Vec3]| {
            let mut sums = vec![Vec3::ZERO; positions.len()];
            for triangle in &self.triangles {
                let [a, b, c] = triangle.map(|i| positions[i as usize]);
                let normal = (b - a).cross(c - a);
                triangle.iter().for_each(|i| sums[same[*i as usize]] += normal);
            }
            sums
        };
        let (before, after) = (area_normals(&self.positions), area_normals(positions));
        let of = |(i, normal): (usize, &Vec3)| match (before[same[i]].try_normalize(), after[same[i]].try_normalize()) {
            (Some(from), Some(to)) => (Quat::from_rotation_arc(from, to) * *normal).normalize_or(*normal),
            _ => *normal,
        };
        self.normals.iter().enumerate().map(of).collect()
    }
}

/// Moves vertices without a partner as the nearest ones that have one, weighted by the inverse of their distances.
fn follow(positions: &[Vec3], partners: &[Option<usize>], displacement: &mut [Vec3]) {
    let leaders: Vec<usize> = (0..positions.len()).filter(|i| partners[*i].is_some()).collect();
    let places: Vec<Vec3> = leaders.iter().map(|i| positions[*i]).collect();
    let grid = PointGrid::new(&places, NEAR_M);
    for i in (0..positions.len()).filter(|i| partners[*i].is_none()) {
        let mut near: Vec<(f32, usize)> = Vec::new();
        let mut radius = NEAR_M;
        while near.len() < NEAREST && near.len() < leaders.len() {
            near.clear();
            grid.within(positions[i], radius, |j, squared| near.push((squared, leaders[j])));
            radius *= 2.0;
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let (mut sum, mut weights) = (Vec3::ZERO, 0.0);
        for (squared, leader) in near.into_iter().take(NEAREST) {
            let weight = 1.0 / (squared + 1e-8);
            sum += displacement[leader] * weight;
            weights += weight;
        }
        displacement[i] = sum / weights.max(1e-12);
    }
}

/// Returns the skeleton in the new shape: joints that the built-in body has move as there, others with the vertices that they share
/// with their parent.
fn refit(template: &Template, displacement: &[Vec3], [from, to]: [&Skeleton; 2]) -> Result<Skeleton, BodyError> {
    let origin = |joint: &Joint| joint.joint_from_canonical.inverse().w_axis.truncate();
    let bones = template.skeleton.joints();
    let moved: Vec<DVec3> = bones
        .iter()
        .enumerate()
        .map(|(index, bone)| match (from.joint(&bone.name), to.joint(&bone.name)) {
            (Some(a), Some(b)) => origin(&to.joints()[b]) - origin(&from.joints()[a]),
            _ => shared_displacement(template, displacement, index),
        })
        .collect();
    let joints = bones.iter().zip(&moved).map(|(bone, by)| {
        let parent = bone.parent.map(|parent| (moved[parent], bones[parent].joint_from_canonical));
        // The root rests in the world, whose axes are the canonical ones.
        let in_parent = parent.map_or(*by, |(parent, from_canonical)| from_canonical.transform_vector3(*by - parent));
        Joint {
            rest_translation: bone.rest_translation + in_parent,
            joint_from_canonical: bone.joint_from_canonical * DMat4::from_translation(-*by),
            ..bone.clone()
        }
    });
    Skeleton::new(joints.collect())
}

/// Returns the mean displacement of the vertices that a joint shares with its parent, weighted by the smaller share; of the joint's
/// own vertices where it shares none.
fn shared_displacement(template: &Template, displacement: &[Vec3], joint: usize) -> DVec3 {
    let parent = template.skeleton.joints()[joint].parent;
    let share = |skin: &SkinWeights, of: usize| -> f32 {
        skin.joints.iter().zip(skin.weights).filter(|(j, _)| usize::from(**j) == of).map(|(_, weight)| weight).sum()
    };
    let mean = |weight: &dyn Fn(&SkinWeights) -> f32| {
        let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
        for (skin, by) in template.skin.iter().zip(displacement) {
            let weight = f64::from(weight(skin));
            sum += weight * by.as_dvec3();
            weights += weight;
        }
        (weights > 1e-6).then(|| sum / weights)
    };
    parent
        .and_then(|parent| mean(&|skin| share(skin, joint).min(share(skin, parent))))
        .or_else(|| mean(&|skin| share(skin, joint)))
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change() -> ShapeParams {
        ShapeParams::default().with("stomach-tone", -0.8).with("upperarm-scale-vert", 0.7)
    }

    #[test]
    fn the_built_in_body_becomes_the_one_of_that_shape() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let changed = body.reshape(&change()).unwrap();
        let expected = default_template(&change()).unwrap();
        let far = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!(far(&changed.template.positions, &expected.positions) < 1e-5);
        assert!(far(&changed.template.normals, &expected.normals) < 2e-3);
        assert!(changed.displacement.iter().any(|by| by.length() > 5e-3));
        for (a, b) in changed.template.skeleton.joints().iter().zip(expected.skeleton.joints()) {
            assert!((a.rest_translation - b.rest_translation).length() < 1e-6, "{}", a.name);
            assert!(a.joint_from_canonical.abs_diff_eq(b.joint_from_canonical, 1e-6), "{}", a.name);
        }
    }

    /// Local measures add up: on another body they change as much.
    #[test]
    fn local_measures_are_exact_on_every_body_and_clothes_follow() {
        let heavy = ShapeParams::heavy_man();
        let mut both = heavy.clone();
        both.0.extend(change().0);
        let expected = default_template(&both).unwrap();
        let mut body = default_template(&heavy).unwrap();
        // A vertex without a place on the built-in body, beside one at the stomach.
        let moved = body.reshape(&change()).unwrap().displacement;
        let most = (0..moved.len()).max_by(|a, b| moved[*a].length().total_cmp(&moved[*b].length())).unwrap();
        body.uvs[most] = Vec2::ZERO;
        let changed = body.reshape(&change()).unwrap();
        for (i, (a, b)) in changed.template.positions.iter().zip(&expected.positions).enumerate() {
            let bound = if i == most { 5e-3 } else { 1e-5 };
            assert!(a.distance(*b) < bound, "{i}: {}", a.distance(*b));
        }
    }

    #[test]
    fn joints_that_the_built_in_body_lacks_follow_the_skin() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let mut renamed = body.clone();
        let joints =
            body.skeleton.joints().iter().map(|joint| Joint { name: format!("x{}", joint.name), ..joint.clone() });
        renamed.skeleton = Skeleton::new(joints.collect()).unwrap();
        let tall = ShapeParams::default().with("height", 0.6);
        let (found, expected) = (renamed.reshape(&tall).unwrap(), body.reshape(&tall).unwrap());
        for (a, b) in found.template.skeleton.joints().iter().zip(expected.template.skeleton.joints()) {
            let far = (a.joint_from_canonical.w_axis - b.joint_from_canonical.w_axis).length();
            assert!(far < 0.03, "{}: {far}", a.name);
        }
    }

    #[test]
    fn other_bodies_and_targets_are_refused() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let refused = |body: &Template, change: &ShapeParams| body.reshape(change).unwrap_err().to_string();
        assert!(refused(&body, &ShapeParams::default().with("stomach", 0.1)).contains("stomach-"));
        assert!(refused(&body, &ShapeParams::default().with("stomach-tone", 7.0)).contains('7'));
        let mut bare = body.clone();
        bare.uvs.fill(Vec2::ZERO);
        assert!(refused(&bare, &change()).contains("texture coordinates"));
        let mut turned = body;
        turned.normals.iter_mut().for_each(|normal| normal.x = -normal.x);
        turned.positions.iter_mut().for_each(|place| place.x = -place.x);
        turned.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
        assert!(refused(&turned, &change()).contains("another pose"));
    }
}

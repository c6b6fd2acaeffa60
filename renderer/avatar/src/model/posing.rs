//! Posing of Gaussians from canonical space to the world, and its derivatives.
//!
//! A Gaussian's position is blended linearly from its bones (FlyHuman Eq. 1 and 2), its rotation by the normalised
//! blend of their quaternions.

use flyrig_body::{Skeleton, SkinWeights, displacement};
use flyrig_types::Pose;
use glam::{DMat4, DVec3, Mat3, Mat4, Quat, Vec3, Vec4};
use rayon::prelude::*;

use crate::model::avatar::Avatar;
use crate::model::parameters::GaussianParameters;
use flyrig_fit::Element;

/// Bounds of drawn scales, metres.
const SCALE_M: std::ops::RangeInclusive<f32> = 2e-4..=0.1;

/// Cosine between a surface's normal and the line of sight above which it is not drawn. Lower values cut the
/// silhouette, where fitted Gaussians are rounder than the mesh: 0.35 costs 0.09 dB on d1 (docs/benchmarks/avatar.md).
const AWAY: f32 = 0.7;

/// Rigid motions of the bones in one pose.
#[derive(Debug, Clone)]
pub struct Bones {
    world_from_canonical: Vec<(Mat4, Quat)>,
}

impl Bones {
    /// Computes the motions of a skeleton in a pose.
    #[must_use]
    pub fn new(skeleton: &Skeleton, pose: &Pose) -> Self {
        let of = |matrix: &DMat4| (matrix.as_mat4(), matrix.to_scale_rotation_translation().1.as_quat().normalize());
        Self { world_from_canonical: skeleton.world_from_canonical(pose).iter().map(of).collect() }
    }

    /// Returns bones that leave everything in canonical space.
    #[must_use]
    pub fn at_rest(skeleton: &Skeleton) -> Self {
        Self { world_from_canonical: vec![(Mat4::IDENTITY, Quat::IDENTITY); skeleton.joints().len()] }
    }

    /// Returns the bones that move a Gaussian, in the order of its weights.
    pub(crate) fn influences<'a>(&'a self, skin: &'a SkinWeights) -> impl Iterator<Item = Influence<'a>> {
        let mut sum = Vec4::ZERO;
        skin.joints.iter().zip(skin.weights).enumerate().filter_map(move |(slot, (&joint, weight))| {
            let joint = usize::from(joint);
            let (matrix, turn) = self.world_from_canonical.get(joint).filter(|_| weight > 0.0)?;
            let turn = Vec4::from(*turn);
            // A quaternion and its negative are the same turn.
            let turn = if sum.dot(turn) < 0.0 { -turn } else { turn };
            sum += turn * weight;
            Some(Influence { slot, joint, weight, matrix, turn })
        })
    }

    /// Blends the bones of a Gaussian: linear part and translation, and rotation. A Gaussian without weights stays at
    /// rest.
    fn blend(&self, skin: &SkinWeights) -> (Mat4, Quat) {
        let (mut matrix, mut rotation, mut sum) = (Mat4::ZERO, Vec4::ZERO, 0.0);
        for bone in self.influences(skin) {
            matrix += *bone.matrix * bone.weight;
            rotation += bone.turn * bone.weight;
            sum += bone.weight;
        }
        if sum <= 0.0 {
            return (Mat4::IDENTITY, Quat::IDENTITY);
        }
        (matrix * (1.0 / sum), Quat::from_vec4(rotation.normalize_or(Vec4::W)))
    }
}

/// Bone that moves a Gaussian.
pub(crate) struct Influence<'a> {
    /// Index in the Gaussian's list of weights.
    pub slot: usize,
    /// Index of the bone.
    pub joint: usize,
    /// Weight, above 0; those of a Gaussian need not have the sum 1.
    pub weight: f32,
    /// Transform to the world from canonical space.
    pub matrix: &'a Mat4,
    /// Quaternion of the same rotation, with the sign in which it is blended.
    pub turn: Vec4,
}

/// Motion of one Gaussian from canonical space to the world.
#[derive(Debug, Clone, Copy, Default)]
struct Place {
    canonical: Vec3,
    linear: Mat3,
    rotation: Quat,
    /// Growth of its scales where the surface is stretched.
    growth: f32,
    /// World normal of the surface that it is attached to.
    normal: Vec3,
}

/// Avatar in the world: elements for [`flyrig_renderer::AnisotropicBuffers`].
#[derive(Debug, Clone, Default)]
pub struct PosedAvatar {
    /// World centre, metres.
    pub center: Vec<Element>,
    /// Standard deviations, metres; w: opacity.
    pub scale_opacity: Vec<Element>,
    /// Quaternion x, y, z, w, world from the Gaussian's axes.
    pub rotation: Vec<Element>,
    /// Coefficients of the lit colours, as in [`GaussianParameters::harmonics`].
    pub harmonics: Vec<Element>,
    places: Vec<Place>,
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

fn scale(logarithm: f32) -> f32 {
    // `max` and `min` drop NaN.
    logarithm.exp().max(*SCALE_M.start()).min(*SCALE_M.end())
}

impl Avatar {
    /// Poses all Gaussians. `translations` are those of the graph's nodes, canonical metres; without them the mean of
    /// the take is used.
    pub fn pose(&self, bones: &Bones, translations: Option<&[DVec3]>, posed: &mut PosedAvatar) {
        let GaussianParameters { offset, shape, rotation, harmonics, .. } = &self.parameters;
        let nodes = self.hanging.as_ref();
        let translations = translations.or(nodes.map(|nodes| nodes.mean.as_slice())).unwrap_or_default();
        let count = self.places.len();
        posed.center.resize(count, Element::default());
        posed.scale_opacity.resize(count, Element::default());
        posed.rotation.resize(count, Element::default());
        posed.places.resize(count, Place::default());
        let PosedAvatar { center, scale_opacity, rotation: turned, places, .. } = &mut *posed;
        let rows = (center, scale_opacity, turned, places).into_par_iter().with_min_len(1024).enumerate();
        rows.for_each(|(i, (center, scale_opacity, turned, place))| {
            let (blend, turn) = bones.blend(&self.skin[i]);
            let moved = nodes.map_or([0.0; 4], |hanging| {
                displacement(&hanging.nodes, translations, hanging.gaussian_nodes[i], hanging.gaussian_weights[i])
            });
            let canonical = self.places[i] + Vec4::from(moved).truncate() + Vec4::from(offset[i]).truncate();
            let [x, y, z, logit] = shape[i];
            let growth = 1.0 + moved[3];
            let [sx, sy, sz] = [x, y, z].map(|logarithm| growth * scale(logarithm));
            *center = blend.transform_point3(canonical).extend(0.0).to_array();
            *scale_opacity = [sx, sy, sz, sigmoid(logit)];
            *turned = (turn * Quat::from_array(rotation[i])).to_array();
            let normal = turn * self.attachments[i].blend(&self.template, &self.template.normals).normalize_or_zero();
            *place = Place { canonical, linear: Mat3::from_mat4(blend), rotation: turn, growth, normal };
        });
        let coefficients = self.parameters.order().coefficients();
        posed.harmonics.clone_from(harmonics);
        posed.harmonics.par_chunks_mut(coefficients).zip(&posed.places).with_min_len(1024).for_each(|(rows, place)| {
            let shade = self.light.shade(place.normal);
            rows.iter_mut().for_each(|row| (0..3).for_each(|k| row[k] *= shade[k]));
        });
    }
}

/// Largest number of the take's poses over which shades are averaged.
const SHADED_POSES: usize = 8;

impl Avatar {
    /// Returns the mean light factors of each Gaussian over the take's poses; those of the mean direction where no pose
    /// is known.
    pub(crate) fn mean_shades(&self) -> Vec<Vec3> {
        let poses = &self.known_poses.0;
        let [constant, ..] = self.light.terms;
        let mut sums = vec![if poses.is_empty() { Vec3::from(constant) } else { Vec3::ZERO }; self.places.len()];
        let normals = self.normals();
        let chosen: Vec<_> = poses.iter().step_by(poses.len().div_ceil(SHADED_POSES).max(1)).collect();
        for rotations in &chosen {
            let pose = Pose { root_translation: DVec3::ZERO, joint_rotations: (*rotations).clone() };
            let bones = Bones::new(&self.template.skeleton, &pose);
            let rows = sums.par_iter_mut().zip(&self.skin).zip(&normals).with_min_len(1024);
            rows.for_each(|((sum, skin), normal)| {
                *sum += Vec3::from(self.light.shade(bones.blend(skin).1 * *normal)) / chosen.len() as f32;
            });
        }
        sums
    }
}

impl PosedAvatar {
    /// Copies scales and opacities, with zero for Gaussians whose surface faces away from `eye`: opacities are below 1,
    /// so that the far side of the body would show through the near one. Returns the number of such Gaussians.
    pub(crate) fn facing(&self, eye: Vec3, scale_opacity: &mut Vec<Element>) -> usize {
        scale_opacity.clone_from(&self.scale_opacity);
        let mut hidden = 0;
        for ((row, center), place) in scale_opacity.iter_mut().zip(&self.center).zip(&self.places) {
            let away = Vec4::from(*center).truncate() - eye;
            if place.normal.dot(away) > AWAY * away.length() {
                row[3] = 0.0;
                hidden += 1;
            }
        }
        hidden
    }

    /// Turns derivatives with respect to the lit colours into those of the unlit ones, in place, and returns those of the light's terms.
    pub(crate) fn to_light(&self, avatar: &Avatar, slopes: &mut [Element]) -> [[f32; 3]; 9] {
        let GaussianParameters { harmonics, .. } = &avatar.parameters;
        let normal = |i: usize| self.places.get(i).map_or(Vec3::ZERO, |place| place.normal);
        avatar.light.backward(normal, harmonics, slopes, avatar.parameters.order().coefficients())
    }

    /// Returns the world unit normal of the surface at each Gaussian.
    #[must_use]
    pub fn normals(&self) -> impl ExactSizeIterator<Item = Vec3> {
        self.places.iter().map(|place| place.normal)
    }

    /// Returns the canonical position of each posed Gaussian, including deformation and offset, metres.
    pub(crate) fn canonical(&self) -> impl ExactSizeIterator<Item = Vec3> {
        self.places.iter().map(|place| place.canonical)
    }

    /// Turns derivatives with respect to centres, scales and opacities, and rotations in the world into those of the parameters, in place:
    /// offsets, logarithms and logits, canonical rotations.
    pub(crate) fn to_parameters(&self, derivatives: [&mut [Element]; 3]) {
        let [centers, scales, rotations] = derivatives;
        let rows = centers.par_iter_mut().zip(scales).zip(rotations).with_min_len(1024);
        rows.zip(&self.places).zip(&self.scale_opacity).for_each(|((((center, scale), rotation), place), posed)| {
            *center = (place.linear.transpose() * Vec4::from(*center).truncate()).extend(0.0).to_array();
            for k in 0..3 {
                let canonical = posed[k] / place.growth;
                // At its bounds a scale does not move.
                let moves = canonical > *SCALE_M.start() && canonical < *SCALE_M.end();
                scale[k] *= if moves { posed[k] } else { 0.0 };
            }
            scale[3] *= posed[3] * (1.0 - posed[3]);
            *rotation = (place.rotation.conjugate() * Quat::from_array(*rotation)).to_array();
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::avatar::tests::{random_pose, small};

    /// Computes a loss that weights every number of the posed avatar.
    fn loss(avatar: &Avatar, bones: &Bones, translations: &[DVec3], weights: &[[Element; 3]]) -> f64 {
        let mut posed = PosedAvatar::default();
        avatar.pose(bones, Some(translations), &mut posed);
        let rows = posed.center.iter().zip(&posed.scale_opacity).zip(&posed.rotation).zip(weights);
        let dot = |a: &Element, b: &Element| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
        rows.map(|(((center, scales), rotation), weight)| {
            dot(center, &weight[0]) + dot(scales, &weight[1]) + dot(rotation, &weight[2])
        })
        .sum()
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let mut avatar = small(400, 7);
        let (pose, translations) = random_pose(&avatar, 3);
        let bones = Bones::new(&avatar.template.skeleton, &pose);
        let weights: Vec<[Element; 3]> = (0..avatar.places.len())
            .map(|i| [0, 1, 2].map(|list| [0, 1, 2, 3].map(|k| ((i * 12 + list * 4 + k) as f32 * 1.7).sin())))
            .collect();
        let mut posed = PosedAvatar::default();
        avatar.pose(&bones, Some(&translations), &mut posed);
        let mut slopes: [Vec<Element>; 3] = [0, 1, 2].map(|list| weights.iter().map(|row| row[list]).collect());
        let [centers, scales, rotations] = &mut slopes;
        posed.to_parameters([centers, scales, rotations]);
        let step = 1e-2f32;
        for (list, found) in slopes.iter().enumerate() {
            for i in (0..avatar.places.len()).step_by(37) {
                for k in 0..4 {
                    if list == 0 && k == 3 {
                        continue;
                    }
                    let mut at = |by: f32| {
                        avatar.parameters.lists_mut()[list][i][k] += by;
                        let found = loss(&avatar, &bones, &translations, &weights);
                        avatar.parameters.lists_mut()[list][i][k] -= by;
                        found
                    };
                    let expected = (at(step) - at(-step)) / f64::from(2.0 * step);
                    let error = (expected - f64::from(found[i][k])).abs();
                    assert!(error < 2e-3 * (expected.abs() + 0.05), "{list} {i} {k}: {expected} {}", found[i][k]);
                }
            }
        }
    }

    #[test]
    fn mean_shades_are_those_of_the_poses() {
        let mut avatar = small(400, 7);
        avatar.light.terms[1] = [0.5, 0.2, -0.3];
        avatar.light.terms[4] = [0.1; 3];
        let constant = Vec3::from(avatar.light.terms[0]);
        assert!(avatar.mean_shades().iter().all(|shade| shade.distance(constant) < 1e-6));
        let poses = [1, 2].map(|seed| random_pose(&avatar, seed).0);
        avatar.known_poses = crate::model::known_poses::KnownPoses::new(&poses);
        avatar.parameters.harmonics.fill([1.0; 4]);
        let lit = poses.map(|pose| {
            let mut posed = PosedAvatar::default();
            avatar.pose(&Bones::new(&avatar.template.skeleton, &pose), None, &mut posed);
            posed.harmonics
        });
        let coefficients = avatar.parameters.order().coefficients();
        for (i, shade) in avatar.mean_shades().into_iter().enumerate() {
            let expected = lit.each_ref().map(|lit| Vec3::from_slice(&lit[i * coefficients]));
            assert!(shade.distance((expected[0] + expected[1]) / 2.0) < 1e-4, "{i}: {shade}");
        }
    }

    #[test]
    fn the_far_side_is_left_out() {
        let avatar = small(2000, 7);
        let bones = Bones::new(&avatar.template.skeleton, &avatar.template.skeleton.rest_pose());
        let mut posed = PosedAvatar::default();
        avatar.pose(&bones, None, &mut posed);
        let mut shown = Vec::new();
        // From the front, and from behind: together they draw every Gaussian, and those at the sides twice.
        let mut count = |z: f32| {
            let hidden = posed.facing(Vec3::new(0.0, 1.0, z), &mut shown);
            assert_eq!(hidden, shown.iter().filter(|row| row[3] <= 0.0).count());
            2000 - hidden
        };
        let (front, back) = (count(4.0), count(-4.0));
        assert!(front + back > 2000 && front < 1800 && back < 1800, "{front} {back}");
        assert_eq!(posed.facing(Vec3::NAN, &mut shown), 0);
    }

    #[test]
    fn the_rest_pose_changes_nothing_and_poison_stays_where_it_is() {
        let mut avatar = small(40, 7);
        let bones = Bones::new(&avatar.template.skeleton, &avatar.template.skeleton.rest_pose());
        let zeros = vec![DVec3::ZERO; avatar.hanging.as_ref().unwrap().nodes.len()];
        let mut posed = PosedAvatar::default();
        avatar.parameters.offset[1] = [f32::NAN; 4];
        avatar.parameters.shape[2] = [f32::INFINITY, f32::NEG_INFINITY, f32::NAN, f32::NAN];
        avatar.skin[3].weights = [0.0; 4];
        avatar.skin[4].joints = [u16::MAX; 4];
        avatar.pose(&bones, Some(&zeros), &mut posed);
        for (i, center) in posed.center.iter().map(|row| Vec4::from(*row).truncate()).enumerate() {
            let expected = avatar.places[i] + Vec4::from(avatar.parameters.offset[i]).truncate();
            assert!(i == 1 || (center - expected).length() < 1e-4, "{i}: {center} {expected}");
        }
        assert!(posed.scale_opacity[2][..3].iter().all(|scale| scale.is_finite()));
        // Translations that are missing count as none.
        let mut short = PosedAvatar::default();
        avatar.pose(&bones, Some(&[]), &mut short);
        assert!((short.center[9][0] - posed.center[9][0]).abs() < 1e-6);
    }
}

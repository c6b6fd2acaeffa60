//! Skirt or lower half of a coat: one surface around both legs.

use glam::{Vec2, Vec3};

use crate::part::part_of_joints;
use crate::rings::{add_rings, convex_radii, cut, direction, kept};
use crate::{BodyError, Part, Skeleton, SkinWeights, Template};

/// Vertices around a ring, and distance between two rings, metres.
const AROUND: usize = 60;
const RING_M: f32 = 0.025;
/// Height of the waistband above the hip joints, metres; the body reaches below it, so that no gap opens.
const ABOVE_HIPS_M: f32 = 0.06;
const OVERLAP_M: f32 = 0.05;
/// Distance of the skirt from the body, metres.
const CLEARANCE_M: f32 = 0.004;
/// Fraction of the thighs' movement that a skirt follows at the knees; less above.
const FOLLOWS_THIGHS: f32 = 0.8;
/// Distance below the hip joints at which legs no longer follow the hips, metres, and least share of the hips in what hangs from them.
const BELOW_HIPS_M: f32 = 0.2;
const LEAST_OF_HIPS: f32 = 0.1;
/// Half of the width over which the weights blend from left to right, metres.
const BLEND_M: f32 = 0.12;

/// Shape of a skirt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Skirt {
    /// Height of the hem below the hip joints, as a fraction of the distance to the ankles: 0.55 ends at the knees.
    pub length: f32,
    /// Flare, metres outwards per metre down, relative to a skirt that hangs straight from the hips.
    pub flare: f32,
}

/// Permitted lengths and flares.
const LENGTHS: std::ops::RangeInclusive<f32> = 0.15..=1.0;
const FLARES: std::ops::RangeInclusive<f32> = 0.0..=1.0;

impl Skirt {
    /// Returns the body in this skirt, without the hidden surface of hips and legs and with unchanged joints.
    ///
    /// The skirt hangs straight down from the widest point above, around the convex outline of both legs, and flares. Its skin weights
    /// blend from the left to the right thigh, and from hips to thighs on the way down.
    ///
    /// # Errors
    /// [`BodyError::Mesh`] for a template that is not valid, one without hips, thighs and feet by the usual names, or a length (0.15 to 1)
    /// or flare (0 to 1) out of range.
    pub fn on(self, body: &Template) -> Result<Template, BodyError> {
        body.check()?;
        let fail = |message: String| BodyError::Mesh { name: body.name.clone(), message };
        if !LENGTHS.contains(&self.length) || !FLARES.contains(&self.flare) {
            return Err(fail(format!(
                "a skirt of length {} and flare {}; they must lie in 0.15..=1 and 0..=1",
                self.length, self.flare
            )));
        }
        let legs = Legs::new(&body.skeleton).ok_or_else(|| {
            fail("joints Hips, LeftUpLeg, RightUpLeg, LeftFoot and RightFoot are needed for a skirt".to_owned())
        })?;
        let top = legs.hip_y + ABOVE_HIPS_M;
        let hem = legs.hip_y - self.length * (legs.hip_y - legs.ankle_y);
        let part_of_joint = part_of_joints(&body.skeleton);
        let is_arm = |vertex: u32| {
            let joint = usize::from(body.skin[vertex as usize].joints[0]);
            matches!(part_of_joint[joint], Part::LeftArm | Part::RightArm | Part::LeftHand | Part::RightHand)
        };
        let trunk: Vec<[u32; 3]> =
            body.triangles.iter().filter(|triangle| !triangle.iter().any(|v| is_arm(*v))).copied().collect();

        let rings = ((top - hem) / RING_M).ceil().max(2.0) as usize;
        let mut radii = [0.0f32; AROUND];
        let mut points = Vec::with_capacity((rings + 1) * AROUND);
        for ring in 0..=rings {
            let y = top + (hem - top) * ring as f32 / rings as f32;
            let outline = convex_radii::<AROUND>(&cut(body, &trunk, y), legs.centre);
            if ring == 0 && outline.iter().any(|radius| *radius <= CLEARANCE_M) {
                return Err(fail("there is no surface around the hips for a skirt to hang on".to_owned()));
            }
            for (radius, outline) in radii.iter_mut().zip(outline) {
                *radius = (*radius + self.flare * (top - hem) / rings as f32 * f32::from(ring > 0))
                    .max(outline + CLEARANCE_M);
            }
            points.extend((0..AROUND).map(|k| {
                let at = legs.centre + direction::<AROUND>(k) * radii[k];
                Vec3::new(at.x, y, at.y)
            }));
        }

        let is_hidden = |vertex: u32| {
            let y = body.positions[vertex as usize].y;
            !is_arm(vertex) && y > hem && y < top - OVERLAP_M
        };
        let left: Vec<[u32; 3]> =
            body.triangles.iter().filter(|triangle| !triangle.iter().all(|v| is_hidden(*v))).copied().collect();
        let mut dressed = kept(body, &left);
        add_rings::<AROUND>(&mut dressed, &points, Part::Torso, |point| legs.weights(point));
        dressed.check()?;
        Ok(dressed)
    }
}

/// Returns whether a point of a surface, canonical metres, hangs from the hips as a skirt does: well below the hip joints it still follows the
/// hips. Trousers do not. False for a skeleton without hips, thighs and feet by the usual names.
pub fn hangs_from_hips(skeleton: &Skeleton) -> impl Fn(Vec3, &SkinWeights) -> bool + use<> {
    let legs = Legs::new(skeleton);
    move |point, skin| {
        legs.as_ref().is_some_and(|legs| {
            let of_hips = skin.joints.iter().zip(skin.weights).filter(|(joint, _)| **joint == legs.hips);
            point.y < legs.hip_y - BELOW_HIPS_M && of_hips.map(|(_, weight)| weight).sum::<f32>() > LEAST_OF_HIPS
        })
    }
}

/// Geometry of the legs, canonical metres.
struct Legs {
    hips: u16,
    left: u16,
    right: u16,
    hip_y: f32,
    ankle_y: f32,
    /// Middle between the hip joints (x, z).
    centre: Vec2,
}

impl Legs {
    fn new(skeleton: &Skeleton) -> Option<Self> {
        let origins = skeleton.canonical_origins();
        let place = |name: &str| Some(origins[skeleton.joint(name)?].as_vec3());
        let (left, right) = (place("LeftUpLeg")?, place("RightUpLeg")?);
        let (feet, hips) = (0.5 * (place("LeftFoot")?.y + place("RightFoot")?.y), 0.5 * (left + right));
        let index = |name: &str| u16::try_from(skeleton.joint(name)?).ok();
        (hips.y > feet + 0.1).then_some(Self {
            hips: index("Hips")?,
            left: index("LeftUpLeg")?,
            right: index("RightUpLeg")?,
            hip_y: hips.y,
            ankle_y: feet,
            centre: Vec2::new(hips.x, hips.z),
        })
    }

    fn weights(&self, point: Vec3) -> SkinWeights {
        let knee = 0.5 * (self.hip_y + self.ankle_y);
        let down = ((self.hip_y + ABOVE_HIPS_M - point.y) / (self.hip_y + ABOVE_HIPS_M - knee)).clamp(0.0, 1.0);
        let thighs = FOLLOWS_THIGHS * down;
        let aside = ((point.x - self.centre.x) / BLEND_M).clamp(-1.0, 1.0);
        // Smooth at both ends.
        let left = 0.5 + 0.25 * aside * (3.0 - aside * aside);
        let influences = [(self.hips, 1.0 - thighs), (self.left, thighs * left), (self.right, thighs * (1.0 - left))];
        SkinWeights::strongest(&influences)
            .unwrap_or(SkinWeights { joints: [self.hips; 4], weights: [1.0, 0.0, 0.0, 0.0] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ShapeParams, default_template, sample_surface, skin_mesh};
    use glam::DQuat;

    fn body() -> Template {
        default_template(&ShapeParams::default()).unwrap()
    }

    #[test]
    fn a_skirt_closes_the_gap_between_the_legs_and_faces_outwards() {
        let body = body();
        let skirt = Skirt { length: 0.6, flare: 0.2 };
        let dressed = skirt.on(&body).unwrap();
        let legs = Legs::new(&body.skeleton).unwrap();
        let hem = legs.hip_y - 0.6 * (legs.hip_y - legs.ankle_y);
        // In front of the gap, at every height of the skirt, there is a surface that faces the front.
        for step in 1..20 {
            let y = hem + (legs.hip_y - hem) * step as f32 / 20.0;
            let faces = dressed.triangles.iter().filter_map(|triangle| {
                let [a, b, c] = triangle.map(|v| dressed.positions[v as usize]);
                let inside = [a, b, c].iter().any(|p| p.x <= 0.0) && [a, b, c].iter().any(|p| p.x >= 0.0);
                let around = [a, b, c].iter().any(|p| p.y <= y) && [a, b, c].iter().any(|p| p.y >= y);
                (inside && around).then(|| (b - a).cross(c - a))
            });
            let faces: Vec<Vec3> = faces.collect();
            assert!(faces.iter().any(|n| n.z > 0.0) && faces.iter().any(|n| n.z < 0.0), "at {y}: {faces:?}");
        }
        for (at, triangle) in dressed.triangles.iter().rev().take(AROUND * 10).enumerate() {
            let [a, b, c] = triangle.map(|v| dressed.positions[v as usize]);
            let normal = (b - a).cross(c - a);
            assert!(normal.dot(dressed.normals[triangle[0] as usize]) > 0.0, "triangle {at} from the end");
            let outwards = a - Vec3::new(legs.centre.x, a.y, legs.centre.y);
            assert!(normal.dot(outwards) > 0.0, "triangle {at} from the end faces inwards");
        }
        // No leg is left inside of it, both feet are.
        let inside = |p: &&Vec3| p.y > hem + 0.01 && p.y < legs.hip_y - 0.01 && p.truncate().x.abs() < 0.05;
        assert!(body.positions.iter().filter(inside).count() > 20);
        assert!(dressed.positions.iter().filter(|p| p.y < 0.05).count() > 100);
        sample_surface(&dressed, 5_000, 1).unwrap();
    }

    #[test]
    fn a_skirt_is_outside_of_the_body_and_follows_its_thighs() {
        let body = body();
        let dressed = Skirt { length: 0.5, flare: 0.1 }.on(&body).unwrap();
        let legs = Legs::new(&body.skeleton).unwrap();
        let start = dressed.positions.len() - dressed.positions.len() % AROUND;
        assert!(start > 0);
        let hem = &dressed.positions[dressed.positions.len() - AROUND..];
        for point in &body.positions {
            if (point.y - hem[0].y).abs() < 0.01 && point.x.abs() < 0.35 {
                let from = Vec2::new(point.x, point.z) - legs.centre;
                let nearest = (0..AROUND)
                    .max_by(|a, b| direction::<AROUND>(*a).dot(from).total_cmp(&direction::<AROUND>(*b).dot(from)));
                let radius = (Vec2::new(hem[nearest.unwrap()].x, hem[nearest.unwrap()].z) - legs.centre).length();
                assert!(from.length() < radius + 0.003, "{point} is outside of the skirt");
            }
        }
        // Lifted legs carry the hem's front along.
        let mut pose = body.skeleton.rest_pose();
        for name in ["LeftUpLeg", "RightUpLeg"] {
            pose.joint_rotations[body.skeleton.joint(name).unwrap()] = DQuat::from_rotation_x(-1.0);
        }
        let before = skin_mesh(&dressed, &body.skeleton.rest_pose()).0;
        let after = skin_mesh(&dressed, &pose).0;
        let last = after.len() - AROUND..after.len();
        let raised = last.clone().map(|i| after[i].z - before[i].z).fold(f32::NEG_INFINITY, f32::max);
        assert!(raised > 0.1, "{raised}");
        assert!(after.iter().all(|p| p.is_finite()));
    }

    #[test]
    fn a_skirt_hangs_from_the_hips_and_legs_do_not() {
        let body = body();
        let dressed = Skirt { length: 0.8, flare: 0.3 }.on(&body).unwrap();
        let hangs = hangs_from_hips(&body.skeleton);
        let count = |template: &Template| {
            template.positions.iter().zip(&template.skin).filter(|(point, skin)| hangs(**point, skin)).count()
        };
        assert_eq!(count(&body), 0);
        let legs = Legs::new(&body.skeleton).unwrap();
        let rings = dressed.positions.iter().rev().take(AROUND * 8);
        assert!(rings.clone().all(|point| point.y < legs.hip_y - 0.2), "the lower rings are the last");
        assert!(count(&dressed) >= AROUND * 8, "{}", count(&dressed));
        assert!(!hangs(Vec3::NAN, &dressed.skin[0]));
        let nameless = Skeleton::new(vec![]).map(|skeleton| hangs_from_hips(&skeleton)(Vec3::ZERO, &dressed.skin[0]));
        assert!(!nameless.unwrap_or(false));
    }

    #[test]
    fn sizes_and_bodies_that_carry_no_skirt_are_refused() {
        let body = body();
        for (length, flare) in [(0.0, 0.1), (1.5, 0.1), (f32::NAN, 0.1), (0.5, -0.1), (0.5, f32::INFINITY)] {
            assert!(Skirt { length, flare }.on(&body).is_err(), "{length}, {flare}");
        }
        let skirt = Skirt { length: 0.5, flare: 0.1 };
        let mut damaged = body.clone();
        damaged.positions[7].x = f32::NAN;
        assert!(skirt.on(&damaged).is_err());
        let mut armless = body;
        armless.triangles.truncate(1);
        let refused = skirt.on(&armless);
        assert!(refused.is_err(), "a body without legs");
    }
}

//! Tapered capsules in limbs and trunk that push cloth out of the body.

use flyrig_body::Part;
use glam::{DMat4, Vec3};

use crate::person::assembly::Person;

/// Distance of cloth from the surface below it, metres.
const APART_M: f32 = 0.007;
/// Consecutive capsules per limb.
const PIECES: usize = 2;

/// Capsule between two points with a radius at each, fixed to a joint.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Limb {
    joint: usize,
    ends: [Vec3; 2],
    radii: [f32; 2],
}

/// Capsule in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Capsule {
    pub ends: [Vec3; 2],
    pub radii: [f32; 2],
}

/// Capsules of a body.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Colliders {
    limbs: Vec<Limb>,
}

impl Colliders {
    /// Fits the capsules to a person's body and tight clothes at rest; missing bones get none.
    pub(crate) fn fitted(person: &Person) -> Self {
        let body = &person.body;
        let worn = person.sheets.iter().filter(|sheet| !sheet.hangs).flat_map(|sheet| sheet.vertices.clone());
        let worn = worn.map(|v| (person.clothed.positions[v], person.clothed.parts[v]));
        let points: Vec<(Vec3, Part)> =
            body.positions.iter().copied().zip(body.parts.iter().copied()).chain(worn).collect();
        let mut limbs = Vec::new();
        let origins = body.skeleton.canonical_origins();
        for (from, to, parts) in [
            ("LeftUpLeg", "LeftLeg", [Part::LeftLeg; 2]),
            ("RightUpLeg", "RightLeg", [Part::RightLeg; 2]),
            ("LeftLeg", "LeftFoot", [Part::LeftLeg, Part::LeftFoot]),
            ("RightLeg", "RightFoot", [Part::RightLeg, Part::RightFoot]),
        ] {
            let (Some(joint), Some(end)) = (body.skeleton.joint(from), body.skeleton.joint(to)) else { continue };
            let (a, b) = (origins[joint].as_vec3(), origins[end].as_vec3());
            for piece in 0..PIECES {
                let at = |share: usize| a.lerp(b, share as f32 / PIECES as f32);
                limbs.extend(fitted_limb(&points, joint, [at(piece), at(piece + 1)], parts));
            }
        }
        for (name, half_height_m) in [("Hips", 0.05), ("LowerBack", 0.05), ("Spine1", 0.07)] {
            let Some(joint) = body.skeleton.joint(name) else { continue };
            limbs.extend(fitted_slab(&points, joint, origins[joint].y as f32, half_height_m));
        }
        Self { limbs }
    }

    /// Returns the capsules in canonical space.
    pub(crate) fn at_rest(&self) -> Vec<Capsule> {
        self.limbs.iter().map(|limb| Capsule { ends: limb.ends, radii: limb.radii }).collect()
    }

    /// Returns the capsules in the world, given the skinning matrices.
    pub(crate) fn placed(&self, world_from_canonical: &[DMat4]) -> Vec<Capsule> {
        let place = |limb: &Limb| {
            let matrix = world_from_canonical.get(limb.joint)?.as_mat4();
            let ends = limb.ends.map(|end| matrix.transform_point3(end));
            ends.iter().all(|end| end.is_finite()).then_some(Capsule { ends, radii: limb.radii })
        };
        self.limbs.iter().filter_map(place).collect()
    }
}

/// Fits a piece of a limb, at both ends as wide as 19 of 20 points around it.
fn fitted_limb(points: &[(Vec3, Part)], joint: usize, ends: [Vec3; 2], parts: [Part; 2]) -> Option<Limb> {
    let [a, b] = ends;
    let axis = (b - a).try_normalize()?;
    let length = a.distance(b);
    let radius = |low: f32, high: f32| {
        let mut distances: Vec<f32> = points
            .iter()
            .filter(|(_, part)| parts.contains(part))
            .filter_map(|(p, _)| {
                let along = (*p - a).dot(axis) / length;
                (low..high).contains(&along).then(|| (*p - a - axis * along * length).length())
            })
            .collect();
        distances.sort_by(f32::total_cmp);
        distances.get(distances.len() * 19 / 20).copied()
    };
    let radii = [radius(-0.1, 0.3)?, radius(0.7, 1.1)?];
    Some(Limb { joint, ends, radii: radii.map(|r| r + APART_M) })
}

/// Fits a horizontal capsule as wide and deep as the trunk at a height.
fn fitted_slab(points: &[(Vec3, Part)], joint: usize, y: f32, half_height_m: f32) -> Option<Limb> {
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for (p, part) in points {
        if matches!(part, Part::Torso | Part::LeftLeg | Part::RightLeg) && (p.y - y).abs() < half_height_m {
            (low, high) = (low.min(*p), high.max(*p));
        }
    }
    if !(low.is_finite() && high.is_finite()) {
        return None;
    }
    let radius = 0.5 * (high.z - low.z);
    let reach = (0.5 * (high.x - low.x) - radius).max(0.0);
    let middle = Vec3::new(0.0, y, 0.5 * (low.z + high.z));
    let ends = [middle + Vec3::X * reach, middle - Vec3::X * reach];
    Some(Limb { joint, ends, radii: [radius; 2] })
}

impl Capsule {
    /// Returns the depth of a point inside and the direction outwards; `None` outside.
    pub(crate) fn depth(&self, p: Vec3) -> Option<(f32, Vec3)> {
        let [a, b] = self.ends;
        let axis = b - a;
        let t = ((p - a).dot(axis) / axis.length_squared().max(1e-12)).clamp(0.0, 1.0);
        let out = p - (a + axis * t);
        let radius = self.radii[0] + (self.radii[1] - self.radii[0]) * t;
        let distance_squared = out.length_squared();
        if distance_squared >= radius * radius {
            return None;
        }
        let distance = distance_squared.sqrt();
        // On the very axis any way out is as good.
        let direction = if distance > 1e-6 { out / distance } else { axis.any_orthonormal_vector() };
        Some((radius - distance, direction))
    }
}

//! Capsules that approximate a person's limbs for ambient occlusion: on the person and on the floor.

use flyrig_types::Pose;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::draw::moment::ShadeCapsule;
use crate::person::assembly::Person;

/// Capsules of a person at rest, and the capsules that occlude each vertex.
#[derive(Debug)]
pub(crate) struct Limbs {
    limbs: Vec<Limb>,
    /// Joint per vertex of the clothed surface.
    joint: Vec<usize>,
    /// Per joint: bit set of the limbs that it belongs to or hangs on.
    own: Vec<u64>,
}

#[derive(Debug)]
struct Limb {
    joint: usize,
    /// Canonical positions, metres.
    a: DVec3,
    b: DVec3,
    radius_m: f32,
}

impl Limbs {
    /// Creates capsules of the thickest bones.
    pub(crate) fn new(person: &Person) -> Self {
        /// Most capsules: they fit twice into the shader's list, and into a bit set.
        const MOST: usize = 24;
        /// Radius below which a limb's occlusion is invisible, metres.
        const THIN_M: f32 = 0.02;
        let skeleton = &person.body.skeleton;
        let joints = skeleton.joints().len();
        let strongest = |weights: &[f32; 4]| (0..4).max_by(|&a, &b| weights[a].total_cmp(&weights[b])).unwrap_or(0);
        let joint: Vec<usize> =
            person.clothed.skin.iter().map(|skin| usize::from(skin.joints[strongest(&skin.weights)])).collect();
        let origins = skeleton.canonical_origins();
        // Limbs are as thick as the body; cloth that hangs free has its own shape.
        let of_body: Vec<(usize, DVec3)> = (person.body.skin.iter().zip(&person.body.positions))
            .map(|(skin, p)| (usize::from(skin.joints[strongest(&skin.weights)]), p.as_dvec3()))
            .collect();
        let mut limbs = Vec::new();
        for bone in 0..joints {
            let carried: Vec<DVec3> = of_body.iter().filter(|(of, _)| *of == bone).map(|(_, p)| *p).collect();
            if carried.len() < 24 {
                continue;
            }
            let a = origins[bone];
            let middle = carried.iter().sum::<DVec3>() / carried.len() as f64;
            let farthest = skeleton
                .children(bone)
                .map(|child| origins[child])
                .max_by(|p, q| p.distance_squared(a).total_cmp(&q.distance_squared(a)));
            let b = farthest.unwrap_or(a + (middle - a) * 1.5);
            let mut away: Vec<f32> = carried.iter().map(|p| distance_to_segment(*p, a, b) as f32).collect();
            away.sort_by(f32::total_cmp);
            let radius_m = away[away.len() / 2];
            if radius_m > THIN_M {
                limbs.push(Limb { joint: bone, a, b, radius_m });
            }
        }
        limbs.sort_by(|p, q| q.radius_m.total_cmp(&p.radius_m));
        limbs.truncate(MOST);
        let parent = |j: usize| skeleton.joints()[j].parent;
        let related =
            |limb: &Limb, j: usize| limb.joint == j || parent(limb.joint) == Some(j) || parent(j) == Some(limb.joint);
        let own = (0..joints)
            .map(|j| (0u32..).zip(&limbs).filter(|(_, limb)| related(limb, j)).map(|(i, _)| 1u64 << i).sum())
            .collect();
        Self { limbs, joint, own }
    }

    /// Returns the capsules of a pose, world metres.
    pub(crate) fn posed(&self, person: &Person, pose: &Pose) -> Vec<ShadeCapsule> {
        let world_from_canonical = person.body.skeleton.world_from_canonical(pose);
        let at = |joint: usize, p: DVec3| world_from_canonical[joint].transform_point3(p).as_vec3().to_array();
        self.limbs
            .iter()
            .map(|limb| ShadeCapsule {
                a: at(limb.joint, limb.a),
                radius: limb.radius_m,
                b: at(limb.joint, limb.b),
                padding: 0.0,
            })
            .collect()
    }

    /// Returns per vertex the fraction of the surroundings that creases and other limbs leave free.
    pub(crate) fn openness(
        &self,
        person: &Person,
        positions: &[Vec3],
        normals: &[Vec3],
        capsules: &[ShadeCapsule],
    ) -> Vec<f32> {
        let creases = person.layer_and_openness.par_iter().map(|&(_, open)| open);
        (positions.par_iter().zip(normals).zip(&self.joint).zip(creases))
            .map(|(((&p, &n), &joint), crease)| {
                let own = self.own.get(joint).copied().unwrap_or(0);
                let others = (0u32..).zip(capsules).filter(|(i, _)| own >> i & 1 == 0);
                let open: f32 = others.map(|(_, capsule)| 1.0 - 0.8 * covered(capsule, p, n)).product();
                crease * open.max(0.2)
            })
            .collect()
    }
}

/// Returns the fraction of the cosine-weighted surroundings of a surface point that a ball at the capsule's closest
/// point covers (a ball of radius r above the horizon at distance d covers r² / d² times the cosine of its direction).
fn covered(capsule: &ShadeCapsule, p: Vec3, n: Vec3) -> f32 {
    let (a, b) = (Vec3::from(capsule.a), Vec3::from(capsule.b));
    let along = b - a;
    let t = ((p - a).dot(along) / along.length_squared().max(1e-9)).clamp(0.0, 1.0);
    let away = a + along * t - p;
    let d2 = away.length_squared();
    let r2 = capsule.radius * capsule.radius;
    // Far limbs do not count, and inside one there is no outside.
    if d2 > 36.0 * r2 || d2 < 0.3 * r2 {
        return 0.0;
    }
    let d = d2.sqrt();
    let inside = ((d / capsule.radius - 0.55) / 0.45).clamp(0.0, 1.0);
    (away.dot(n) / d).max(0.0) * (r2 / d2).min(1.0) * inside
}

fn distance_to_segment(p: DVec3, a: DVec3, b: DVec3) -> f64 {
    let along = b - a;
    let t = ((p - a).dot(along) / along.length_squared().max(1e-12)).clamp(0.0, 1.0);
    p.distance(a + along * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares with rays over the hemisphere, in f64.
    #[test]
    fn a_ball_covers_as_much_as_rays_say() {
        let ball = |x: f32, z: f32, radius: f32| ShadeCapsule { a: [x, 0.0, z], radius, b: [x, 0.0, z], padding: 0.0 };
        for (x, z, radius) in [(0.0, 0.3, 0.1), (0.2, 0.3, 0.12), (0.4, 0.25, 0.1)] {
            let (mut hit, mut all) = (0.0, 0.0);
            for i in 0..400 {
                for j in 0..400 {
                    let (u, v) = ((f64::from(i) + 0.5) / 400.0, (f64::from(j) + 0.5) / 400.0);
                    let (sin, cos) = (v * std::f64::consts::TAU).sin_cos();
                    let ray = DVec3::new(u.sqrt() * cos, u.sqrt() * sin, (1.0 - u).sqrt());
                    let center = DVec3::new(f64::from(x), 0.0, f64::from(z));
                    let nearest = ray * ray.dot(center);
                    hit += f64::from(u8::from(nearest.distance(center) < f64::from(radius)));
                    all += 1.0;
                }
            }
            let found = f64::from(covered(&ball(x, z, radius), Vec3::ZERO, Vec3::Z));
            assert!((found - hit / all).abs() < 0.02 * (hit / all), "{found} against {}", hit / all);
        }
        assert!(covered(&ball(0.0, -0.3, 0.1), Vec3::ZERO, Vec3::Z) <= 0.0, "below the horizon");
    }
}

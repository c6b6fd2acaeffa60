//! Shoes: one smooth surface around each foot.

use glam::{Vec2, Vec3};

use crate::part::part_of_joints;
use crate::rings::{add_rings, convex_radii, cut, direction, kept};
use crate::{BodyError, Part, SkinWeights, Template};

/// Vertices around a ring, and distance between two rings, metres.
const AROUND: usize = 48;
const RING_M: f32 = 0.01;
/// Height of a shoe as a fraction of the ankle's; the foot reaches below it, so that no gap opens.
const COLLAR: f32 = 0.85;
const OVERLAP_M: f32 = 0.015;
/// Distance of the upper from the foot, metres.
const UPPER_M: f32 = 0.006;
/// Width of the sole's edge beyond the foot, metres: at the sides and the heel, and in front of the toes.
const WELT_M: f32 = 0.007;
const TOE_ROOM_M: f32 = 0.013;
/// Height of the toe cap above the ground that the bare foot stands on, metres.
const CAP_M: f32 = 0.06;
/// Height below which the foot stands on the sole, metres.
const STANDS_M: f32 = 0.03;

/// Permitted thickness of soles, metres.
const SOLES: std::ops::RangeInclusive<f32> = 0.0..=0.08;

/// Shape of a pair of shoes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shoes {
    /// Thickness of the soles below the bare feet, metres.
    pub sole_m: f32,
}

impl Default for Shoes {
    /// Returns shoes with soles of usual thickness.
    fn default() -> Self {
        Self { sole_m: 0.022 }
    }
}

impl Shoes {
    /// Returns the body in these shoes, without the surface of the feet below the ankles and with unchanged joints.
    ///
    /// Each shoe is a stack of convex outlines around the foot at its height, with room before the toes, on a sole of even thickness.
    /// It moves as the nearest places of the foot do, so that it bends at the toes.
    ///
    /// # Errors
    /// [`BodyError::Mesh`] for a template that is not valid, one without feet by the usual names, or soles out of range (0 to 0.08 m).
    pub fn on(self, body: &Template) -> Result<Template, BodyError> {
        body.check()?;
        let fail = |message: String| BodyError::Mesh { name: body.name.clone(), message };
        if !SOLES.contains(&self.sole_m) {
            return Err(fail(format!("soles of {} m; they must lie in 0..=0.08", self.sole_m)));
        }
        let part_of_joint = part_of_joints(&body.skeleton);
        let sides = [(Part::LeftFoot, Part::LeftLeg), (Part::RightFoot, Part::RightLeg)];
        let feet = sides.map(|sides| Foot::new(body, &part_of_joint, sides));
        let [Some(left), Some(right)] = feet else {
            return Err(fail("a left and a right foot with ankles are needed for shoes".to_owned()));
        };
        let is_hidden = |vertex: u32| {
            let (at, part) = (body.positions[vertex as usize], body.parts[vertex as usize]);
            [&left, &right].iter().any(|foot| foot.parts.contains(&part) && at.y < foot.collar_y - OVERLAP_M)
        };
        let bare: Vec<[u32; 3]> =
            body.triangles.iter().filter(|triangle| !triangle.iter().all(|v| is_hidden(*v))).copied().collect();
        let mut dressed = kept(body, &bare);
        for foot in [&left, &right] {
            let points = foot.rings(body, self.sole_m);
            add_rings::<AROUND>(&mut dressed, &points, foot.parts[0], |point| foot.skin(body, point));
        }
        dressed.check()?;
        Ok(dressed)
    }
}

/// One foot, canonical metres.
struct Foot {
    /// Parts of foot and leg.
    parts: [Part; 2],
    triangles: Vec<[u32; 3]>,
    vertices: Vec<usize>,
    ground_y: f32,
    collar_y: f32,
    /// Direction from heel to toes (x, z), and the middle of the part that stands on the sole.
    forward: Vec2,
    centre: Vec2,
}

impl Foot {
    fn new(body: &Template, part_of_joint: &[Part], (foot, leg): (Part, Part)) -> Option<Self> {
        let origins = body.skeleton.canonical_origins();
        let ankle = origins[part_of_joint.iter().position(|part| *part == foot)?].as_vec3();
        let parts = [foot, leg];
        let vertices: Vec<usize> = (0..body.positions.len()).filter(|v| body.parts[*v] == foot).collect();
        let ground_y = vertices.iter().map(|v| body.positions[*v].y).fold(f32::INFINITY, f32::min);
        let is_own = |triangle: &&[u32; 3]| triangle.iter().all(|v| parts.contains(&body.parts[*v as usize]));
        let triangles: Vec<[u32; 3]> = body.triangles.iter().filter(is_own).copied().collect();
        let standing = vertices.iter().map(|v| body.positions[*v]).filter(|p| p.y < ground_y + STANDS_M);
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for point in standing {
            (low, high) = (low.min(Vec2::new(point.x, point.z)), high.max(Vec2::new(point.x, point.z)));
        }
        let centre = 0.5 * (low + high);
        let forward = (centre - Vec2::new(ankle.x, ankle.z)).try_normalize()?;
        let collar_y = ground_y + COLLAR * (ankle.y - ground_y);
        (collar_y > ground_y + STANDS_M && centre.is_finite()).then_some(Self {
            parts,
            triangles,
            vertices,
            ground_y,
            collar_y,
            forward,
            centre,
        })
    }

    /// Returns the points of the shoe, from the collar down to the middle of the sole.
    fn rings(&self, body: &Template, sole_m: f32) -> Vec<Vec3> {
        let edge: Vec<Vec2> = self
            .vertices
            .iter()
            .map(|v| body.positions[*v])
            .filter(|point| point.y < self.ground_y + STANDS_M)
            .map(|point| Vec2::new(point.x, point.z))
            .collect();
        let sole: Vec<Vec2> = (0..AROUND)
            .zip(convex_radii::<AROUND>(&edge, self.centre))
            .map(|(k, radius)| {
                let ahead = direction::<AROUND>(k).dot(self.forward).max(0.0);
                self.centre + direction::<AROUND>(k) * (radius + WELT_M + (TOE_ROOM_M - WELT_M) * ahead * ahead)
            })
            .collect();
        let upper_rings = ((self.collar_y - self.ground_y) / RING_M).ceil().max(2.0) as usize;
        let mut points = Vec::new();
        for ring in 0..=upper_rings {
            let y = self.collar_y + (self.ground_y - self.collar_y) * ring as f32 / upper_rings as f32;
            // The foot at this height, and the toe cap that rises from the sole.
            let mut around: Vec<Vec2> = cut(body, &self.triangles, y.max(self.ground_y + 0.5 * RING_M));
            let grown: Vec<Vec2> =
                around.iter().flat_map(|at| (0..8).map(|k| *at + UPPER_M * direction::<8>(k))).collect();
            around = grown;
            let height = (y - self.ground_y) / CAP_M;
            if height < 1.0 {
                let narrower = (1.0 - height * height).sqrt();
                around.extend(sole.iter().map(|at| self.centre + narrower * (*at - self.centre)));
            }
            let middle = around.iter().sum::<Vec2>() / around.len().max(1) as f32;
            let radii = convex_radii::<AROUND>(&around, middle);
            points.extend(radii.into_iter().enumerate().map(|(k, radius)| {
                let at = middle + radius * direction::<AROUND>(k);
                Vec3::new(at.x, y, at.y)
            }));
        }
        let sole_rings = (sole_m / RING_M).ceil() as usize;
        let bottom = self.ground_y - sole_m;
        for ring in 1..=sole_rings {
            let y = self.ground_y - sole_m * ring as f32 / sole_rings as f32;
            points.extend(sole.iter().map(|at| Vec3::new(at.x, y, at.y)));
        }
        for share in [0.66, 0.33, 0.0] {
            let inner = sole.iter().map(|at| self.centre + share * (*at - self.centre));
            points.extend(inner.map(|at| Vec3::new(at.x, bottom, at.y)));
        }
        points
    }

    /// Returns the skin weights of the nearest point of the foot.
    fn skin(&self, body: &Template, point: Vec3) -> SkinWeights {
        let nearest = self
            .vertices
            .iter()
            .min_by(|a, b| {
                let distance = |v: usize| body.positions[v].distance_squared(point);
                distance(**a).total_cmp(&distance(**b))
            })
            .copied()
            .unwrap_or(0);
        body.skin[nearest]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ShapeParams, Skirt, default_template, sample_surface, skin_mesh};
    use glam::DQuat;

    fn body() -> Template {
        default_template(&ShapeParams::default()).unwrap()
    }

    #[test]
    fn shoes_hold_the_feet_and_stand_on_their_soles() {
        let body = body();
        for sole_m in [0.0, 0.022, 0.08] {
            let shod = Shoes { sole_m }.on(&body).unwrap();
            let ground = |template: &Template| template.positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
            assert!((ground(&shod) - (ground(&body) - sole_m)).abs() < 1e-5, "soles of {sole_m} m");
            let first = shod.positions.iter().position(|p| p.y <= ground(&shod) + 1e-5).unwrap();
            assert!(first > 1_000, "the body comes first");
            // Every place of the bare foot that is low enough is inside: above the sole, and within the shoe's outline.
            for (point, part) in body.positions.iter().zip(&body.parts).filter(|(p, _)| p.y < 0.05) {
                let ahead = |p: &Vec3| p.x * point.x > 0.0;
                let reach = |axis: fn(&Vec3) -> f32| {
                    let of = shod.positions.iter().filter(|p| ahead(p) && p.y < 0.06).map(axis);
                    of.fold([f32::INFINITY, f32::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
                };
                let ([left, right], [back, front]) = (reach(|p| p.x), reach(|p| p.z));
                assert!((left..=right).contains(&point.x) && (back..=front).contains(&point.z), "{point} of {part:?}");
            }
            // A shoe is longer than the foot by a usual amount.
            let length = |t: &Template| {
                let feet = t.positions.iter().filter(|p| p.x > 0.0 && p.y < 0.04).map(|p| p.z);
                feet.clone().fold(f32::NEG_INFINITY, f32::max) - feet.fold(f32::INFINITY, f32::min)
            };
            let longer = length(&shod) - length(&body);
            assert!((0.01..0.035).contains(&longer), "{longer} m longer");
            sample_surface(&shod, 5_000, 1).unwrap();
        }
    }

    #[test]
    fn shoes_face_outwards_without_toes_between_and_fit_below_a_skirt() {
        let body = body();
        let shod = Shoes::default().on(&body).unwrap();
        // Triangles of the shoes alone: they have no place in the body's texture.
        let of_shoes = |triangle: &&[u32; 3]| triangle.iter().all(|v| shod.uvs[*v as usize] == Vec2::ZERO);
        let (mut checked, mut litres) = (0, 0.0);
        for triangle in shod.triangles.iter().filter(of_shoes) {
            let corners = triangle.map(|v| shod.positions[v as usize]);
            // Seen from inside of the collar.
            let [a, b, c] = corners.map(|p| p - Vec3::new(0.17 * p.x.signum(), 0.055, 0.03));
            litres += 1e3 * a.dot(b.cross(c)) / 6.0;
            let normal = (b - a).cross(c - a);
            if let Some(normal) = normal.try_normalize() {
                let vertex = triangle.map(|v| shod.normals[v as usize]).into_iter().sum::<Vec3>();
                assert!(normal.dot(vertex) > 0.0, "{} faces inwards", corners[0]);
                checked += 1;
            }
        }
        assert!(checked > 1_000 && (1.5..4.0).contains(&litres), "{checked} triangles around {litres} litres");
        let below = shod.positions.iter().zip(&shod.uvs).filter(|(p, uv)| **uv != Vec2::ZERO && p.y < 0.03).count();
        assert!(below < 20, "{below} vertices of toes are left");
        let dressed = Skirt { length: 0.9, flare: 0.1 }.on(&shod).unwrap();
        assert!(dressed.positions.iter().any(|p| p.y < -0.02));
    }

    #[test]
    fn shoes_follow_the_feet_and_bend_at_the_toes() {
        let body = body();
        let shod = Shoes::default().on(&body).unwrap();
        let mut pose = body.skeleton.rest_pose();
        pose.joint_rotations[body.skeleton.joint("LeftToeBase").unwrap()] = DQuat::from_rotation_x(-0.6);
        let (rest, bent) = (skin_mesh(&shod, &body.skeleton.rest_pose()).0, skin_mesh(&shod, &pose).0);
        let moved = |from: usize| (bent[from] - rest[from]).length();
        let low: Vec<usize> = (0..rest.len()).filter(|v| shod.positions[*v].y < -0.01 && rest[*v].x > 0.0).collect();
        let toe = low.iter().max_by(|a, b| rest[**a].z.total_cmp(&rest[**b].z)).unwrap();
        let heel = low.iter().min_by(|a, b| rest[**a].z.total_cmp(&rest[**b].z)).unwrap();
        assert!(moved(*toe) > 0.02 && moved(*heel) < 1e-3, "{} and {} m", moved(*toe), moved(*heel));
    }

    #[test]
    fn soles_and_bodies_that_wear_no_shoes_are_refused() {
        let body = body();
        for sole_m in [-0.01, 0.2, f32::NAN, f32::INFINITY] {
            assert!(Shoes { sole_m }.on(&body).is_err(), "{sole_m}");
        }
        let mut damaged = body.clone();
        damaged.positions[7].x = f32::NAN;
        assert!(Shoes::default().on(&damaged).is_err());
        let mut footless = body;
        footless.parts.iter_mut().for_each(|part| *part = Part::Torso);
        assert!(Shoes::default().on(&footless).is_err(), "a body without feet");
    }
}

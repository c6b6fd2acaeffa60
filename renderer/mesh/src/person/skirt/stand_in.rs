//! Seen places whose colour and motion hidden ones take.

use glam::Vec3;

use super::{Hollow, Side};

/// Height below the hem from which hidden legs take their colour, metres, and half of the width of that band.
const BELOW_HEM_M: f32 = 0.04;
const BAND_M: f32 = 0.03;

/// Place and unit normal of the seen surface that stands in for each vertex.
#[derive(Debug, Clone, Default)]
pub struct StandIns {
    /// Positions, metres.
    pub positions: Vec<Vec3>,
    /// Unit normals.
    pub normals: Vec<Vec3>,
}

/// Leg just below the hem.
#[derive(Debug, Clone, Copy)]
struct Shank {
    centre: Vec3,
    radius_m: f32,
}

impl Hollow {
    /// Returns the place that stands in for each vertex: itself where it is seen, the outer side of the skirt for the inner one, and for
    /// hidden legs the leg below the hem on the same side of it.
    pub fn stand_ins(&self, positions: &[Vec3], normals: &[Vec3], sides: &[Side]) -> StandIns {
        let shanks = self.shanks();
        let mut of = StandIns { positions: positions.to_vec(), normals: normals.to_vec() };
        for (i, side) in sides.iter().enumerate() {
            match side {
                Side::Seen => (),
                Side::Wall => of.normals[i] = self.depth(positions[i]).map_or(normals[i], |skirt| skirt.normal),
                Side::Hidden => {
                    let aside = |shank: &&Shank| (shank.centre.x - positions[i].x).abs();
                    let Some(shank) = shanks.iter().min_by(|a, b| aside(a).total_cmp(&aside(b))) else { continue };
                    let out = Vec3::new(normals[i].x, 0.0, normals[i].z).normalize_or(Vec3::Z);
                    of.positions[i] = shank.centre + out * shank.radius_m;
                    of.normals[i] = out;
                }
            }
        }
        of
    }

    /// Returns the legs that are seen below the hem, right and left.
    fn shanks(&self) -> Vec<Shank> {
        let height = self.hem_y - BELOW_HEM_M;
        let band = || self.seen.places().filter(|place| (place.y - height).abs() < BAND_M);
        let middle = band().map(|place| f64::from(place.x)).sum::<f64>() / band().count().max(1) as f64;
        let shank = |is_left: bool| {
            let own = || band().filter(move |place| (f64::from(place.x) > middle) == is_left);
            let count = own().count().max(1) as f32;
            let centre = own().sum::<Vec3>() / count;
            let radius_m = own().map(|place| place.distance(centre.with_y(place.y))).sum::<f32>() / count;
            (own().count() > 0).then_some(Shank { centre: centre.with_y(height), radius_m })
        };
        [false, true].into_iter().filter_map(shank).collect()
    }
}

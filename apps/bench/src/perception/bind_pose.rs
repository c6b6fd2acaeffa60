//! Distance between two bodies in their bind poses.

use std::collections::BTreeMap;

use flyrig_body::Template;
use glam::{DVec3, Vec3};

use crate::harness::{joints::JOINTS, surface::Points};

/// Measured points on each surface, and points that they are measured to: about 2 mm apart, so that the distance of a surface to itself
/// is 1 mm.
const MEASURED: usize = 20_000;
const DENSE: usize = 500_000;

/// Returns the mean distance of the surfaces of two bodies in their bind poses, averaged over both directions, millimetres.
///
/// The bodies are translated so that the centroids of their common [`JOINTS`] coincide, and are not rotated: both need about the same
/// bind pose, like bodies with the joints of the built-in one. `None` without a common joint.
pub(crate) fn surface_mm(ours: &Template, truth: &Template) -> Option<f64> {
    let (own, theirs) = (origins(ours), origins(truth));
    let offsets: Vec<DVec3> = JOINTS.iter().filter_map(|name| Some(*theirs.get(name)? - *own.get(name)?)).collect();
    if offsets.is_empty() {
        return None;
    }
    let offset = (offsets.iter().sum::<DVec3>() / offsets.len() as f64).as_vec3();
    let moved: Vec<Vec3> = ours.positions.iter().map(|position| *position + offset).collect();
    let spread = |count: usize| {
        (Points::on(&moved, &ours.triangles, count), Points::on(&truth.positions, &truth.triangles, count))
    };
    let (own, theirs) = spread(MEASURED);
    let (own_dense, their_dense) = spread(DENSE);
    Some(0.5e3 * (own_dense.mean_distance(&theirs.points) + their_dense.mean_distance(&own.points)))
}

/// Returns the extent of the bind pose along y, metres.
pub(crate) fn height_m(template: &Template) -> f32 {
    let heights = || template.positions.iter().map(|position| position.y);
    heights().fold(f32::NEG_INFINITY, f32::max) - heights().fold(f32::INFINITY, f32::min)
}

/// Returns the positions of the joints in the bind pose, by name.
fn origins(template: &Template) -> BTreeMap<&str, DVec3> {
    let names = template.skeleton.joints().iter().map(|joint| joint.name.as_str());
    names.zip(template.skeleton.canonical_origins()).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};

    use super::*;

    #[test]
    fn a_body_is_near_itself_and_another_body_is_not() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let same = surface_mm(&body, &body).unwrap();
        assert!(same < 1.2, "{same}");
        let other = default_template(&ShapeParams::man().with("weight", 1.0)).unwrap();
        let heavy = surface_mm(&other, &body).unwrap();
        assert!(heavy > 5.0 && heavy < 60.0, "{heavy}");
        let mut empty = body.clone();
        empty.triangles.clear();
        assert!(surface_mm(&empty, &body).is_some_and(f64::is_finite), "no triangles");
    }
}

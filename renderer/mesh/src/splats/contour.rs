//! Distance from the planes of Gaussians to the surface that they draw.
//!
//! Centres of fitted Gaussians lie below the surface that they draw, by up to several deviations. The images show it at their contours,
//! which are what was compared with photographs: there, alpha falls below one half outside of the points that the planes give.

use rayon::prelude::*;

use crate::density::median;
use crate::splats::prepare::Prepared;
use crate::splats::views::View;
use crate::{OrientedPoint, TriMesh};

/// Largest distance, in distances of neighbouring Gaussians.
const FARTHEST: f32 = 6.0;
/// Points that are looked for in all contours, at most.
const SAMPLES: usize = 20_000;
/// Contours without which the distance is not measured.
const ENOUGH: usize = 100;

/// Returns the median distance from points of the planes to the drawn surface along their normals, metres; 0 where too few points lie at
/// a contour.
pub(super) fn drawn_beyond_m(views: &[View], points: &[OrientedPoint], prepared: &Prepared) -> f32 {
    let scale = prepared.unit.scale_m() as f32;
    let spacing = prepared.spacing_m / scale;
    let every = points.len().div_ceil(SAMPLES).max(1);
    let distances = |point: &OrientedPoint| -> Vec<f32> {
        let place = prepared.unit.normalized(point.position).as_vec3();
        views.iter().filter_map(|view| view.to_contour(place, point.normal, FARTHEST * spacing, spacing)).collect()
    };
    let found: Vec<Vec<f32>> = points.par_iter().step_by(every).map(distances).collect();
    let found = found.concat();
    if found.len() < ENOUGH { 0.0 } else { median(found) * scale }
}

/// Moves the vertices of a mesh along their normals. Points moved before the fusion grow onto each other in gaps.
pub(super) fn move_outwards(mesh: &mut TriMesh, distance_m: f32) {
    let normals = mesh.normals();
    mesh.positions.iter_mut().zip(normals).for_each(|(position, normal)| *position += normal * distance_m);
}

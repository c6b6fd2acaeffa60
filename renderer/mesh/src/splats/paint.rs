//! Colours of a mesh's surface from the virtual cameras' images.

use flyrig_body::PointGrid;
use flyrig_renderer::SH_DEGREE_0;
use glam::{Vec3, Vec4};
use rayon::prelude::*;

use crate::splats::prepare::Prepared;
use crate::splats::views::View;

/// Largest distance along a line of sight between a point of the mesh and the surface that a camera sees, in distances of neighbouring
/// Gaussians.
const TOLERANCE: f32 = 3.0;
/// Doublings of the radius in which the nearest Gaussian of an unseen point is searched.
const DOUBLINGS: usize = 7;

/// Colours by views, and by the nearest Gaussian where none sees a point.
pub(super) struct Painter<'a> {
    views: &'a [View],
    prepared: &'a Prepared,
    centers: PointGrid,
    /// Distance of neighbouring Gaussians, unit size.
    spacing: f32,
}

impl<'a> Painter<'a> {
    pub fn new(views: &'a [View], prepared: &'a Prepared) -> Self {
        let spacing = prepared.spacing_m / prepared.unit.scale_m() as f32;
        let centers: Vec<Vec3> = prepared.splats.center.iter().map(|row| Vec4::from(*row).truncate()).collect();
        Self { views, prepared, centers: PointGrid::new(&centers, spacing), spacing }
    }

    /// Returns the linear RGB of points of the surface, given by position in metres and unit normal, and whether a camera sees them.
    pub fn colors(&self, points: &[(Vec3, Vec3)]) -> Vec<([f32; 3], bool)> {
        let color = |(position, normal): &(Vec3, Vec3)| {
            let place = self.prepared.unit.normalized(*position).as_vec3();
            let (mut sum, mut total) = (Vec3::ZERO, 0.0);
            for view in self.views {
                if let Some((color, weight)) = view.color(place, *normal, TOLERANCE * self.spacing) {
                    sum += color * weight;
                    total += weight;
                }
            }
            if total > 0.0 { ((sum / total).to_array(), true) } else { (self.nearest(place), false) }
        };
        points.par_iter().with_min_len(256).map(color).collect()
    }

    /// Returns the mean colour over all directions of the Gaussian nearest to a place; grey far from all.
    fn nearest(&self, place: Vec3) -> [f32; 3] {
        let mut radius = self.spacing;
        for _ in 0..DOUBLINGS {
            let mut best = (radius * radius, usize::MAX);
            self.centers.near_box(place - radius, place + radius, |i, center| {
                let squared = center.distance_squared(place);
                if (squared, i) < best {
                    best = (squared, i);
                }
            });
            let row = best.1.checked_mul(self.prepared.splats.order.coefficients());
            if let Some(constant) = row.and_then(|row| self.prepared.splats.harmonics.get(row)) {
                return [0, 1, 2].map(|channel| (SH_DEGREE_0 * constant[channel]).max(0.0));
            }
            radius *= 2.0;
        }
        [0.2; 3]
    }
}

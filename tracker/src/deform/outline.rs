//! Outlines of the masks as a data term of the solver.
//!
//! The derivatives of a rendered image reach as far as its edges are wide, a pixel or two: a skirt that swings 10 cm away from the one of
//! the last frame set is out of their reach. Here the outline of the deformed Gaussians is matched with the ends of the mask along the
//! outline's normal, and each match pulls one Gaussian onto a line in the image. Nothing is rendered.

use flyrig_body::{SkinWeights, skin_point_f64};
use flyrig_types::Camera;
use glam::{DMat3, DMat4, DVec2, DVec3, Vec3};
use rayon::prelude::*;

use crate::deform::data::{DataTerm, PointDerivatives};
use crate::deform::silhouette::{Rim, Silhouette};
use crate::image::view::View;
use crate::pose::line_point::undistorted_line;

/// Weight of a squared distance, per metre of outline and square metre. A mask's pixels weigh as much at 1 cm.
const WEIGHT: f64 = 1e7;
/// Distance that is left to the images, metres: they are finer than points of the surface. Without it people in trousers lose a decibel.
const SEEN_BY_IMAGES_M: f64 = 0.01;
/// Distance beyond it from which the loss grows linearly, metres.
const LINEAR_M: f64 = 0.03;
/// Largest distance of a match, metres.
const REACH_M: f64 = 0.15;
/// Largest number of Gaussians that the outline is taken from.
const MOST_POINTS: usize = 10_000;
/// Least share of a view's outline that must find an end of its mask: a covered camera's, or another person's, does not.
const LEAST_MATCHED: f64 = 0.5;
/// Least cosine between the normals of both outlines.
const LEAST_COSINE: f64 = 0.5;

/// One image with a mask.
#[derive(Debug, Clone, Copy)]
pub struct OutlineView<'a> {
    /// Camera that took it.
    pub camera: &'a Camera,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// sRGB bytes with the mask's coverage as alpha, row by row.
    pub rgba: &'a [u8],
    /// Colour, with alpha, of pixels that say nothing about the person, where the image may have such.
    pub unknown: Option<[u8; 4]>,
    /// Index of the instant at which the image was taken.
    pub instant: usize,
}

/// Matches between the outlines of the deformed Gaussians and those of the masks. They are found anew by
/// [`DataTerm::derivatives`] and kept by [`DataTerm::loss`].
#[derive(Debug)]
pub struct OutlineTerm<'a> {
    points: &'a [Vec3],
    skin: &'a [SkinWeights],
    /// Whether a Gaussian may be matched.
    is_loose: &'a [bool],
    views: &'a [OutlineView<'a>],
    /// Skinning matrices of each instant.
    bones: Vec<Vec<DMat4>>,
    /// Every how many Gaussians one is looked at, and their distance from each other, metres.
    stride: usize,
    spacing_m: f64,
    matches: Vec<Match>,
}

/// Gaussian that shall lie on a line of the undistorted image plane.
#[derive(Debug, Clone)]
struct Match {
    gaussian: usize,
    instant: usize,
    view: View,
    normal: DVec2,
    offset: f64,
    px_per_m: f64,
    weight: f64,
}

impl Match {
    /// Returns the distance from the line, metres, and its derivative by the world point.
    fn distance(&self, world: DVec3) -> Option<(f64, DVec3)> {
        let (pixel, [du, dv]) = self.view.project_with_derivative(world)?;
        let distance = (pixel.dot(self.normal) - self.offset) / self.px_per_m;
        Some((distance, (du * self.normal.x + dv * self.normal.y) / self.px_per_m))
    }
}

impl<'a> OutlineTerm<'a> {
    /// Takes the canonical positions of the Gaussians on the surface, metres, `spacing_m` apart, with their skin weights; which of them may
    /// be matched; the images; and the skinning matrices of their instants.
    #[must_use]
    pub fn new(
        (points, skin, spacing_m): (&'a [Vec3], &'a [SkinWeights], f64),
        is_loose: &'a [bool],
        views: &'a [OutlineView<'a>],
        bones: Vec<Vec<DMat4>>,
    ) -> Self {
        let stride = points.len().div_ceil(MOST_POINTS).max(1);
        let spacing_m = spacing_m * (stride as f64).sqrt();
        Self { points, skin, is_loose, views, bones, stride, spacing_m, matches: Vec::new() }
    }

    fn place(&self, found: &Match, displacement: &[[f32; 4]]) -> Option<DVec3> {
        self.world(found.gaussian, self.bones.get(found.instant)?, displacement)
    }

    fn world(&self, gaussian: usize, bones: &[DMat4], displacement: &[[f32; 4]]) -> Option<DVec3> {
        let [x, y, z, _] = *displacement.get(gaussian)?;
        let point = self.points.get(gaussian)?.as_dvec3() + DVec3::new(x.into(), y.into(), z.into());
        Some(skin_point_f64(bones, self.skin.get(gaussian)?, point))
    }

    fn find(&self, displacement: &[[f32; 4]]) -> Vec<Match> {
        let chosen: Vec<usize> = (0..self.points.len()).step_by(self.stride).collect();
        let placed = |bones: &Vec<DMat4>| -> Vec<DVec3> {
            let one = |&g: &usize| self.world(g, bones, displacement).unwrap_or(DVec3::NAN);
            chosen.par_iter().with_min_len(1024).map(one).collect()
        };
        let worlds: Vec<Vec<DVec3>> = self.bones.iter().map(placed).collect();
        let of_view = |view: &OutlineView<'_>| {
            worlds.get(view.instant).map_or_else(Vec::new, |world| self.find_in(view, world, &chosen))
        };
        self.views.par_iter().map(of_view).collect::<Vec<_>>().concat()
    }

    fn find_in(&self, view: &OutlineView<'_>, world: &[DVec3], chosen: &[usize]) -> Vec<Match> {
        let plane = View::new(view.camera);
        let project = |world: &DVec3| view.camera.project(*world).filter(|pixel| pixel.is_finite());
        let pixels: Vec<Option<DVec2>> = world.iter().map(project).collect();
        let (scales, count) =
            world.iter().filter_map(|p| plane.px_per_m(*p)).fold((0.0, 0), |(s, n), v| (s + v, n + 1));
        if count == 0 {
            return Vec::new();
        }
        let px_per_m = scales / f64::from(count);
        let Some(silhouette) = Silhouette::new(&pixels, 1.5 * self.spacing_m * px_per_m, view.size) else {
            return Vec::new();
        };
        let rims = silhouette.rims(&pixels);
        let find = |rim: &Rim| {
            let end = mask_end(view, &silhouette, rim, REACH_M * px_per_m)?;
            let (normal, offset) = undistorted_line(view.camera, &plane, end, rim.outwards)?;
            let px_per_m = plane.px_per_m(world[rim.point])?;
            let weight = WEIGHT * silhouette.cell_px() / px_per_m;
            let (gaussian, instant) = (chosen[rim.point], view.instant);
            let found = Match { gaussian, instant, view: plane.clone(), normal, offset, px_per_m, weight };
            let distance = found.distance(world[rim.point])?.0;
            Some((found, distance))
        };
        // The outermost points lie inside of the outline by a part of their spacing; what most of a view's matches have in common is that.
        let mut found: Vec<(Match, f64)> = rims.iter().filter_map(find).collect();
        let mut distances: Vec<f64> = found.iter().map(|(_, distance)| *distance).collect();
        let bias = flyrig_solve::median(&mut distances).unwrap_or(0.0);
        if (found.len() as f64) < LEAST_MATCHED * rims.len() as f64 {
            return Vec::new();
        }
        found.retain(|(found, _)| self.is_loose.get(found.gaussian).copied().unwrap_or(false));
        let unbiased = |(found, _): (Match, f64)| Match { offset: found.offset + bias * found.px_per_m, ..found };
        found.into_iter().map(unbiased).collect()
    }
}

impl DataTerm for OutlineTerm<'_> {
    type Error = std::convert::Infallible;

    fn loss(&mut self, displacement: &[[f32; 4]]) -> Result<f64, Self::Error> {
        let loss = |found: &Match| {
            let distance = self.place(found, displacement).and_then(|world| found.distance(world));
            distance.map_or(f64::INFINITY, |(distance, _)| found.weight * robust(distance).0)
        };
        Ok(self.matches.iter().map(loss).sum())
    }

    fn derivatives(&mut self, displacement: &[[f32; 4]], out: &mut Vec<PointDerivatives>) -> Result<f64, Self::Error> {
        self.matches = self.find(displacement);
        let mut sums: Vec<Vec<Option<(DVec3, DMat3)>>> = vec![vec![None; self.points.len()]; self.bones.len()];
        let mut loss = 0.0;
        for found in &self.matches {
            let place = self.place(found, displacement).and_then(|world| found.distance(world));
            let (Some((distance, by_world)), Some(sums)) = (place, sums.get_mut(found.instant)) else { continue };
            let (value, slope, bend) = robust(distance);
            loss += found.weight * value;
            let (gradient, matrix) = sums[found.gaussian].get_or_insert((DVec3::ZERO, DMat3::ZERO));
            *gradient += by_world * (found.weight * slope);
            let outer = DMat3::from_cols(by_world * by_world.x, by_world * by_world.y, by_world * by_world.z);
            *matrix += outer * (found.weight * bend);
        }
        out.clear();
        for (sums, bones) in sums.into_iter().zip(&self.bones) {
            let mut derivatives = PointDerivatives {
                world_from_canonical: bones.clone(),
                gradient: vec![[0.0; 4]; sums.len()],
                curvature: vec![[0.0; 4]; 2 * sums.len()],
            };
            for (gaussian, (gradient, h)) in sums.into_iter().enumerate().filter_map(|(g, sum)| Some((g, sum?))) {
                derivatives.gradient[gaussian] = gradient.as_vec3().extend(1.0).to_array();
                let (x, y, z) = (h.x_axis.as_vec3(), h.y_axis.as_vec3(), h.z_axis.as_vec3());
                derivatives.curvature[2 * gaussian] = [x.x, x.y, x.z, y.y];
                derivatives.curvature[2 * gaussian + 1] = [y.z, z.z, 0.0, 0.0];
            }
            out.push(derivatives);
        }
        Ok(loss)
    }
}

/// Returns Huber's loss of the part of a distance in metres that is out of the images' reach, its derivative, and the second derivative
/// of the parabola that has both there and its vertex at the end of that reach.
fn robust(distance: f64) -> (f64, f64, f64) {
    let size = (distance.abs() - SEEN_BY_IMAGES_M).max(0.0);
    if size <= 0.0 {
        (0.0, 0.0, 0.0)
    } else if size <= LINEAR_M {
        (size * size, 2.0 * size * distance.signum(), 2.0)
    } else {
        let slope = 2.0 * LINEAR_M;
        (slope * size - LINEAR_M * LINEAR_M, slope * distance.signum(), slope / size)
    }
}

/// Returns the end of the mask nearest to a rim along its normal, within `reach` pixels, where nothing else of the person lies between.
fn mask_end(view: &OutlineView<'_>, silhouette: &Silhouette, rim: &Rim, reach: f64) -> Option<DVec2> {
    let step = (silhouette.cell_px() / 8.0).max(1.0);
    let at = |t: f64| rim.at + rim.outwards * t;
    let starts_inside = coverage(view, rim.at)? >= 0.5;
    let sign = if starts_inside { 1.0 } else { -1.0 };
    let (mut before, mut t) = (coverage(view, rim.at)?, step);
    while t <= reach {
        let here = at(sign * t);
        // Another part of the person may be what the mask shows there.
        if starts_inside && t > 3.0 * silhouette.cell_px() && silhouette.is_covered(here) {
            return None;
        }
        let value = coverage(view, here)?;
        if (value >= 0.5) != starts_inside {
            let share = (0.5 - before) / (value - before);
            let end = at(sign * (t - step + step * share));
            return (outwards_of_mask(view, end, silhouette.cell_px())?.dot(rim.outwards) > LEAST_COSINE)
                .then_some(end);
        }
        (before, t) = (value, t + step);
    }
    None
}

/// Returns the direction in which the mask ends, from its coverage around an end.
fn outwards_of_mask(view: &OutlineView<'_>, end: DVec2, radius: f64) -> Option<DVec2> {
    let mut sum = DVec2::ZERO;
    for k in 0..16 {
        let direction = DVec2::from_angle(f64::from(k) * std::f64::consts::TAU / 16.0);
        sum -= direction * coverage(view, end + direction * radius)?;
    }
    Some(sum.normalize_or_zero())
}

/// Samples the mask's coverage at the nearest pixel, 0..=1; `None` outside the image and where it is unknown.
fn coverage(view: &OutlineView<'_>, at: DVec2) -> Option<f64> {
    let [width, height] = view.size.map(f64::from);
    // The border of the image is no end of the person.
    if !(at.x >= 1.0 && at.y >= 1.0 && at.x < width - 2.0 && at.y < height - 2.0) {
        return None;
    }
    let index = at.y.round() as usize * view.size[0] as usize + at.x.round() as usize;
    let pixel = view.rgba.get(4 * index..4 * index + 4)?;
    (view.unknown.is_none_or(|unknown| pixel != unknown)).then(|| f64::from(pixel[3]) / 255.0)
}

#[cfg(test)]
#[path = "outline_tests.rs"]
mod tests;

//! Avatar as the start of live tracking: its body with the mean shape of clothes and hair, and the colours of its
//! Gaussians on any sampling of that surface.

use flyrig_body::{PointGrid, SurfaceGaussians, Template, VertexMeans, displacement};
use glam::Vec3;
use rayon::prelude::*;

use crate::edit::atlas::{REACH, Shown};
use crate::model::avatar::Avatar;
use crate::model::drawn_surface::DRAWN_BEYOND;
use crate::model::posing::{Bones, PosedAvatar};

/// Factors of the search radius that are tried in turn, where no Gaussian is near.
const WIDER: [f32; 3] = [1.0, 3.0, 9.0];

impl Avatar {
    /// Returns the body with the mean shape of clothes and hair over the avatar's take: the surface of an avatar driven
    /// by a pose alone. Joints, triangles, texture coordinates and normals are those of [`Self::template`].
    #[must_use]
    pub fn surface(&self) -> Template {
        let mut template = self.template.clone();
        let Some(hanging) = &self.hanging else { return template };
        let moved: Vec<[f32; 4]> = hanging
            .gaussian_nodes
            .iter()
            .zip(&hanging.gaussian_weights)
            .map(|(nodes, weights)| displacement(&hanging.nodes, &hanging.mean, *nodes, *weights))
            .collect();
        let hung = self.attachments.iter().map(|attachment| (attachment.triangle, attachment.barycentric));
        let by = VertexMeans::new(&template, hung).of(&moved);
        // Vertices that are split at seams of the texture stay together.
        let classes = template.welded();
        let mut sums = vec![Vec3::ZERO.extend(0.0); by.len()];
        for (class, by) in classes.iter().zip(&by) {
            sums[*class as usize] += by.extend(1.0);
        }
        for (position, class) in template.positions.iter_mut().zip(&classes) {
            let sum = sums[*class as usize];
            *position += sum.truncate() / sum.w.max(1.0);
        }
        template
    }

    /// Returns the linear RGB of each Gaussian of `surface`, sampled on [`Self::surface`] or [`Self::template`]: the
    /// avatar's colour seen along the normal, of order zero. The mean colour where no Gaussian of the avatar is near
    /// and faces the same way.
    #[must_use]
    pub fn surface_colors(&self, surface: &SurfaceGaussians) -> Vec<[f32; 3]> {
        let shown = Shown::of(self);
        // As the take's light showed them in the mean: where the surface will face is not known yet.
        let colors: Vec<Vec3> =
            self.constant_colors().into_iter().zip(self.mean_shades()).map(|(color, shade)| color * shade).collect();
        let mean = colors.iter().sum::<Vec3>() / colors.len().max(1) as f32;
        let radius = REACH * shown.spacing(self);
        let grid = PointGrid::new(&shown.place, radius);
        let template = &self.template;
        let color = |(&triangle, &weights): (&u32, &[f32; 3])| -> Option<Vec3> {
            let corners = template.triangles.get(triangle as usize)?;
            let blend = |values: &[Vec3]| -> Vec3 {
                corners.iter().zip(weights).map(|(&corner, weight)| values[corner as usize] * weight).sum()
            };
            let at = (blend(&template.positions), blend(&template.normals).normalize_or(Vec3::Y));
            WIDER.iter().find_map(|wider| shown.color_at(&grid, wider * radius, at, &colors))
        };
        let rows = surface.triangle.par_iter().zip(&surface.barycentric).with_min_len(1024);
        rows.map(|row| color(row).filter(|color| color.is_finite()).unwrap_or(mean).max(Vec3::ZERO).to_array())
            .collect()
    }
}

impl Avatar {
    /// Returns the linear RGB of points near the drawn surface in the rest pose with the take's mean shape, given by canonical position
    /// and unit normal: unlit colours of order zero, seen along the normal. The mean colour where no Gaussian is near and faces the
    /// same way, and for points that are not finite.
    #[must_use]
    pub fn colors_at(&self, points: &[(Vec3, Vec3)]) -> Vec<[f32; 3]> {
        let mut posed = PosedAvatar::default();
        self.pose(&Bones::at_rest(&self.template.skeleton), None, &mut posed);
        let place = posed.surface_points().map(|point| point.drawn(DRAWN_BEYOND)).collect();
        let shown = Shown { place, ..Shown::of(self) };
        let colors = self.constant_colors();
        let mean = colors.iter().sum::<Vec3>() / colors.len().max(1) as f32;
        let radius = REACH * shown.spacing(self);
        let grid = PointGrid::new(&shown.place, radius);
        let color = |at: &(Vec3, Vec3)| {
            let is_finite = at.0.is_finite() && at.1.is_finite();
            WIDER.iter().filter(|_| is_finite).find_map(|wider| shown.color_at(&grid, wider * radius, *at, &colors))
        };
        let rows = points.par_iter().with_min_len(1024);
        rows.map(|at| color(at).filter(|color| color.is_finite()).unwrap_or(mean).max(Vec3::ZERO).to_array()).collect()
    }
}

#[cfg(test)]
mod tests {
    use flyrig_body::sample_surface;
    use flyrig_renderer::SH_DEGREE_0;
    use glam::DVec3;

    use super::*;
    use crate::edit::atlas::KERNEL;
    use crate::model::avatar::tests::small;

    /// Creates an avatar whose colours follow its positions and whose clothes are displaced from the body.
    fn painted() -> Avatar {
        let mut avatar = small(4000, 60);
        let coefficients = avatar.parameters.order().coefficients();
        for (i, place) in avatar.places.iter().enumerate() {
            let color = (*place * Vec3::new(7.0, 11.0, 13.0)).map(|x| 0.5 + 0.4 * x.sin());
            avatar.parameters.harmonics[i * coefficients] = (color / SH_DEGREE_0).extend(0.0).to_array();
        }
        let hanging = avatar.hanging.as_mut().unwrap();
        hanging.mean = hanging.nodes.iter().map(|node| DVec3::new(0.0, 0.0, 0.02 * f64::from(node.y))).collect();
        avatar
    }

    /// Computes the colour of one point in double precision, over all Gaussians.
    fn reference(avatar: &Avatar, place: DVec3, normal: DVec3) -> DVec3 {
        let template = &avatar.template;
        let coefficients = avatar.parameters.order().coefficients();
        let radius = f64::from(REACH) * (template.area_m2() / avatar.gaussians() as f64).sqrt();
        let mut near = Vec::new();
        for (i, attachment) in avatar.attachments.iter().enumerate() {
            let blend = |values: &[Vec3]| -> DVec3 {
                let corners = template.triangles[attachment.triangle as usize];
                (0..3).map(|k| values[corners[k] as usize].as_dvec3() * f64::from(attachment.barycentric[k])).sum()
            };
            let own = blend(&template.normals).normalize();
            let offset = Vec3::from_slice(&avatar.parameters.offset[i]).as_dvec3();
            let from_surface = avatar.places[i].as_dvec3() + offset - blend(&template.positions);
            let height = own.dot(from_surface);
            let aside = blend(&template.positions) + from_surface - own * height - place;
            if aside.length() > radius || own.dot(normal) <= 0.0 {
                continue;
            }
            let mut scales = [0, 1, 2].map(|k| f64::from(avatar.parameters.shape[i][k]));
            scales.sort_by(f64::total_cmp);
            let deviation = f64::from(KERNEL) * (0.5 * (scales[1] + scales[2])).exp();
            let color = Vec3::from_slice(&avatar.parameters.harmonics[i * coefficients]).as_dvec3();
            let alpha = 0.9 * (-0.5 * (aside.length() / deviation).powi(2)).exp();
            near.push((height, alpha, aside.length(), color * f64::from(SH_DEGREE_0)));
        }
        near.sort_by(|a, b| b.0.total_cmp(&a.0));
        let (mut sum, mut left) = (DVec3::ZERO, 1.0);
        for (_, alpha, _, color) in &near {
            sum += *color * *alpha * left;
            left *= 1.0 - alpha;
        }
        if left < 0.95 {
            return sum / (1.0 - left);
        }
        near.into_iter().min_by(|a, b| a.2.total_cmp(&b.2)).unwrap().3
    }

    #[test]
    fn colors_are_those_of_a_plain_sum_in_double_precision() {
        let avatar = painted();
        let surface = sample_surface(&avatar.template, 9000, 2).unwrap();
        let colors = avatar.surface_colors(&surface);
        let mut worst = 0.0f64;
        for i in (0..surface.len()).step_by(41) {
            let expected = reference(&avatar, surface.positions[i].as_dvec3(), surface.normals[i].as_dvec3());
            let error = (Vec3::from(colors[i]).as_dvec3() - expected).abs().max_element();
            worst = worst.max(error);
            assert!(error < 1e-4, "{i}: {:?}, expected {expected}", colors[i]);
        }
        assert!(worst > 0.0);
        // The avatar's own pattern, although its Gaussians are 22 mm apart.
        let rows = surface.positions.iter().zip(&colors);
        let off = rows.map(|(place, color)| {
            let expected = (*place * Vec3::new(7.0, 11.0, 13.0)).map(|x| 0.5 + 0.4 * x.sin());
            (expected - Vec3::from(*color)).abs().max_element()
        });
        assert!(off.sum::<f32>() / (surface.len() as f32) < 0.05);
    }

    #[test]
    fn points_on_the_drawn_surface_have_the_colors_of_the_gaussians_there() {
        let avatar = painted();
        let mut posed = PosedAvatar::default();
        avatar.pose(&Bones::at_rest(&avatar.template.skeleton), None, &mut posed);
        let points: Vec<(Vec3, Vec3)> =
            posed.surface_points().map(|point| (point.drawn(DRAWN_BEYOND), point.normal)).collect();
        let colors = avatar.colors_at(&points);
        let rows = colors.iter().zip(avatar.constant_colors());
        let off = rows.map(|(found, own)| (Vec3::from(*found) - own).abs().max_element()).sum::<f32>();
        // A Gaussian's own colour, mixed with its neighbours'.
        assert!(off / (colors.len() as f32) < 0.06, "{}", off / colors.len() as f32);
        let poisoned = avatar.colors_at(&[(Vec3::NAN, Vec3::Y), (Vec3::splat(9.0), Vec3::Y)]);
        assert_eq!(poisoned[0].map(f32::to_bits), poisoned[1].map(f32::to_bits));
        assert!(poisoned[0].iter().all(|value| value.is_finite()));
    }

    #[test]
    fn the_surface_hangs_where_the_mean_of_the_take_does() {
        let mut avatar = painted();
        let surface = avatar.surface();
        surface.check().unwrap();
        assert_eq!((&surface.triangles, &surface.skeleton), (&avatar.template.triangles, &avatar.template.skeleton));
        let rows = surface.positions.iter().zip(&avatar.template.positions);
        let worst = rows.map(|(moved, rest)| (*moved - *rest - Vec3::Z * 0.02 * rest.y).length());
        let mut errors: Vec<f32> = worst.collect();
        errors.sort_by(f32::total_cmp);
        // With 60 nodes, 20 cm apart, a linear displacement is met to 2 mm in the median.
        assert!(errors[errors.len() / 2] < 2e-3, "{}", errors[errors.len() / 2]);
        let (before, after) = (avatar.template.welded(), surface.welded());
        assert_eq!(before, after, "seams opened");
        avatar.hanging = None;
        assert_eq!(avatar.surface(), avatar.template);
    }

    #[test]
    fn what_hangs_nowhere_has_the_mean_color() {
        let avatar = painted();
        let mut surface = sample_surface(&avatar.template, 100, 2).unwrap();
        surface.triangle[0] = u32::MAX;
        surface.barycentric[1] = [f32::NAN; 3];
        let colors = avatar.surface_colors(&surface);
        assert_eq!(colors[0].map(f32::to_bits), colors[1].map(f32::to_bits));
        assert!(colors.iter().flatten().all(|value| value.is_finite() && *value >= 0.0));
        let none = sample_surface(&avatar.template, 1, 2).unwrap();
        assert_eq!(avatar.surface_colors(&none).len(), 1);
    }
}

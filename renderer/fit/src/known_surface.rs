//! Surface that is known in the pixels of an image, from a depth camera, another program or a network.

use std::sync::Arc;

use flyrig_types::Camera;
use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

/// Distance of the pixels around a pixel that its normal comes from.
const AROUND_PX: usize = 2;
/// Least number of them, without the pixel itself.
const LEAST_AROUND: usize = 6;
/// Largest difference of depth from the pixel, metres: beyond it another surface begins.
const JUMP_M: f32 = 0.04;
/// Largest slant that counts: surfaces closer to edge-on are treated as this one.
const MOST_SLANT: f32 = 5.0;

/// Known surface in one pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct KnownPixel {
    /// Camera-space z of the surface, metres; 0 where nothing is known.
    pub depth_m: f32,
    /// Unit normal, camera axes, towards the camera.
    pub normal: [f32; 3],
    /// Camera-space z per distance along the normal, 1 for a surface that faces the camera.
    pub slant: f32,
}

impl KnownPixel {
    const NONE: Self = Self { depth_m: 0.0, normal: [0.0; 3], slant: 1.0 };

    /// Returns the depth of the surface that lies `below_m` metres below the known one, or `None` where nothing is known.
    pub(crate) fn depth_below(&self, below_m: f32) -> Option<f32> {
        (self.depth_m > 0.0).then_some(self.depth_m + below_m * self.slant)
    }
}

/// Depth and normal in each pixel of an image. Copies share them.
#[derive(Debug, Clone, PartialEq)]
pub struct KnownSurface {
    pub(crate) pixels: Arc<[KnownPixel]>,
}

impl KnownSurface {
    /// Collects depths, camera-space z in metres, row by row, one for each pixel of the camera; a depth that is not finite or not above 0 is
    /// unknown. `is_person` selects pixels by their number. A pixel's normal is that of the plane that fits the depths around it best; a pixel
    /// without enough of them counts as unknown. `None` for a list that does not match the camera's size, or without any known pixel.
    #[must_use]
    pub fn of_depths(camera: &Camera, depths_m: &[f32], is_person: impl Fn(usize) -> bool) -> Option<Self> {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        if width == 0 || depths_m.len() != width * height {
            return None;
        }
        let known = |(at, depth): (usize, &f32)| {
            if depth.is_finite() && *depth > 0.0 && is_person(at) { *depth } else { 0.0 }
        };
        let depths: Vec<f32> = depths_m.iter().enumerate().map(known).collect();
        let rays: Vec<Option<DVec2>> = (0..depths.len())
            .into_par_iter()
            .map(|at| if depths[at] > 0.0 { ray(camera, at % width, at / width) } else { None })
            .collect();
        let pixel = |at| pixel_at(&depths, &rays, width, at).unwrap_or(KnownPixel::NONE);
        let pixels: Vec<KnownPixel> = (0..depths.len()).into_par_iter().map(pixel).collect();
        pixels.iter().any(|pixel| pixel.depth_m > 0.0).then(|| Self { pixels: pixels.into() })
    }
}

/// Returns the ray through a pixel where it meets the plane z = 1 in camera axes.
fn ray(camera: &Camera, x: usize, y: usize) -> Option<DVec2> {
    let along = camera.camera_from_world.rotation * camera.ray(DVec2::new(x as f64, y as f64))?;
    (along.z > 0.0).then(|| along.truncate() / along.z)
}

/// Fits a plane to the depths around a pixel. On the plane p · (x, y, z) = 1, inverse depth is linear in the rays: 1 / z = p · ray.
fn pixel_at(depths: &[f32], rays: &[Option<DVec2>], width: usize, at: usize) -> Option<KnownPixel> {
    let (center, depth) = (rays[at]?, depths[at]);
    let (x, y, height) = (at % width, at / width, depths.len() / width);
    let rows = y.saturating_sub(AROUND_PX)..(y + AROUND_PX + 1).min(height);
    let around =
        rows.flat_map(|y| (x.saturating_sub(AROUND_PX)..(x + AROUND_PX + 1).min(width)).map(move |x| y * width + x));
    // Sums of 1, of the distance from the pixel, of their products, and of the same times inverse depth.
    let (mut count, mut inverse) = (0.0f64, 0.0f64);
    let (mut sum, mut squares, mut mixed, mut by_inverse) = (DVec2::ZERO, DVec2::ZERO, 0.0f64, DVec2::ZERO);
    for i in around {
        let (other, Some(ray)) = (depths[i], rays[i]) else { continue };
        if (other - depth).abs() > JUMP_M {
            continue;
        }
        let (off, value) = (ray - center, 1.0 / f64::from(other));
        count += 1.0;
        inverse += value;
        sum += off;
        squares += off * off;
        mixed += off.x * off.y;
        by_inverse += off * value;
    }
    if count <= LEAST_AROUND as f64 {
        return None;
    }
    let (xx, yy, xy) =
        (squares.x - sum.x * sum.x / count, squares.y - sum.y * sum.y / count, mixed - sum.x * sum.y / count);
    let rise = by_inverse - sum * (inverse / count);
    let determinant = xx * yy - xy * xy;
    if determinant <= 1e-3 * (xx + yy).powi(2) {
        // A line of pixels has no plane.
        return None;
    }
    let slope = DVec2::new(rise.x * yy - rise.y * xy, rise.y * xx - rise.x * xy) / determinant;
    let middle = inverse / count - slope.dot(sum) / count;
    let plane = DVec3::new(slope.x, slope.y, middle - slope.dot(center));
    let away = plane.try_normalize()?;
    let normal: Vec3 = -away.as_vec3();
    let cosine = away.dot(center.extend(1.0)) as f32;
    (cosine > 0.0).then(|| KnownPixel {
        depth_m: depth,
        normal: normal.to_array(),
        slant: (1.0 / cosine).min(MOST_SLANT),
    })
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry, Lens};

    use super::*;

    fn camera() -> Camera {
        let pose = Isometry::look_at(DVec3::new(0.4, -2.5, 1.2), DVec3::Z, DVec3::Z);
        let mut camera = Camera::new("00", Intrinsics::pinhole(40, 30, 60.0), pose);
        camera.intrinsics.lens = Lens::RadialTangential { radial: [-0.1, 0.02, 0.0], tangential: [1e-3, -1e-3] };
        camera
    }

    /// Depths of the plane `normal` · (x, y, z) = `distance`.
    fn plane_depths(camera: &Camera, normal: DVec3, distance: f64) -> Vec<f32> {
        let [width, height] = camera.size().map(|side| side as usize);
        (0..width * height)
            .map(|at| (distance / normal.dot(ray(camera, at % width, at / width).unwrap().extend(1.0))) as f32)
            .collect()
    }

    #[test]
    fn a_plane_has_its_normal_and_depths_below_it_everywhere() {
        let camera = camera();
        let normal = DVec3::new(0.3, -0.2, 1.0).normalize();
        let surface = KnownSurface::of_depths(&camera, &plane_depths(&camera, normal, 2.0), |_| true).unwrap();
        let below = plane_depths(&camera, normal, 2.005);
        for (pixel, below) in surface.pixels.iter().zip(below) {
            assert!((Vec3::from(pixel.normal).as_dvec3() + normal).length() < 2e-4, "{pixel:?}");
            assert!((pixel.depth_below(0.005).unwrap() - below).abs() < 1e-5);
        }
    }

    #[test]
    fn a_step_has_the_normals_of_its_sides_and_unknown_depths_stay_unknown() {
        let camera = camera();
        let [near, far] = [1.5, 2.0].map(|distance| plane_depths(&camera, DVec3::Z, distance));
        let mut depths: Vec<f32> = (0..near.len()).map(|at| if at % 40 < 20 { near[at] } else { far[at] }).collect();
        for (at, poison) in [(45, f32::NAN), (300, 0.0), (501, -1.0), (700, f32::INFINITY)] {
            depths[at] = poison;
        }
        let surface = KnownSurface::of_depths(&camera, &depths, |at| at >= 40).unwrap();
        for (at, pixel) in surface.pixels.iter().enumerate() {
            if at < 40 || [45, 300, 501, 700].contains(&at) {
                assert_eq!(pixel.depth_below(1.0), None, "{at}");
            } else {
                assert!((pixel.normal[2] + 1.0).abs() < 1e-4, "{at}: {pixel:?}");
            }
        }
    }

    #[test]
    fn lists_that_do_not_fit_and_lonely_pixels_are_no_surface() {
        let camera = camera();
        let depths = plane_depths(&camera, DVec3::Z, 2.0);
        assert_eq!(KnownSurface::of_depths(&camera, &depths[1..], |_| true), None);
        assert_eq!(KnownSurface::of_depths(&camera, &depths, |_| false), None);
        assert_eq!(KnownSurface::of_depths(&camera, &depths, |at| at % 7 == 0 && at / 40 % 7 == 0), None, "lonely");
        assert_eq!(KnownSurface::of_depths(&camera, &depths, |at| at / 40 == 9), None, "a line");
        assert_eq!(KnownSurface::of_depths(&camera, &vec![f32::NAN; depths.len()], |_| true), None);
    }
}

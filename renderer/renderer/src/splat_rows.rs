//! Shares of Gaussians in pixels: the rasteriser's image as a sparse matrix over the colours.
//!
//! An image is linear in the Gaussians' colours while nothing moves. Training colours on a few thousand pixels needs
//! the rows of that matrix once instead of a rendering per step.

use std::collections::HashMap;

use flyrig_types::Camera;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::raster::kernels::{BACKFACING_COSINE, CUT, MAX_ALPHA, OPAQUE};
use crate::raster::settings::RasterSettings;

/// Side of the grid cells in which requested pixels are looked up, pixels.
const CELL_PX: u32 = 8;
/// Step of the finite difference for the projection's derivative, metres.
const STEP_M: f64 = 1e-4;

/// Opaque Gaussians in the world, as in [`GaussianBuffers`](crate::GaussianBuffers).
#[derive(Debug, Clone, Copy)]
pub struct PosedGaussians<'a> {
    /// World position and standard deviation, metres.
    pub center_scale: &'a [[f32; 4]],
    /// World unit normal; w is not read.
    pub normal: &'a [[f32; 4]],
}

/// Rows of the matrix, one per pixel.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PixelShares {
    /// Gaussian and its share of the pixel, front to back, for each requested pixel. A pixel's shares sum to its alpha.
    pub rows: Vec<Vec<(u32, f32)>>,
}

struct Splat {
    gaussian: u32,
    pixel: DVec2,
    depth: f64,
    opacity: f64,
    /// Entries xx, xy, yy of the inverse covariance, halved.
    conic: [f64; 3],
    extent: DVec2,
}

/// Computes the shares of the Gaussians, all of opacity 1, in these pixels (x, y), by the rules of
/// [`Rasterizer`](crate::Rasterizer). Pixels may lie outside the image; the row of a pixel without any Gaussian is
/// empty.
#[must_use]
pub fn pixel_shares(
    camera: &Camera,
    gaussians: PosedGaussians<'_>,
    pixels: &[[u32; 2]],
    settings: &RasterSettings,
) -> PixelShares {
    let mut cells: HashMap<[u32; 2], Vec<u32>> = HashMap::new();
    for (index, &[x, y]) in pixels.iter().enumerate() {
        cells.entry([x / CELL_PX, y / CELL_PX]).or_default().push(index as u32);
    }
    let mut splats: Vec<Splat> = gaussians
        .center_scale
        .par_iter()
        .zip(gaussians.normal)
        .enumerate()
        .filter_map(|(i, (center, normal))| project(camera, i as u32, center, normal, settings))
        .collect();
    splats.par_sort_by(|a, b| a.depth.total_cmp(&b.depth).then(a.gaussian.cmp(&b.gaussian)));

    let mut rows = vec![Vec::new(); pixels.len()];
    let mut transmittance = vec![1.0f64; pixels.len()];
    for splat in &splats {
        let (low, high) = (splat.pixel - splat.extent, splat.pixel + splat.extent);
        if high.x < 0.0 || high.y < 0.0 {
            continue;
        }
        // `as` saturates.
        let cell = |v: f64| v.max(0.0) as u32 / CELL_PX;
        for cy in cell(low.y)..=cell(high.y) {
            for cx in cell(low.x)..=cell(high.x) {
                for &index in cells.get(&[cx, cy]).into_iter().flatten() {
                    let pixel = index as usize;
                    let light = transmittance[pixel];
                    let d = DVec2::new(f64::from(pixels[pixel][0]), f64::from(pixels[pixel][1])) - splat.pixel;
                    let [xx, xy, yy] = splat.conic;
                    let alpha = splat.opacity * (-(xx * d.x * d.x + 2.0 * xy * d.x * d.y + yy * d.y * d.y)).exp();
                    if alpha >= CUT && light >= OPAQUE {
                        let alpha = alpha.min(MAX_ALPHA);
                        rows[pixel].push((splat.gaussian, (alpha * light) as f32));
                        transmittance[pixel] = light * (1.0 - alpha);
                    }
                }
            }
        }
    }
    PixelShares { rows }
}

fn project(
    camera: &Camera,
    gaussian: u32,
    center: &[f32; 4],
    normal: &[f32; 4],
    settings: &RasterSettings,
) -> Option<Splat> {
    let [x, y, z, scale] = center.map(f64::from);
    let world = DVec3::new(x, y, z);
    if !(world.is_finite() && scale > 0.0 && scale.is_finite()) {
        return None;
    }
    let sight = world - camera.position();
    if settings.cull_backfacing {
        let [x, y, z, _] = normal.map(f64::from);
        let normal = DVec3::new(x, y, z);
        if !normal.is_finite() || normal.dot(sight) > BACKFACING_COSINE * normal.length() * sight.length() {
            return None;
        }
    }
    let depth = camera.camera_from_world.transform_point(world).z;
    if depth.is_nan() || depth <= f64::from(settings.near_m) {
        return None;
    }
    let pixel = camera.project(world)?;
    // Any three orthogonal directions span the same sphere.
    let mut covariance = [0.0f64; 3];
    let mut columns = [DVec2::ZERO; 3];
    for (column, axis) in columns.iter_mut().zip([DVec3::X, DVec3::Y, DVec3::Z]) {
        let step = axis * STEP_M;
        *column = (camera.project(world + step)? - camera.project(world - step)?) * (scale * 0.5 / STEP_M);
        covariance[0] += column.x * column.x;
        covariance[1] += column.x * column.y;
        covariance[2] += column.y * column.y;
    }
    let [xx, xy, yy] = covariance;
    let det = columns[0].perp_dot(columns[1]).powi(2)
        + columns[1].perp_dot(columns[2]).powi(2)
        + columns[2].perp_dot(columns[0]).powi(2);
    let s = f64::from(settings.filter_variance_px2);
    let (xx, yy, filtered) = (xx + s, yy + s, det + s * (xx + yy) + s * s);
    let opacity = if settings.filter_keeps_opacity { 1.0 } else { (det / filtered).sqrt() };
    if opacity.is_nan() || opacity <= CUT || !filtered.is_finite() {
        return None;
    }
    let half = 0.5 / filtered;
    let extent = (2.0 * (opacity / CUT).ln() * DVec2::new(xx, yy)).max(DVec2::ZERO);
    let extent = DVec2::new(extent.x.sqrt(), extent.y.sqrt()) + 0.01;
    Some(Splat { gaussian, pixel, depth, opacity, conic: [yy * half, -xy * half, xx * half], extent })
}

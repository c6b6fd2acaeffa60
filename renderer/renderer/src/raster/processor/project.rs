//! Projection of Gaussians to splats: `raster/project.wgsl` on the processor.

use flyrig_gpu::CameraConstants;
use glam::{Vec2, Vec3, Vec4};

use crate::raster::kernels::{AWAY_COSINE, BACKFACING_COSINE, CUT};
use crate::raster::processor::shape::{Shape, rows_along, rows_of};
use crate::raster::settings::RasterSettings;

/// Side of a tile, pixels.
pub(crate) const TILE: u32 = crate::raster::processor::lanes::LANES as u32;

/// Footprint of a Gaussian in the image.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ProjectedSplat {
    /// Centre, pixels.
    pub pixel: Vec2,
    /// Camera-space z, metres.
    pub depth: f32,
    /// log2 of the opacity after the filter.
    pub log2_opacity: f32,
    /// log2(alpha) = log2_opacity - (x a x + y b x + z c y) at the offset (x, y) in pixels.
    pub conic: [f32; 3],
    /// Rows above and below the centre beyond which alpha is below the cut.
    pub reach_y: f32,
}

/// First and last tile, columns and rows.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Rect {
    pub first: [u16; 2],
    pub last: [u16; 2],
}

impl Rect {
    /// Returns the number of tiles.
    pub fn tiles(&self) -> u32 {
        let side = |i: usize| u32::from(self.last[i]) - u32::from(self.first[i]) + 1;
        side(0) * side(1)
    }
}

/// Camera and settings of one image.
pub(crate) struct Projection<'a> {
    pub camera: CameraConstants,
    pub size: [u32; 2],
    pub settings: &'a RasterSettings,
}

impl Projection<'_> {
    /// Projects an isotropic Gaussian to its splat and tiles; `None` where it is not drawn. Elements as in
    /// [`GaussianBuffers`](crate::GaussianBuffers).
    #[inline(always)]
    pub fn isotropic(
        &self,
        center: &[f32; 4],
        normal: &[f32; 4],
        color: &[f32; 4],
        canonical: &[f32; 4],
    ) -> Option<(ProjectedSplat, Rect)> {
        let finite = |v: &[f32; 4]| Vec4::from(*v).is_finite();
        let [x, y, z, scale] = *center;
        if !(finite(center) && finite(color) && scale > 0.0 && color[3] > 0.0) {
            return None;
        }
        let world = Vec3::new(x, y, z);
        if self.settings.cull_backfacing && self.faces_away(world, normal, BACKFACING_COSINE as f32) {
            return None;
        }
        if self.settings.outputs.canonical && !finite(canonical) {
            return None;
        }
        let in_camera = self.camera.to_camera(world);
        let (pixel, jacobian) = self.camera.project_with_jacobian(in_camera, self.settings.near_m)?;
        self.splat(pixel, in_camera.z, rows_of(&jacobian).map(|row| row * scale), color[3])
    }

    /// Projects an anisotropic Gaussian to its splat and tiles; `None` where it is not drawn. Elements as in
    /// [`AnisotropicBuffers`](crate::AnisotropicBuffers); `normal` is that of its surface.
    #[inline(always)]
    pub fn anisotropic(
        &self,
        center: &[f32; 4],
        scale_opacity: &[f32; 4],
        rotation: &[f32; 4],
        normal: Option<&[f32; 4]>,
    ) -> Option<(ProjectedSplat, Rect)> {
        let world = Vec4::from(*center).truncate();
        let shape = Shape::new(scale_opacity, rotation)?;
        if !(world.is_finite() && shape.opacity > 0.0) {
            return None;
        }
        if let Some(normal) = normal
            && self.settings.cull_backfacing
            && self.faces_away(world, normal, AWAY_COSINE as f32)
        {
            return None;
        }
        let in_camera = self.camera.to_camera(world);
        let (pixel, jacobian) = self.camera.project_with_jacobian(in_camera, self.settings.near_m)?;
        let rows = rows_along(&jacobian, &shape.axes_in_camera(&self.camera)).map(|row| row * shape.scale_m);
        self.splat(pixel, in_camera.z, rows, shape.opacity)
    }

    /// Returns whether a surface faces away from the camera or its normal is not finite.
    #[inline(always)]
    fn faces_away(&self, world: Vec3, normal: &[f32; 4], cosine: f32) -> bool {
        let n = Vec4::from(*normal).truncate();
        let sight = world - self.camera.center();
        // Squared where the signs allow it: most Gaussians need no root.
        let along = n.dot(sight);
        let is_away = along > 0.0 && along * along > cosine * cosine * n.length_squared() * sight.length_squared();
        is_away || !Vec4::from(*normal).is_finite()
    }

    /// Returns the splat whose covariance before the filter is M M^T, with these rows of the 2x3 matrix M.
    #[inline(always)]
    fn splat(
        &self,
        pixel: Vec2,
        depth: f32,
        [row_x, row_y]: [Vec3; 2],
        opacity: f32,
    ) -> Option<(ProjectedSplat, Rect)> {
        let (xx, xy, yy) = (row_x.dot(row_x), row_x.dot(row_y), row_y.dot(row_y));
        // det(J J^T) by the Cauchy-Binet formula: never negative, no cancellation for thin ellipses.
        let det = row_x.cross(row_y).length_squared();
        // Mip-Splatting's 2D Mip filter (Yu et al. 2024, Eq. 10): a wider ellipse of the same integral,
        // or of the same opacity.
        let s = self.settings.filter_variance_px2;
        let filtered_det = det + s * (xx + yy) + s * s;
        let kept = if self.settings.filter_keeps_opacity { 1.0 } else { (det / filtered_det).sqrt() };
        let opacity = opacity.min(1.0) * kept;
        if !(pixel.is_finite() && filtered_det.is_finite() && opacity > CUT as f32) {
            return None;
        }
        let log2_opacity = opacity.log2();
        let (xx, yy) = (xx + s, yy + s);
        // opacity * exp(-r2 / 2) = CUT
        let r2 = 2.0 * std::f32::consts::LN_2 * (log2_opacity - (CUT as f32).log2());
        let extent = Vec2::new((r2 * xx).sqrt(), (r2 * yy).sqrt());
        // Pixel centres are at integers. One hundredth of a pixel covers the rounding.
        let extent = extent + 0.01;
        let low = (pixel - extent).ceil();
        let high = (pixel + extent).floor();
        let last = Vec2::new((self.size[0] - 1) as f32, (self.size[1] - 1) as f32);
        let is_outside = high.x < 0.0 || high.y < 0.0 || low.x > last.x || low.y > last.y;
        if !low.is_finite() || !high.is_finite() || is_outside || low.x > high.x || low.y > high.y {
            return None;
        }
        let tile = |v: f32| (v as u32 / TILE) as u16;
        let (low, high) = (low.max(Vec2::ZERO), high.min(last));
        let rect = Rect { first: [tile(low.x), tile(low.y)], last: [tile(high.x), tile(high.y)] };
        let scale = 0.5 * std::f32::consts::LOG2_E / filtered_det;
        let conic = [yy * scale, -2.0 * xy * scale, xx * scale];
        Some((ProjectedSplat { pixel, depth, log2_opacity, conic, reach_y: extent.y }, rect))
    }
}

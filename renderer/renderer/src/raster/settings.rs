//! Settings of a rendering and statistics of the latest one.

use crate::anisotropic::buffers::Gaussians;
use crate::anisotropic::order::HarmonicOrder;
use crate::buffers::RenderTarget;

/// Selection of the images of a [`crate::RenderTarget`] that are written; the others keep their content.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Outputs {
    /// Whether [`crate::RenderTarget::color`] is written.
    pub color: bool,
    /// Whether [`crate::RenderTarget::depth`] is written.
    pub depth: bool,
    /// Whether [`crate::RenderTarget::canonical`] is written.
    pub canonical: bool,
    /// Whether [`crate::RenderTarget::planes`] is written. Ignored for isotropic Gaussians and for a target without
    /// that image.
    pub planes: bool,
}

impl Outputs {
    /// Colour, alpha, depth of the centres, and canonical positions: the images that every target has.
    pub const ALL: Self = Self { color: true, depth: true, canonical: true, planes: false };
    /// Colour and alpha only.
    pub const COLOR: Self = Self { color: true, depth: false, canonical: false, planes: false };
    /// Colour, alpha and canonical positions: the inputs of direct appearance.
    pub const SURFACE: Self = Self { color: true, depth: false, canonical: true, planes: false };
    /// Colour, alpha, normals and plane depth of anisotropic Gaussians: the inputs of a fit to depths and normals.
    pub const PLANES: Self = Self { color: true, depth: false, canonical: false, planes: true };
}

/// Settings of a rendering.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterSettings {
    /// Distance from the camera's plane below which centres are skipped, metres.
    pub near_m: f32,
    /// Whether Gaussians whose normal points away from the camera are skipped ([`crate::BACKFACING_COSINE`],
    /// [`crate::AWAY_COSINE`]). For closed surfaces.
    pub cull_backfacing: bool,
    /// Images to write.
    pub outputs: Outputs,
    /// Variance of the low-pass filter that is added to every splat on the screen, square pixels. The splat's opacity
    /// decreases so that its integral is preserved, unless [`Self::filter_keeps_opacity`] is set: Mip-Splatting's 2D Mip filter (Yu et al. 2024, Eq. 10). 0.1 is that
    /// paper's value for one pixel.
    pub filter_variance_px2: f32,
    /// Whether splats keep their opacity when the filter widens them, so that small ones cover more than their integral: as the
    /// 3D Gaussian Splatting reference code draws. The default is `false`.
    pub filter_keeps_opacity: bool,
    /// Part of the image whose tiles are blended, `[left, top, right, bottom]` in pixels, right and bottom excluded;
    /// all other tiles keep their content. `None`: the whole image.
    pub area: Option<[u32; 4]>,
}

impl Default for RasterSettings {
    fn default() -> Self {
        Self {
            near_m: 0.05,
            cull_backfacing: true,
            outputs: Outputs::ALL,
            filter_variance_px2: 0.1,
            filter_keeps_opacity: false,
            area: None,
        }
    }
}

impl RasterSettings {
    /// Returns these settings with the filter of the 3D Gaussian Splatting reference code: 0.3 px² at the full opacity.
    #[must_use]
    pub fn with_classic_filter(self) -> Self {
        Self { filter_variance_px2: 0.3, filter_keeps_opacity: true, ..self }
    }

    /// Returns the settings that apply to this kind of Gaussians, drawn to this target.
    pub(crate) fn for_kind(&self, gaussians: Gaussians<'_>, target: &RenderTarget) -> Self {
        let has_planes = target.planes.as_ref().is_some_and(|planes| planes.len() >= target.color.len());
        let planes = self.outputs.planes && has_planes;
        match gaussians {
            Gaussians::Isotropic(_) => Self { outputs: Outputs { planes: false, ..self.outputs }, ..*self },
            Gaussians::Anisotropic(gaussians) if gaussians.surface.is_some() => {
                Self { outputs: Outputs { planes, ..self.outputs }, ..*self }
            }
            Gaussians::Anisotropic(_) => {
                let outputs = Outputs { canonical: false, planes, ..self.outputs };
                Self { cull_backfacing: false, outputs, ..*self }
            }
        }
    }
}

/// Resources used by the latest image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RasterStats {
    /// Gaussians that touch the image.
    pub visible_gaussians: u32,
    /// Pairs of a Gaussian and a tile, at most one more than the capacity.
    pub pairs: u32,
    /// Images so far that exceeded the capacity for pairs and lack their farthest Gaussians.
    pub overflowed_images: u32,
}

/// Description of the image that was recorded last, for the backward pass.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Latest {
    pub gaussians: usize,
    /// Harmonic order of the colours; `None` for isotropic Gaussians.
    pub order: Option<HarmonicOrder>,
    pub size: [u32; 2],
    /// Columns and rows of tiles that were blended.
    pub blended: [u32; 2],
    pub outputs: Outputs,
}

/// Returns the first tile, and columns and rows of the tiles that an area of pixels touches.
pub(crate) fn tile_range(area: Option<[u32; 4]>, tiles: [u32; 2], tile: u32) -> ([u32; 2], [u32; 2]) {
    let Some([left, top, right, bottom]) = area else { return ([0; 2], tiles) };
    let range = |first: u32, end: u32, count: u32| {
        let tiles = if first < end { end.div_ceil(tile).min(count) } else { 0 };
        let first = (first / tile).min(count);
        (first, tiles.saturating_sub(first))
    };
    let (x, columns) = range(left, right, tiles[0]);
    let (y, rows) = range(top, bottom, tiles[1]);
    ([x, y], [columns, rows])
}

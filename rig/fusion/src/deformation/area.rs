//! Part of an image in which the person can be, and the resolution that is informative there.

use flyrig_body::{DeformationGraph, Skeleton, SkinWeights, SurfaceGaussians, skin_point_f64};
use flyrig_renderer::WantedImage;
use flyrig_types::{Camera, Pose};
use glam::{DMat4, DVec3};

use super::scene::TrackedView;

/// Grid of the area's borders, pixels: the sides of the rasteriser's tiles divide it at every level.
const GRID_PX: u32 = 16 << WantedImage::MAX_LEVEL;
/// Margin of the area around mask and body, as a share of its longer side.
const MARGIN: f64 = 0.06;

/// Pixels per square metre for which the paper states the weights of Eq. 3: a person 400 pixels high.
const PAPER_PIXELS_A_M2: f64 = (400.0 / 1.75) * (400.0 / 1.75);

/// Resolution and area at which a view is compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewPlan {
    /// Number of times that the image is halved.
    pub level: u32,
    /// Pixels of the halved image that count: left, top, right, bottom.
    pub area: [u32; 4],
    /// Factor of the loss, so that a square metre counts equally at any resolution.
    pub weight: f64,
}

/// Canonical points all over the body, metres, with their skinning weights.
#[derive(Debug)]
pub struct Landmarks {
    points: Vec<(DVec3, SkinWeights)>,
}

impl Landmarks {
    /// Takes the Gaussians at the nodes of the graph.
    pub fn new(surface: &SurfaceGaussians, graph: &DeformationGraph) -> Self {
        let point = |&g: &u32| Some((surface.positions.get(g as usize)?.as_dvec3(), *surface.skin.get(g as usize)?));
        Self { points: graph.node_gaussian.iter().filter_map(point).collect() }
    }

    /// Returns the middle of the body, world metres.
    pub fn center(&self, skeleton: &Skeleton, pose: &Pose) -> DVec3 {
        self.posed_center(&skeleton.world_from_canonical(pose))
    }

    fn posed_center(&self, bones: &[DMat4]) -> DVec3 {
        self.points.iter().map(|(point, skin)| skin_point_f64(bones, skin, *point)).sum::<DVec3>()
            / self.points.len().max(1) as f64
    }

    /// Returns one plan per view. Pixels need not be finer than the Gaussians' spacing.
    pub fn plans(
        &self,
        skeleton: &Skeleton,
        instants: &[&Pose],
        views: &[TrackedView<'_>],
        spacing_m: f64,
        max_level: u32,
    ) -> Vec<ViewPlan> {
        let bones: Vec<_> = instants.iter().map(|pose| skeleton.world_from_canonical(pose)).collect();
        let plan = |view: &TrackedView<'_>| {
            let bones = bones.get(view.instant).map_or(&[][..], Vec::as_slice);
            let depth = view.camera.camera_from_world.transform_point(self.posed_center(bones)).z.max(1e-3);
            let fine = view.camera.intrinsics.focal_px.element_sum() * 0.5 / depth;
            let level = (fine * spacing_m).log2().round().clamp(0.0, f64::from(max_level.min(WantedImage::MAX_LEVEL)));
            let shrink = level.exp2();
            let pixels_a_m = fine / shrink;
            let area = self.area(bones, view.camera, view.size, view.rgba);
            let level = level as u32;
            ViewPlan {
                level,
                area: [area[0] >> level, area[1] >> level, area[2] >> level, area[3] >> level],
                weight: PAPER_PIXELS_A_M2 / (pixels_a_m * pixels_a_m),
            }
        };
        views.iter().map(plan).collect()
    }

    /// Returns the pixels that mask or posed body may touch, `[left, top, right, bottom]`, right and bottom excluded; the whole image
    /// when a point of the body cannot be projected.
    fn area(&self, bones: &[DMat4], camera: &Camera, [width, height]: [u32; 2], rgba: &[u8]) -> [u32; 4] {
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        let mut include = |x: f64, y: f64| {
            (low[0], low[1]) = (low[0].min(x), low[1].min(y));
            (high[0], high[1]) = (high[0].max(x), high[1].max(y));
        };
        for (row, pixels) in rgba.chunks_exact(4 * width.max(1) as usize).enumerate() {
            let covered = |p: &[u8]| p[3] > 0;
            let first = pixels.chunks_exact(4).position(covered);
            let last = pixels.chunks_exact(4).rposition(covered);
            if let (Some(first), Some(last)) = (first, last) {
                include(first as f64, row as f64);
                include(last as f64, row as f64);
            }
        }
        for (point, skin) in &self.points {
            match camera.project(skin_point_f64(bones, skin, *point)) {
                Some(pixel) if pixel.is_finite() => include(pixel.x, pixel.y),
                _ => return [0, 0, width, height],
            }
        }
        if low[0] > high[0] {
            return [0, 0, width, height];
        }
        let margin = MARGIN * (high[0] - low[0]).max(high[1] - low[1]);
        let grid = f64::from(GRID_PX);
        let first = |v: f64, side: u32| (((v - margin) / grid).floor() * grid).clamp(0.0, f64::from(side)) as u32;
        let end = |v: f64, side: u32| (((v + margin + 1.0) / grid).ceil() * grid).clamp(0.0, f64::from(side)) as u32;
        [first(low[0], width), first(low[1], height), end(high[0], width), end(high[1], height)]
    }
}

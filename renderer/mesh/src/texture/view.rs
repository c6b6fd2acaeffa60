//! One photograph beside the posed mesh: which points it shows, in which colour, and how well.

use flyrig_types::Camera;
use glam::{Vec2, Vec3};

use super::raster::{Corner, corners, draw, project, signed_area};
use super::{edges::edge_distances, inputs::Photo};

/// Cosine between normal and ray at which a view counts nothing: 75 degrees.
const STEEPEST: f32 = 0.258_819;
/// Depth behind the nearest surface at which a point is hidden, metres; half of it counts in full.
const BEHIND_M: f32 = 0.015;
/// Distance from an outline at which a view starts to count, pixels: pixels of an outline mix the person with the background.
const EDGE_PX: f32 = 1.0;
/// Distance from an outline at which a view counts in full: pixels, and metres on the person for errors of poses.
const CLEAR_PX: f32 = 3.0;
const CLEAR_M: f32 = 0.012;

/// Vertices of the mesh in the pose of a frame: world metres, unit normals.
pub(super) struct PosedMesh {
    pub positions: Vec<Vec3>,
    pub normals: Vec<Vec3>,
}

/// Photograph with the mesh drawn into it.
pub(super) struct PhotoView<'a> {
    rgba: &'a [u8],
    width: usize,
    height: usize,
    projected: Vec<Option<Corner>>,
    depth: Vec<f32>,
    edges: Vec<f32>,
    /// World position of the camera, metres.
    eye: Vec3,
    focal_px: f32,
}

/// Colour of a point in a photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Look {
    /// Linear colour.
    pub rgb: Vec3,
    /// World unit normal of the point.
    pub normal: Vec3,
    /// Certainty that the photograph shows the point, and how it faces the camera, 0..=1.
    pub shown: f32,
    pub facing: f32,
    /// Pixels per metre of a surface that faces the camera.
    pub density: f32,
}

impl<'a> PhotoView<'a> {
    /// Draws a mesh into a photograph.
    pub fn new(photo: &Photo<'a>, mesh: &PosedMesh, triangles: &[[u32; 3]]) -> Self {
        let camera: &Camera = photo.camera;
        let [width, height] = camera.size().map(|side| side as usize);
        let projected = project(camera, &mesh.positions);
        let depth = draw(&projected, triangles, [width, height], |_, _, _| ());
        let alpha = |i: usize| photo.rgba.get(4 * i + 3).copied().unwrap_or_default();
        let edges = edge_distances(alpha, &depth, width);
        Self {
            rgba: photo.rgba,
            width,
            height,
            projected,
            depth,
            edges,
            eye: camera.position().as_vec3(),
            focal_px: (0.5 * (camera.intrinsics.focal_px.x + camera.intrinsics.focal_px.y)) as f32,
        }
    }

    /// Returns a triangle of the mesh as the photograph shows it; `None` where it does not, or from inside.
    pub fn facet(&self, mesh: &PosedMesh, triangle: [u32; 3]) -> Option<Facet<'_>> {
        let corners = corners(&self.projected, triangle)?;
        let area = signed_area(corners);
        // Triangles are far smaller than what hides them: where all corners are hidden, all of them is.
        let is_hidden = |corner: &Corner| {
            let depth = corner.inverse_depth.recip();
            self.nearest(corner.pixel).is_none_or(|i| depth - self.depth[i] > 2.0 * BEHIND_M)
        };
        if area.is_nan() || area >= 0.0 || corners.iter().all(is_hidden) {
            return None;
        }
        let of = |values: &[Vec3]| triangle.map(|i| values[i as usize]);
        Some(Facet { view: self, corners, positions: of(&mesh.positions), normals: of(&mesh.normals) })
    }

    /// Returns the pixel that is nearest to a place in the image; `None` outside of it.
    fn nearest(&self, pixel: Vec2) -> Option<usize> {
        let (x, y) = (pixel.x.round(), pixel.y.round());
        let is_within = [(x, self.width), (y, self.height)].iter().all(|(at, end)| (0.0..*end as f32).contains(at));
        is_within.then(|| y as usize * self.width + x as usize)
    }

    fn bilinear(&self, pixel: Vec2, at: impl Fn(usize) -> f32) -> f32 {
        let low = pixel.floor().max(Vec2::ZERO);
        let part = (pixel - low).clamp(Vec2::ZERO, Vec2::ONE);
        let (x, y) = (low.x as usize, low.y as usize);
        let (right, below) = ((x + 1).min(self.width - 1), (y + 1).min(self.height - 1));
        let row = |y: usize| at(y * self.width + x) * (1.0 - part.x) + at(y * self.width + right) * part.x;
        row(y) * (1.0 - part.y) + row(below) * part.y
    }
}

/// Triangle of the mesh as a photograph shows it.
pub(super) struct Facet<'a> {
    view: &'a PhotoView<'a>,
    corners: [Corner; 3],
    positions: [Vec3; 3],
    normals: [Vec3; 3],
}

impl Facet<'_> {
    /// Returns the colour of the point with these weights of the corners; `None` where the photograph does not show it.
    pub fn look(&self, weights: [f32; 3], linear: &[f32; 256]) -> Option<Look> {
        let (view, corners) = (self.view, &self.corners);
        // Depth and pixel of the point: weights on the surface grow with the depth in the image.
        let parts: [f32; 3] = std::array::from_fn(|k| weights[k] / corners[k].inverse_depth);
        let depth: f32 = parts.iter().sum();
        let pixel: Vec2 = corners.iter().zip(parts).map(|(corner, part)| corner.pixel * (part / depth)).sum();
        let in_front = (2.0 - 2.0 * (depth - view.depth[view.nearest(pixel)?]) / BEHIND_M).clamp(0.0, 1.0);
        if in_front <= 0.0 {
            return None;
        }
        let density = view.focal_px / depth;
        let clear = CLEAR_PX.max(CLEAR_M * density);
        let edge = smooth((view.bilinear(pixel, |i| view.edges[i].min(1e3)) - EDGE_PX) / (clear - EDGE_PX));
        if edge <= 0.0 {
            return None;
        }
        let blend = |values: &[Vec3; 3]| -> Vec3 { values.iter().zip(weights).map(|(v, weight)| *v * weight).sum() };
        let normal = blend(&self.normals).normalize_or_zero();
        let cosine = normal.dot((view.eye - blend(&self.positions)).normalize_or_zero());
        let facing = (cosine - STEEPEST) / (1.0 - STEEPEST);
        if facing.is_nan() || facing <= 0.0 {
            return None;
        }
        let channel = |k: usize| view.bilinear(pixel, |i| linear[usize::from(view.rgba[4 * i + k])]);
        let rgb = Vec3::new(channel(0), channel(1), channel(2));
        Some(Look { rgb, normal, shown: in_front * edge, facing: facing.min(1.0), density })
    }
}

/// Returns the smooth step of `t` from 0 at 0 to 1 at 1.
pub(super) fn smooth(t: f32) -> f32 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

//! Simulated frame with its ground truth.

use flyrig_body::Part;
use flyrig_types::{Image, Mask, Pose};
use glam::Vec3;

/// Image with the truth of its instant. Images are row by row, one element per pixel. The truth except `mask` is
/// sampled at pixel centres, through the middle of the lens, at the middle of the exposure: for a rolling shutter at
/// the middle of each row's own. `mask` is blurred like the image.
#[derive(Debug)]
pub struct SimFrame {
    /// Middle of the middle row's exposure, nanoseconds.
    pub nanos: i64,
    /// Pose of the body.
    pub pose: Pose,
    /// sRGB, [`flyrig_types::PixelFormat::Rgb8`].
    pub color: Image,
    /// Coverage of each pixel by the person, where not occluded by furniture or another person.
    pub mask: Mask,
    /// Camera-space z of the visible clothed surface, metres; 0 elsewhere.
    pub depth: Vec<f32>,
    /// World unit normal of that surface, interpolated between its vertices, on the visible side; 0 elsewhere.
    pub normal: Vec<[f32; 3]>,
    /// Canonical position (on the template without clothes, metres) of the body point that carries the visible surface;
    /// w is 1 on the person and 0 on the background.
    pub canonical: Vec<[f32; 4]>,
    /// Body part of that point.
    pub part: Vec<Option<Part>>,
}

/// Surface with the body point that carries each of its vertices.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceMesh {
    /// World positions, metres.
    pub positions: Vec<Vec3>,
    /// World unit normals.
    pub normals: Vec<Vec3>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Per vertex: canonical position of the unclothed body point, metres.
    pub canonical: Vec<Vec3>,
    /// Body part per vertex.
    pub parts: Vec<Part>,
    /// Per vertex: displacement of loose cloth or hair from its skinned position, world metres; zero for everything
    /// else.
    pub displacement: Vec<Vec3>,
}

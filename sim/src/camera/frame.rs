//! What a simulated camera gives, and the truth behind it.

use flyrig_body::Part;
use flyrig_types::{Image, Mask, Pose};
use glam::Vec3;

/// One image with the truth of its instant. Images are row by row, one element a pixel; the truth but for `mask`
/// is taken at pixel centres, through the middle of the lens, at the middle of the exposure: of a rolling shutter each
/// row at the middle of its own. `mask` is blurred like the image.
#[derive(Debug)]
pub struct SimFrame {
    /// Middle of the middle row's exposure.
    pub nanos: i64,
    /// Pose of the body.
    pub pose: Pose,
    /// sRGB, [`flyrig_types::PixelFormat::Rgb8`].
    pub color: Image,
    /// Share of each pixel in which the person is seen: not behind furniture or somebody else.
    pub mask: Mask,
    /// Camera-space z of the visible clothed surface, metres; 0 where something else is seen.
    pub depth: Vec<f32>,
    /// World unit normal of that surface, interpolated between its vertices, on the side that is seen; 0 where
    /// something else is seen.
    pub normal: Vec<[f32; 3]>,
    /// Canonical position (of the template without clothes, metres) of the body point that carries what is
    /// seen; w is 1 on the person and 0 on the background.
    pub canonical: Vec<[f32; 4]>,
    /// Body part of that point.
    pub part: Vec<Option<Part>>,
}

/// A surface with the body point that carries each of its vertices.
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
    /// Per vertex: its body part.
    pub parts: Vec<Part>,
    /// Per vertex: how far loose cloth or hair is from where skinning alone would put it, world metres; zero for
    /// everything that is not loose.
    pub displacement: Vec<Vec3>,
}

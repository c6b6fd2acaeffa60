//! Points of the surface that texels show.

use flyrig_avatar::each_texel;
use glam::Vec3;

use super::inputs::TexturedMesh;

/// Point of the surface that a texel shows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Texel {
    /// Index of the texel, row by row.
    pub index: u32,
    /// Triangle.
    pub triangle: u32,
    /// Weights of the triangle's second and third corner.
    pub weights: [f32; 2],
}

impl Texel {
    /// Returns the weights of the corners.
    pub fn corners(&self) -> [f32; 3] {
        let [v, w] = self.weights;
        [1.0 - v - w, v, w]
    }

    /// Blends values of the vertices.
    pub fn blend(&self, triangles: &[[u32; 3]], values: impl Fn(u32) -> Vec3) -> Vec3 {
        let triangle = triangles[self.triangle as usize];
        triangle.iter().zip(self.corners()).map(|(i, weight)| values(*i) * weight).sum()
    }
}

/// Returns the texels whose centres lie in a triangle, in the order of triangles. Triangles with vertices out of range are ignored;
/// where two triangles share a texel, the first one wins.
pub(super) fn texels(mesh: &TexturedMesh<'_>, side: u32) -> Vec<Texel> {
    let mut taken = vec![false; side as usize * side as usize];
    let mut texels = Vec::new();
    for (t, triangle) in (0u32..).zip(mesh.triangles) {
        let [Some(a), Some(b), Some(c)] = triangle.map(|i| mesh.uvs.get(i as usize)) else { continue };
        each_texel([a, b, c].map(|uv| *uv * side as f32), side, |index, [_, v, w]| {
            if !std::mem::replace(&mut taken[index], true) {
                texels.push(Texel { index: index as u32, triangle: t, weights: [v, w] });
            }
        });
    }
    texels
}

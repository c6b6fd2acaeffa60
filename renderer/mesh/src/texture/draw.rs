//! Textured mesh in the image of a camera.

use flyrig_avatar::srgb_bytes;
use flyrig_model::srgb;
use flyrig_types::{Camera, RenderedView};
use glam::{Vec2, Vec3};

use super::raster::{Corner, draw, project};

/// Samples along a side of a pixel.
const SAMPLES: usize = 3;
/// Rows of pixels that are drawn at a time.
const BAND: usize = 64;

/// Mesh, texture and light that are drawn.
#[derive(Clone, Copy)]
pub struct DrawnMesh<'a> {
    /// World positions of the vertices, metres.
    pub positions: &'a [Vec3],
    /// Factors on the texture's colours at the vertices, such as the light of the room; `None` for none.
    pub shades: Option<&'a [Vec3]>,
    /// Texture coordinates in 0..=1, v down.
    pub uvs: &'a [Vec2],
    /// Vertices of each triangle; those out of range are ignored.
    pub triangles: &'a [[u32; 3]],
    /// Texture, sRGB, and its side in texels.
    pub rgb: &'a [u8],
    /// Texels along a side.
    pub side: u32,
}

/// Draws a textured mesh, nine samples per pixel, straight alpha. An image without texture is empty.
#[must_use]
pub fn draw_textured(mesh: &DrawnMesh<'_>, camera: &Camera) -> RenderedView {
    let [width, height] = camera.size().map(|side| side as usize);
    let side = mesh.side as usize;
    let mut rgba = vec![0; 4 * width * height];
    let view = |rgba| RenderedView { width: width as u32, height: height as u32, rgba };
    if side == 0 || mesh.rgb.len() != 3 * side * side {
        return view(rgba);
    }
    let mut fine = camera.clone();
    let intrinsics = &mut fine.intrinsics;
    intrinsics.focal_px *= SAMPLES as f64;
    intrinsics.center_px = (intrinsics.center_px + 0.5) * SAMPLES as f64 - 0.5;
    let projected = project(&fine, mesh.positions);
    let linear: [f32; 256] = srgb::byte_table(f32::powf);
    let color = |triangle: u32, weights: [f32; 3]| -> Option<Vec3> {
        let corners = mesh.triangles[triangle as usize].map(|i| i as usize);
        let (mut uv, mut shade) = (Vec2::ZERO, Vec3::ZERO);
        for (corner, weight) in corners.into_iter().zip(weights) {
            uv += *mesh.uvs.get(corner)? * weight;
            shade += mesh.shades.map_or(Some(Vec3::ONE), |shades| shades.get(corner).copied())? * weight;
        }
        Some(sample(mesh.rgb, side, uv, &linear) * shade)
    };
    // Samples take twenty bytes each: a band of rows at a time.
    for (band, rows) in rgba.chunks_mut(4 * width.max(1) * BAND).enumerate() {
        let first = (band * BAND * SAMPLES) as f32;
        let lifted: Vec<Option<Corner>> =
            projected.iter().map(|corner| corner.map(|c| Corner { pixel: c.pixel - Vec2::Y * first, ..c })).collect();
        let size = [width * SAMPLES, rows.len() / (4 * width) * SAMPLES];
        let mut hits: Vec<Option<(u32, [f32; 3])>> = vec![None; size[0] * size[1]];
        drop(draw(&lifted, mesh.triangles, size, |sample, triangle, weights| {
            hits[sample] = Some((triangle as u32, weights));
        }));
        for (pixel, rgba) in rows.chunks_exact_mut(4).enumerate() {
            let (x, y) = (pixel % width * SAMPLES, pixel / width * SAMPLES);
            let samples = (0..SAMPLES).flat_map(|v| (0..SAMPLES).map(move |u| (y + v) * size[0] + x + u));
            let colors = samples.filter_map(|at| hits[at].and_then(|(triangle, weights)| color(triangle, weights)));
            let (sum, count) = colors.fold((Vec3::ZERO, 0u32), |(sum, count), color| (sum + color, count + 1));
            if count > 0 {
                rgba[..3].copy_from_slice(&srgb_bytes(sum / count as f32));
                rgba[3] = (255 * count as usize / (SAMPLES * SAMPLES)) as u8;
            }
        }
    }
    view(rgba)
}

/// Returns the linear colour of a texture, between its texels.
fn sample(rgb: &[u8], side: usize, uv: Vec2, linear: &[f32; 256]) -> Vec3 {
    let place = (uv * side as f32 - 0.5).clamp(Vec2::ZERO, Vec2::splat((side - 1) as f32));
    let low = place.floor();
    let part = place - low;
    let (x, y) = (low.x as usize, low.y as usize);
    let (right, below) = ((x + 1).min(side - 1), (y + 1).min(side - 1));
    let texel = |x: usize, y: usize| {
        Vec3::from_array(std::array::from_fn(|k| linear[usize::from(rgb[3 * (y * side + x) + k])]))
    };
    let row = |y: usize| texel(x, y).lerp(texel(right, y), part.x);
    row(y).lerp(row(below), part.y)
}

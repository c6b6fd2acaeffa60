//! Painting of textures through a mesh's own texture coordinates.

use flyrig_model::srgb;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::clothes::sheet::Sheet;
use crate::clothes::wardrobe::SrgbColor;

/// Square sRGB image.
#[derive(Debug, Clone)]
pub(crate) struct TextureImage {
    pub side: usize,
    pub pixels: Vec<[u8; 4]>,
}

/// Coverage of a texel: index of the triangle plus one (0: none) and two of its barycentric coordinates.
pub(crate) struct UvMap {
    side: usize,
    texels: Vec<(u32, Vec2)>,
}

impl UvMap {
    /// Rasterises the sheet's triangles in texture space; texels around the charts take the closest chart's point.
    pub(crate) fn new(sheet: &Sheet, side: usize) -> Self {
        let mut texels = vec![(0u32, Vec2::ZERO); side * side];
        for (triangle, index) in sheet.triangles.iter().zip(1u32..) {
            let [a, b, c] = triangle.map(|v| sheet.nodes[v as usize].uv * side as f32 - 0.5);
            let area = (b - a).perp_dot(c - a);
            if area.abs() < 1e-9 {
                continue;
            }
            let (low, high) = (a.min(b).min(c).floor(), a.max(b).max(c).ceil());
            let clamp = |v: f32| v.clamp(0.0, side as f32 - 1.0) as usize;
            for y in clamp(low.y)..=clamp(high.y) {
                for x in clamp(low.x)..=clamp(high.x) {
                    let p = Vec2::new(x as f32, y as f32);
                    let u = (p - a).perp_dot(c - a) / area;
                    let v = (b - a).perp_dot(p - a) / area;
                    if u >= -1e-4 && v >= -1e-4 && u + v <= 1.0001 {
                        texels[y * side + x] = (index, Vec2::new(u, v));
                    }
                }
            }
        }
        // Grow the charts, so that filtering finds no unpainted texel at a seam.
        for _ in 0..(side / 128).clamp(2, 12) {
            let before = texels.clone();
            for y in 0..side {
                for x in 0..side {
                    if before[y * side + x].0 != 0 {
                        continue;
                    }
                    let around = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
                    let mut there = around.into_iter().filter(|&(x, y)| x < side && y < side);
                    if let Some((x2, y2)) = there.find(|&(x, y)| before[y * side + x].0 != 0) {
                        texels[y * side + x] = before[y2 * side + x2];
                    }
                }
            }
        }
        Self { side, texels }
    }

    /// Colours each texel by its surface point: three corner nodes' indices and the weights of the corners.
    pub(crate) fn paint(&self, sheet: &Sheet, colour: impl Fn([u32; 3], Vec3) -> SrgbColor + Sync) -> TextureImage {
        let pixels = self
            .texels
            .par_iter()
            .map(|&(index, uv)| match (index as usize).checked_sub(1).and_then(|i| sheet.triangles.get(i)) {
                Some(&corners) => to_bytes(colour(corners, Vec3::new(1.0 - uv.x - uv.y, uv.x, uv.y))),
                None => [128, 128, 128, 255],
            })
            .collect();
        TextureImage { side: self.side, pixels }
    }
}

impl TextureImage {
    /// Creates a texture from a function of texture coordinates.
    pub(crate) fn from_fn(side: usize, colour: impl Fn(Vec2) -> SrgbColor + Sync) -> Self {
        let pixels = (0..side * side)
            .into_par_iter()
            .map(|i| to_bytes(colour((Vec2::new((i % side) as f32, (i / side) as f32) + 0.5) / side as f32)))
            .collect();
        Self { side, pixels }
    }

    /// Sets the gloss, in 0..=1; the fourth channel holds its complement.
    pub(crate) fn glossy(mut self, gloss: f32) -> Self {
        let fourth = ((1.0 - gloss.clamp(0.0, 1.0)) * 255.0).round() as u8;
        for pixel in &mut self.pixels {
            pixel[3] = fourth;
        }
        self
    }

    /// Returns an image of half the side, averaged in linear light.
    pub(crate) fn halved(&self) -> Self {
        let side = (self.side / 2).max(1);
        let table: [f32; 256] = srgb::byte_table(f32::powf);
        let at = |x: usize, y: usize| self.pixels[y.min(self.side - 1) * self.side + x.min(self.side - 1)];
        let pixels = (0..side * side)
            .into_par_iter()
            .map(|i| {
                let (x, y) = (i % side * 2, i / side * 2);
                let four = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
                let mean = |c: usize| four.iter().map(|p| table[usize::from(p[c])]).sum::<f32>() / 4.0;
                let [r, g, b, _] = to_bytes([mean(0), mean(1), mean(2)].map(srgb_from_linear));
                let gloss = four.iter().map(|p| u16::from(p[3])).sum::<u16>() / 4;
                [r, g, b, gloss as u8]
            })
            .collect();
        Self { side, pixels }
    }
}

fn to_bytes(colour: SrgbColor) -> [u8; 4] {
    let [r, g, b] = colour.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8);
    [r, g, b, 255]
}

/// Returns the linear light of an sRGB value, both in 0..=1.
pub(crate) fn linear_from_srgb(c: f32) -> f32 {
    srgb::decode(c, f32::powf)
}

/// Returns the sRGB value of linear light, both in 0..=1.
pub(crate) fn srgb_from_linear(c: f32) -> f32 {
    srgb::encode(c, f32::powf)
}

pub(crate) fn mix3(a: SrgbColor, b: SrgbColor, t: f32) -> SrgbColor {
    std::array::from_fn(|i| a[i] + (b[i] - a[i]) * t)
}

pub(crate) fn scale3(a: SrgbColor, by: f32) -> SrgbColor {
    a.map(|c| c * by)
}

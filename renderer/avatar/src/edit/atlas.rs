//! Colours of an avatar as a texture of its body (LoGAvatar, section 4.1.2), by the body's own texture coordinates.

use flyrig_body::PointGrid;
use flyrig_renderer::{SH_DEGREE_0, linear_from_srgb, srgb_from_linear};
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::error::AvatarError;
use crate::model::avatar::{Attachment, Avatar};

/// Default texels along a side: about 2 mm each on an adult.
pub const DEFAULT_ATLAS_SIDE: u32 = 1024;
/// Range of texels along a side.
pub(crate) const SIDES: std::ops::RangeInclusive<u32> = 16..=4096;
/// Width of a Gaussian's kernel in the texture, in its own standard deviations: narrower than it is drawn, so that
/// detail is preserved.
pub(crate) const KERNEL: f32 = 0.6;
/// Radius within which Gaussians contribute, in mean distances of neighbours.
pub(crate) const REACH: f32 = 3.0;
/// Opacity of a Gaussian at its centre, and least total opacity for a mix of Gaussians to be used.
const MOST_ALPHA: f32 = 0.9;
const LEAST_ALPHA: f32 = 0.05;
/// Rings of texels around covered ones that repeat their colours, so that downsampled textures have no dark seams.
const GUTTER: usize = 8;
/// Colour of texels outside of the body, sRGB.
pub(crate) const UNUSED: [u8; 3] = [128; 3];

/// Point of the body's surface that a texel shows.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Texel {
    /// Index of the texel, row by row.
    pub index: u32,
    /// Canonical position, metres.
    pub place: Vec3,
    pub normal: Vec3,
    pub attachment: Attachment,
}

impl Texel {
    /// Returns the range of its bytes in an image of the texture's size.
    pub fn bytes<'a>(&self, rgb: &'a [u8]) -> &'a [u8] {
        rgb.get(3 * self.index as usize..3 * self.index as usize + 3).unwrap_or_default()
    }
}

/// Texture of the whole body, sRGB.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Atlas {
    /// Texels along a side.
    pub side: u32,
    /// Rows from the top, three bytes per texel.
    pub rgb: Vec<u8>,
    /// Number of texels that show the body.
    pub covered: usize,
}

/// Gaussian reduced to the attributes that a texture needs.
pub(crate) struct Shown {
    /// Canonical position on the surface, with the Gaussian's tangential offset, metres.
    pub place: Vec<Vec3>,
    pub normal: Vec<Vec3>,
    /// Height of the centre above the surface, metres.
    pub height: Vec<f32>,
    /// Standard deviation along the surface, metres.
    pub deviation: Vec<f32>,
}

impl Shown {
    pub fn of(avatar: &Avatar) -> Self {
        let template = &avatar.template;
        let normals = avatar.normals();
        let rows = avatar.attachments.iter().zip(&normals).zip(avatar.places.iter().zip(&avatar.parameters.offset));
        let (place, height) = rows
            .map(|((attachment, normal), (place, [x, y, z, _]))| {
                let surface = attachment.blend(template, &template.positions);
                let from_surface = *place + Vec3::new(*x, *y, *z) - surface;
                let height = normal.dot(from_surface);
                (surface + from_surface - *normal * height, height)
            })
            .unzip();
        // The third scale is across the surface, mostly.
        let deviation = avatar.parameters.shape.iter().map(|[x, y, z, _]| {
            let mut scales = [*x, *y, *z];
            scales.sort_by(f32::total_cmp);
            (0.5 * (scales[1] + scales[2])).exp().clamp(1e-4, 0.05)
        });
        Self { place, height, deviation: deviation.collect(), normal: normals }
    }

    /// Returns the linear colour of the surface at a canonical position with this normal, from Gaussians within
    /// `radius`; `None` where none faces the same way. `grid` holds their positions, `colors` are linear RGB.
    pub fn color_at(
        &self,
        grid: &PointGrid,
        radius: f32,
        (place, normal): (Vec3, Vec3),
        colors: &[Vec3],
    ) -> Option<Vec3> {
        let mut near = Vec::new();
        grid.within(place, radius, |i, squared| {
            if self.normal[i].dot(normal) > 0.0 {
                near.push((self.height[i], i, squared));
            }
        });
        composite(near, self, colors)
    }

    /// Returns the mean distance of neighbours, metres.
    pub fn spacing(&self, avatar: &Avatar) -> f32 {
        (avatar.template.area_m2() / self.place.len().max(1) as f64).sqrt() as f32
    }
}

impl Avatar {
    /// Renders the colours of all Gaussians, of order zero, into a texture. Equal avatars give equal bytes.
    ///
    /// # Errors
    /// [`AvatarError::Texture`] for a side outside of 16..=4096 and for a body without texture coordinates.
    pub fn atlas(&self, side: u32) -> Result<Atlas, AvatarError> {
        let texels = self.texels(side)?;
        let shown = Shown::of(self);
        let colors: Vec<Vec3> = self.constant_colors();
        let radius = REACH * shown.spacing(self);
        let grid = PointGrid::new(&shown.place, radius);
        let color = |texel: &Texel| shown.color_at(&grid, radius, (texel.place, texel.normal), &colors).map(encode);
        let found: Vec<Option<[u8; 3]>> = texels.par_iter().with_min_len(1024).map(color).collect();
        let mut image = vec![None; (side * side) as usize];
        for (texel, color) in texels.iter().zip(&found) {
            image[texel.index as usize] = *color;
        }
        grow(&mut image, side as usize);
        let rgb = image.into_iter().flat_map(|color| color.unwrap_or(UNUSED)).collect();
        Ok(Atlas { side, rgb, covered: texels.len() })
    }

    /// Returns the linear colours of order zero.
    pub(crate) fn constant_colors(&self) -> Vec<Vec3> {
        let coefficients = self.parameters.order().coefficients();
        let rows = self.parameters.harmonics.chunks(coefficients);
        rows.map(|rows| rows.first().map_or(Vec3::ZERO, |[r, g, b, _]| SH_DEGREE_0 * Vec3::new(*r, *g, *b))).collect()
    }

    /// Returns the surface points that texels show, in the order of triangles. Where two triangles share a texel, the
    /// first one wins.
    pub(crate) fn texels(&self, side: u32) -> Result<Vec<Texel>, AvatarError> {
        if !SIDES.contains(&side) {
            let (least, most) = (SIDES.start(), SIDES.end());
            return Err(AvatarError::Texture(format!("a texture of {side} texels a side; choose {least} to {most}")));
        }
        let template = &self.template;
        let mut taken = vec![false; (side * side) as usize];
        let mut texels = Vec::new();
        for (t, triangle) in (0u32..).zip(&template.triangles) {
            let uvs = triangle.map(|i| template.uvs[i as usize]);
            if uvs.contains(&Vec2::ZERO) {
                continue;
            }
            each_texel(uvs.map(|uv| uv * side as f32), side, |index, barycentric| {
                if std::mem::replace(&mut taken[index], true) {
                    return;
                }
                let attachment = Attachment { triangle: t, barycentric };
                texels.push(Texel {
                    index: index as u32,
                    place: attachment.blend(template, &template.positions),
                    normal: attachment.blend(template, &template.normals).normalize_or(Vec3::Y),
                    attachment,
                });
            });
        }
        if texels.is_empty() {
            return Err(AvatarError::Texture(
                "the avatar's body has no texture coordinates; build it on the built-in body, or a glTF body that has them".to_owned(),
            ));
        }
        Ok(texels)
    }
}

/// Composites the linear colour of Gaussians seen along the normal, from rows of height, Gaussian and squared distance
/// along the surface.
fn composite(mut near: Vec<(f32, usize, f32)>, shown: &Shown, colors: &[Vec3]) -> Option<Vec3> {
    near.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let (mut sum, mut left) = (Vec3::ZERO, 1.0);
    for (_, i, squared) in &near {
        let deviation = KERNEL * shown.deviation[*i];
        let alpha = MOST_ALPHA * (-0.5 * squared / (deviation * deviation)).exp();
        sum += left * alpha * colors[*i];
        left *= 1.0 - alpha;
    }
    if left < 1.0 - LEAST_ALPHA {
        return Some(sum / (1.0 - left));
    }
    // Between Gaussians: the nearest.
    near.into_iter().min_by(|a, b| a.2.total_cmp(&b.2)).map(|(_, i, _)| colors[i])
}

/// Calls `visit(index, barycentric)` for the texels whose centres lie in a triangle, given in texels. Triangles without area are ignored.
pub fn each_texel([a, b, c]: [Vec2; 3], side: u32, mut visit: impl FnMut(usize, [f32; 3])) {
    let area = (b - a).perp_dot(c - a);
    if area.abs() < 1e-12 || !area.is_finite() {
        return;
    }
    let range = |low: f32, high: f32| (low.floor().max(0.0) as u32, (high.ceil().max(0.0) as u32).min(side));
    let (left, right) = range(a.x.min(b.x).min(c.x), a.x.max(b.x).max(c.x));
    let (top, bottom) = range(a.y.min(b.y).min(c.y), a.y.max(b.y).max(c.y));
    for y in top..bottom {
        for x in left..right {
            let point = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let (v, w) = ((point - a).perp_dot(c - a) / area, (b - a).perp_dot(point - a) / area);
            let weights = [1.0 - v - w, v, w];
            if weights.iter().all(|weight| *weight >= -1e-6) {
                visit((y * side + x) as usize, weights);
            }
        }
    }
}

/// Extends the colours of a texture of `side` texels a side outwards, ring by ring, so that downsampled textures have no dark seams.
pub fn grow(image: &mut [Option<[u8; 3]>], side: usize) {
    for _ in 0..GUTTER {
        let before = image.to_vec();
        for (i, color) in image.iter_mut().enumerate().filter(|(_, color)| color.is_none()) {
            let (x, y) = (i % side, i / side);
            let around = [
                (x > 0).then(|| i - 1),
                (x + 1 < side).then_some(i + 1),
                (y > 0).then(|| i - side),
                (y + 1 < side).then_some(i + side),
            ];
            *color = around.into_iter().flatten().find_map(|j| before[j]);
        }
    }
}

/// Returns the sRGB bytes of a linear colour.
#[must_use]
pub fn encode(linear: Vec3) -> [u8; 3] {
    linear.to_array().map(|value| (255.0 * srgb_from_linear(value) + 0.5) as u8)
}

/// Converts three bytes to linear colour.
pub(crate) fn decode(rgb: &[u8]) -> Vec3 {
    let value = |k: usize| linear_from_srgb(rgb.get(k).map_or(0.0, |byte| f32::from(*byte) / 255.0));
    Vec3::new(value(0), value(1), value(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::avatar::tests::small;

    /// Compares with a slow reference: every Gaussian for every texel, in f64.
    #[test]
    fn texels_mix_the_gaussians_near_them() {
        let mut avatar = small(800, 5);
        for (i, row) in avatar.parameters.harmonics.iter_mut().enumerate() {
            *row = [0, 1, 2, 3].map(|k| 1.5 + 1.5 * ((i * 3 + k) as f32).sin());
        }
        let atlas = avatar.atlas(64).unwrap();
        let (shown, colors) = (Shown::of(&avatar), avatar.constant_colors());
        let texels = avatar.texels(64).unwrap();
        assert_eq!(atlas.covered, texels.len());
        let radius = f64::from(REACH * shown.spacing(&avatar));
        let mut checked = 0;
        for texel in texels.iter().step_by(7) {
            let distance = |i: &usize| f64::from(shown.place[*i].distance_squared(texel.place));
            let is_near = |i: &usize| distance(i).sqrt() <= radius && shown.normal[*i].dot(texel.normal) > 0.0;
            let mut near: Vec<usize> = (0..800).filter(is_near).collect();
            near.sort_by(|a, b| shown.height[*b].total_cmp(&shown.height[*a]));
            let (mut sum, mut left) = ([0.0f64; 3], 1.0f64);
            for i in near {
                let alpha = 0.9 * (-0.5 * distance(&i) / (0.6 * f64::from(shown.deviation[i])).powi(2)).exp();
                (0..3).for_each(|k| sum[k] += left * alpha * f64::from(colors[i][k]));
                left *= 1.0 - alpha;
            }
            if left < 0.9 {
                checked += 1;
                let expected = encode(Vec3::from_array(sum.map(|value| (value / (1.0 - left)) as f32)));
                let found = &atlas.rgb[3 * texel.index as usize..][..3];
                assert!(found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 1), "{found:?} {expected:?}");
            }
        }
        assert!(checked > 100, "{checked}");
    }

    #[test]
    fn the_built_in_body_fills_its_texture_without_overlaps() {
        let avatar = small(300, 5);
        let template = &avatar.template;
        let mut counts = vec![0u32; 512 * 512];
        for triangle in &template.triangles {
            let uvs = triangle.map(|i| template.uvs[i as usize] * 512.0);
            each_texel(uvs, 512, |index, _| counts[index] += 1);
        }
        let (covered, shared) = (counts.iter().filter(|n| **n > 0).count(), counts.iter().filter(|n| **n > 1).count());
        assert!(covered > 512 * 512 / 3, "{covered}");
        assert!(shared * 100 < covered, "{shared} of {covered}");
    }

    #[test]
    fn bodies_without_coordinates_and_absurd_sides_are_refused() {
        let mut avatar = small(100, 5);
        assert!(avatar.atlas(5).unwrap_err().to_string().contains("choose 16 to 4096"));
        assert!(avatar.atlas(1 << 20).unwrap_err().to_string().contains("choose 16 to 4096"));
        avatar.template.uvs.fill(Vec2::ZERO);
        assert!(avatar.atlas(64).unwrap_err().to_string().contains("no texture coordinates"));
        // Coordinates far outside, and poisoned Gaussians.
        let mut avatar = small(100, 5);
        avatar.template.uvs.iter_mut().for_each(|uv| *uv = *uv * 50.0 - 20.0);
        avatar.parameters.offset[3] = [f32::NAN; 4];
        avatar.parameters.harmonics[8] = [f32::INFINITY; 4];
        drop(avatar.atlas(32));
    }
}

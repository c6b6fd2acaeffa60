//! Transfer of an edited texture to the Gaussians.
//!
//! Only texels that differ from those of [`Avatar::atlas`] are used, so an unedited texture changes nothing. Where an
//! edit has more detail than a Gaussian can show, small Gaussians are added on top.

use flyrig_body::{PointGrid, SkinWeights, Template};
use flyrig_renderer::SH_DEGREE_0;
use glam::{Quat, Vec3};

use crate::edit::atlas::{Atlas, KERNEL, Shown, Texel, decode};
use crate::error::AvatarError;
use crate::model::avatar::{Attachment, Avatar};

/// Radius of the texels that belong to a Gaussian, in its standard deviations.
const REACH: f32 = 1.5;
/// Share of changed texels below which a Gaussian is unchanged.
const LEAST_SHARE: f32 = 0.02;
/// Range of edited colours within a Gaussian above which small ones are added on top, sRGB of 255.
const CONTRAST: u8 = 16;
/// Least distance of small Gaussians relative to that of all others, and in texels.
const FINER: f32 = 0.2;
const TEXELS: f32 = 0.8;
/// Standard deviation of a small Gaussian over the distance to its nearest neighbour; thickness over standard deviation.
const DEVIATION: f32 = 0.975;
const THICKNESS: f32 = 0.5;
/// Logit of the opacity of small Gaussians.
const OPAQUE: f32 = 4.6;
/// Displacement inwards of a Gaussian below small ones, in its standard deviations.
const BELOW: f32 = 0.5;

/// Statistics of an edit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Painted {
    /// Number of differing texels of the body.
    pub texels: usize,
    /// Number of Gaussians whose colours changed.
    pub recolored: usize,
    /// Number of Gaussians added for detail.
    pub added: usize,
}

/// Statistics of the edited texture near a point of the surface.
struct Around {
    /// Share of changed texels, 0 to 1.
    share: f32,
    /// Mean of the changed texels, and of all, linear.
    changed: Vec3,
    all: Vec3,
    /// Range of all texels, sRGB.
    contrast: u8,
}

/// Texels of the body with their edited colours.
struct Canvas<'a> {
    texels: &'a [Texel],
    is_changed: Vec<bool>,
    edited: &'a [u8],
    grid: PointGrid,
}

impl Avatar {
    /// Applies the texels of `edited` that differ from the avatar's own texture of that size.
    ///
    /// # Errors
    /// [`AvatarError::Texture`] as for [`Avatar::atlas`], and for bytes of another size.
    pub fn paint(&mut self, edited: &Atlas) -> Result<Painted, AvatarError> {
        let own = self.atlas(edited.side)?;
        if own.rgb.len() != edited.rgb.len() {
            return Err(AvatarError::Texture(format!("{} bytes for {} texels a side", edited.rgb.len(), edited.side)));
        }
        let texels = self.texels(edited.side)?;
        let is_changed = |texel: &Texel| texel.bytes(&own.rgb) != texel.bytes(&edited.rgb);
        let is_changed: Vec<bool> = texels.iter().map(is_changed).collect();
        let mut painted = Painted { texels: is_changed.iter().filter(|is| **is).count(), ..Painted::default() };
        if painted.texels == 0 {
            return Ok(painted);
        }
        let shown = Shown::of(self);
        let spacing = shown.spacing(self);
        let places: Vec<Vec3> = texels.iter().map(|texel| texel.place).collect();
        let grid = PointGrid::new(&places, REACH * spacing);
        let canvas = Canvas { texels: &texels, is_changed, edited: &edited.rgb, grid };
        let texel_m = (self.template.area_m2() / texels.len() as f64).sqrt() as f32;
        let apart = (FINER * spacing).max(TEXELS * texel_m);
        let mut is_covered = vec![false; texels.len()];
        let parents = PointGrid::new(&shown.place, spacing);
        for i in 0..shown.place.len() {
            let (place, normal, deviation) = (shown.place[i], shown.normal[i], shown.deviation[i]);
            let Some(mut around) = canvas.around(place, normal, deviation).filter(|found| found.share > LEAST_SHARE)
            else {
                continue;
            };
            if around.contrast > CONTRAST && deviation > apart {
                canvas.each(place, normal, REACH * deviation, |texel, _| is_covered[texel] = true);
                // A mixed colour would show around the edit as a halo.
                around.share = around.share.round();
                let (_, level) = height(&parents, &shown, place, normal, spacing).unwrap_or((i, shown.height[i]));
                self.places[i] -= normal * (BELOW * deviation + (shown.height[i] - level).max(0.0));
            }
            self.recolor(i, &around);
            painted.recolored += 1;
        }
        for texel in spread(&texels, &is_covered, apart) {
            let (place, normal) = (texel.place, texel.normal);
            let Some(around) = canvas.around(place, normal, apart) else { continue };
            let Some((parent, height)) = height(&parents, &shown, place, normal, spacing) else { continue };
            self.add(texel, parent, height, DEVIATION * apart, around.all / SH_DEGREE_0);
            painted.added += 1;
        }
        Ok(painted)
    }

    /// Recolours a Gaussian by the changed texels around it.
    fn recolor(&mut self, i: usize, around: &Around) {
        let coefficients = self.parameters.order().coefficients();
        let rows = &mut self.parameters.harmonics[i * coefficients..(i + 1) * coefficients];
        for (k, row) in rows.iter_mut().enumerate() {
            let wanted = if k == 0 { around.changed / SH_DEGREE_0 } else { Vec3::ZERO };
            for c in 0..3 {
                row[c] += around.share * (wanted[c] - row[c]);
            }
        }
    }

    /// Adds a flat Gaussian at a texel, `height` metres above the surface, with the graph nodes of `parent`.
    fn add(&mut self, texel: &Texel, parent: usize, height: f32, deviation: f32, color: Vec3) {
        self.places.push(texel.place + height * texel.normal);
        self.attachments.push(texel.attachment);
        self.skin.push(blended_skin(&self.template, &texel.attachment).unwrap_or(self.skin[parent]));
        let scale = deviation.ln();
        self.parameters.push(
            [scale, scale, scale + THICKNESS.ln(), OPAQUE],
            Quat::from_rotation_arc(Vec3::Z, texel.normal).to_array(),
            color.extend(0.0).to_array(),
        );
        if let Some(hanging) = &mut self.hanging {
            hanging.gaussian_nodes.push(hanging.gaussian_nodes[parent]);
            hanging.gaussian_weights.push(hanging.gaussian_weights[parent]);
        }
    }
}

impl Canvas<'_> {
    /// Visits the texels near a point, except those on the other side of a thin part.
    fn each(&self, place: Vec3, normal: Vec3, radius: f32, mut visit: impl FnMut(usize, f32)) {
        self.grid.within(place, radius, |texel, squared| {
            if self.texels[texel].normal.dot(normal) > 0.0 {
                visit(texel, squared);
            }
        });
    }

    /// Averages the texels around a point; `None` where there is none.
    fn around(&self, place: Vec3, normal: Vec3, deviation: f32) -> Option<Around> {
        let (mut sums, mut weights) = ([Vec3::ZERO; 2], [0.0; 2]);
        let (mut low, mut high) = ([u8::MAX; 3], [0; 3]);
        let kernel = KERNEL * deviation;
        self.each(place, normal, REACH * deviation, |texel, squared| {
            let weight = (-0.5 * squared / (kernel * kernel)).exp();
            let rgb = self.texels[texel].bytes(self.edited);
            for ((low, high), byte) in low.iter_mut().zip(&mut high).zip(rgb) {
                (*low, *high) = ((*low).min(*byte), (*high).max(*byte));
            }
            let color = weight * decode(rgb);
            for kind in 0..=usize::from(self.is_changed[texel]) {
                sums[kind] += color;
                weights[kind] += weight;
            }
        });
        let contrast = high.iter().zip(low).map(|(high, low)| high.saturating_sub(low)).max().unwrap_or_default();
        let mean = |kind: usize| sums[kind] / weights[kind].max(1e-12);
        (weights[0] > 0.0).then(|| Around { share: weights[1] / weights[0], changed: mean(1), all: mean(0), contrast })
    }
}

/// Selects texels in order so that no two are closer than `apart`.
fn spread<'a>(texels: &'a [Texel], is_wanted: &[bool], apart: f32) -> Vec<&'a Texel> {
    let cell = |place: Vec3| (place / apart).floor().as_ivec3();
    let mut taken: std::collections::HashMap<glam::IVec3, Vec<Vec3>> = std::collections::HashMap::new();
    let mut chosen = Vec::new();
    for texel in texels.iter().zip(is_wanted).filter(|(_, is)| **is).map(|(texel, _)| texel) {
        let center = cell(texel.place);
        let around = (0..27).map(|k| center + glam::IVec3::new(k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1));
        let mut near = around.filter_map(|cell| taken.get(&cell)).flatten();
        if near.all(|place| place.distance_squared(texel.place) >= apart * apart) {
            taken.entry(center).or_default().push(texel.place);
            chosen.push(texel);
        }
    }
    chosen
}

/// Returns the Gaussian nearest to a point of the surface, and the mean height above it of those near, metres.
fn height(grid: &PointGrid, shown: &Shown, place: Vec3, normal: Vec3, spacing: f32) -> Option<(usize, f32)> {
    let mut nearest = None;
    let (mut sum, mut weights) = (0.0, 0.0);
    grid.within(place, 2.0 * spacing, |i, squared| {
        if shown.normal[i].dot(normal) <= 0.0 {
            return;
        }
        if nearest.is_none_or(|(least, _)| squared < least) {
            nearest = Some((squared, i));
        }
        let weight = (-0.5 * squared / (spacing * spacing)).exp();
        sum += weight * shown.height[i];
        weights += weight;
    });
    nearest.map(|(_, i)| (i, sum / weights))
}

fn blended_skin(template: &Template, attachment: &Attachment) -> Option<SkinWeights> {
    let corners = template.triangles.get(attachment.triangle as usize)?;
    let influences: Vec<(u16, f32)> = corners
        .iter()
        .zip(attachment.barycentric)
        .flat_map(|(&corner, weight)| {
            let skin = template.skin[corner as usize];
            (0..4).map(move |k| (skin.joints[k], skin.weights[k] * weight))
        })
        .collect();
    SkinWeights::strongest(&influences)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::avatar::tests::small;

    #[test]
    fn an_untouched_texture_changes_nothing() {
        let mut avatar = small(2000, 20);
        let (before, atlas) = (avatar.clone(), avatar.atlas(128).unwrap());
        assert_eq!(avatar.paint(&atlas).unwrap(), Painted::default());
        assert!(avatar.to_bytes().unwrap() == before.to_bytes().unwrap());
    }

    /// Paints a red square with a white middle at the chest.
    #[test]
    fn an_emblem_shows_in_the_next_texture_and_nothing_else_changes() {
        let mut avatar = small(6000, 20);
        let before = avatar.clone();
        let own = avatar.atlas(256).unwrap();
        let texels = avatar.texels(256).unwrap();
        let chest = Vec3::new(0.0, 0.78 * texels.iter().map(|texel| texel.place.y).fold(0.0, f32::max), 0.0);
        let distance = |texel: &Texel| {
            let away = texel.place - chest;
            if texel.normal.z > 0.2 { away.x.abs().max(away.y.abs()) } else { f32::INFINITY }
        };
        let mut edited = own.clone();
        for texel in texels.iter().filter(|texel| distance(texel) < 0.06) {
            let color = if distance(texel) < 0.025 { [250, 250, 250] } else { [210, 90, 90] };
            edited.rgb[3 * texel.index as usize..][..3].copy_from_slice(&color);
        }
        let painted = avatar.paint(&edited).unwrap();
        assert!(painted.texels > 50 && painted.recolored > 10 && painted.added > 100, "{painted:?}");
        assert_eq!(avatar.gaussians(), 6000 + painted.added);
        avatar.check().unwrap();
        // The new texture is the edited one, and the old one elsewhere.
        let again = avatar.atlas(256).unwrap();
        let (mut inside, mut outside) = (Vec::new(), 0);
        for texel in &texels {
            let at = 3 * texel.index as usize..3 * texel.index as usize + 3;
            let far = |a: &[u8], b: &[u8]| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            if distance(texel) < 0.06 {
                inside.push(far(&again.rgb[at.clone()], &edited.rgb[at]));
            } else if distance(texel) > 0.06 + 0.06 {
                outside = outside.max(far(&again.rgb[at.clone()], &own.rgb[at]));
            }
        }
        inside.sort_unstable();
        let median = inside[inside.len() / 2];
        assert!(median < 12, "{median}");
        assert!(outside <= 1, "{outside}");
        // Gaussians away from it keep their bytes.
        let shown = Shown::of(&before);
        for i in (0..6000).filter(|i| shown.place[*i].distance(chest) > 0.3) {
            assert!(
                avatar.places[i] == before.places[i]
                    && avatar.parameters.harmonics[4 * i].map(f32::to_bits)
                        == before.parameters.harmonics[4 * i].map(f32::to_bits)
            );
        }
    }

    #[test]
    fn textures_of_another_size_are_refused_and_poison_does_not_spread() {
        let mut avatar = small(300, 5);
        let atlas = Atlas { side: 64, rgb: vec![0; 3], covered: 0 };
        assert!(avatar.paint(&atlas).unwrap_err().to_string().contains("3 bytes for 64 texels"));
        let mut edited = avatar.atlas(64).unwrap();
        edited.rgb.iter_mut().for_each(|byte| *byte = !*byte);
        avatar.parameters.rotation[7] = [0.0; 4];
        avatar.parameters.shape[8][..3].fill(90.0);
        avatar.paint(&edited).unwrap();
        assert!(avatar.places.iter().all(|place| place.is_finite()));
        assert!(avatar.parameters.harmonics.iter().flatten().all(|value| value.is_finite()));
    }
}

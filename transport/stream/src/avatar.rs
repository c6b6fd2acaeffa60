//! Templates of anisotropic Gaussians: avatars.
//!
//! An avatar that poses alone drive is `FLA`, the codec's version, the length of a template without nodes and that template, the terms of
//! the light as 27 `f32`, then planes of bytes with one element per Gaussian in the template's order: three of logarithms of scales, four of
//! a rotation, one of the opacity, three of sRGB. Every further message is a pose: no node translations, no colours.
//!
//! An avatar that is tracked is `FLE`, version, length and template with or without nodes, the canonical places of the nodes as three `f32`
//! each, and the planes without those of sRGB. Node translations and colours are messages, as for any person.
//!
//! The inner template holds centres, skin, normals and one isotropic size for viewers that draw isotropic Gaussians. The hash is that of the
//! whole message.

use alloc::vec::Vec;

use flyrig_model::{
    light,
    quaternion::{IDENTITY, from_rows, product, unit},
};

use crate::{
    attributes::{Look, Shapes},
    bytes::Fields,
    error::StreamError,
    message::{AVATAR_MAGIC, CODEC_VERSION, TRACKED_MAGIC},
    motion::Motion,
    pose::Posed,
    srgb::Srgb,
    template::{EncodedTemplate, MAX_COORDINATE_M, MAX_TEMPLATE_BYTES, StreamTemplate, TemplateSource, template_hash},
};

const WHAT: &str = "avatar";
/// Smallest scale, metres, and natural logarithm of the largest over it (0.1 m).
const LEAST_SCALE_M: f32 = 2e-4;
const SCALE_RANGE: f32 = 6.214_608;
/// Number of planes of bytes: of shapes, and of colours.
const SHAPE_PLANES: usize = 8;
const COLOR_PLANES: usize = 3;
/// Quantisation steps of a rotation's component, which lies in -1/sqrt(2)..=1/sqrt(2).
const ROTATION_STEPS: f32 = 1023.0;

/// Attributes of an avatar's Gaussian beside centre and skin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AvatarGaussian {
    /// Standard deviations along the Gaussian's own axes, canonical metres; kept to 1.3 % within 0.2 mm to 100 mm.
    pub scale_m: [f32; 3],
    /// Opacity, 0..=1.
    pub opacity: f32,
    /// Quaternion x, y, z, w of any length: canonical space from the Gaussian's axes.
    pub rotation: [f32; 4],
    /// Linear RGB, 0..=1; not sent where colours are messages.
    pub color: [f32; 3],
}

/// Avatar to encode.
///
/// ```
/// use flyrig_stream::{AvatarGaussian, AvatarSource, LIGHT_TERMS, StreamJoint, StreamTemplate, TemplateSource};
///
/// let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
/// let template = TemplateSource {
///     joints: &[StreamJoint { parent: None, translation: [0.0; 3], joint_from_canonical: rows }],
///     center_scale: &[[0.0, 1.0, 0.0, 0.01]],
///     normals: &[[0.0, 0.0, 1.0]],
///     skin: &[([0; 4], [1.0, 0.0, 0.0, 0.0])],
///     node_weights: &[],
///     nodes: &[],
/// };
/// let gaussian =
///     AvatarGaussian { scale_m: [0.02, 0.01, 0.002], opacity: 0.9, rotation: [0.0, 0.0, 0.0, 1.0], color: [0.5, 0.2, 0.1] };
/// let mut light = [[0.0; 3]; LIGHT_TERMS];
/// light[0] = [1.0; 3];
/// let encoded = AvatarSource { template, gaussians: &[gaussian], light: Some(light) }.encode()?;
/// assert!(StreamTemplate::decode(&encoded.bytes)?.has_colors());
/// # Ok::<(), flyrig_stream::StreamError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct AvatarSource<'a> {
    /// Centres with isotropic sizes, normals and skin; nodes only without a light.
    pub template: TemplateSource<'a>,
    /// Attributes of the Gaussians, in the order of `template`.
    pub gaussians: &'a [AvatarGaussian],
    /// Light: factors of red, green and blue for each term of the surface's normal in the world. `None` where colours are messages.
    pub light: Option<light::Terms>,
}

/// Shapes of an avatar's Gaussians in the world; both lists have one element per Gaussian.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PosedAxes {
    /// Standard deviations along the Gaussian's own axes, metres; w: opacity.
    pub scale_opacity: Vec<[f32; 4]>,
    /// Unit quaternion x, y, z, w: world from the Gaussian's axes.
    pub rotation: Vec<[f32; 4]>,
}

impl AvatarSource<'_> {
    /// Orders, quantises and encodes the avatar.
    ///
    /// # Errors
    /// [`StreamError::Template`] when counts differ, there are nodes beside a light, or a number is not finite.
    pub fn encode(&self) -> Result<EncodedTemplate, StreamError> {
        let check = |holds: bool, problem| if holds { Ok(()) } else { Err(StreamError::Template(problem)) };
        let nodes = self.template.nodes;
        check(self.light.is_none() || nodes.is_empty(), "an avatar with colours has no nodes: poses alone drive it")?;
        check(self.gaussians.len() == self.template.center_scale.len(), "its lists differ in length")?;
        let numbers = |g: &AvatarGaussian| {
            g.scale_m.iter().chain(&g.rotation).chain(&g.color).chain([&g.opacity]).all(|v| v.is_finite())
        };
        check(self.gaussians.iter().all(numbers), "a Gaussian is not finite")?;
        let is_lit = self.light.iter().all(|light| light.as_flattened().iter().all(|term| term.is_finite()));
        check(is_lit, "its light is not finite")?;
        let inner = self.template.encode()?;
        let srgb = Srgb::new();
        let mut bytes = Vec::new();
        bytes.extend(if self.light.is_some() { AVATAR_MAGIC } else { TRACKED_MAGIC });
        bytes.push(CODEC_VERSION);
        bytes.extend((inner.bytes.len() as u32).to_le_bytes());
        bytes.extend(&inner.bytes);
        if let Some(light) = &self.light {
            bytes.extend(light.as_flattened().iter().flat_map(|term| term.to_le_bytes()));
        }
        let places = inner.node_order.iter().flat_map(|&node| nodes[node as usize]);
        bytes.extend(places.flat_map(f32::to_le_bytes));
        let rows: Vec<[u8; SHAPE_PLANES + COLOR_PLANES]> = inner
            .gaussian_order
            .iter()
            .map(|&i| {
                let AvatarGaussian { scale_m, opacity, rotation, color } = self.gaussians[i as usize];
                let [a, b, c] = scale_m.map(scale_code);
                let [r0, r1, r2, r3] = rotation_code(rotation).to_le_bytes();
                let [red, green, blue] = color.map(|linear| (srgb.code(linear) + 0.5) as u8);
                [a, b, c, r0, r1, r2, r3, (255.0 * opacity + 0.5) as u8, red, green, blue]
            })
            .collect();
        let planes = if self.light.is_some() { SHAPE_PLANES + COLOR_PLANES } else { SHAPE_PLANES };
        for plane in 0..planes {
            bytes.extend(rows.iter().map(|row| row[plane]));
        }
        let template = decode(&bytes)?;
        Ok(EncodedTemplate { template, bytes, gaussian_order: inner.gaussian_order, node_order: inner.node_order })
    }
}

/// Decodes an avatar.
///
/// # Errors
/// [`StreamError::Version`] or [`StreamError::Malformed`].
fn decode(bytes: &[u8]) -> Result<StreamTemplate, StreamError> {
    let has_colors = bytes.starts_with(&AVATAR_MAGIC);
    let mut fields = Fields::new(WHAT, if has_colors { AVATAR_MAGIC } else { TRACKED_MAGIC }, bytes)?;
    fields.check(bytes.len() <= MAX_TEMPLATE_BYTES, "it is too large")?;
    let length = fields.u32()? as usize;
    fields.check(length <= fields.bytes.len(), "it is cut short")?;
    let (inner, rest) = fields.bytes.split_at(length);
    fields.bytes = rest;
    let mut light = [[0.0; 3]; light::TERMS];
    if has_colors {
        for term in light.as_flattened_mut() {
            *term = fields.f32()?;
        }
    }
    let mut template = StreamTemplate::decode_surface(inner)?;
    fields.check(!has_colors || template.nodes() == 0, "it has nodes")?;
    for place in &mut template.node_places {
        *place = [fields.f32()?, fields.f32()?, fields.f32()?];
        fields.check(place.iter().all(|v| v.abs() <= MAX_COORDINATE_M), "a node is out of range")?;
    }
    template.measure_spread();
    let (count, planes) = (template.gaussians(), fields.bytes);
    let wanted = if has_colors { SHAPE_PLANES + COLOR_PLANES } else { SHAPE_PLANES };
    fields.check(planes.len() == wanted * count, "its planes are of another number of Gaussians")?;
    let srgb = Srgb::new();
    let at = |plane: usize, i: usize| planes[plane * count + i];
    let opacity = |i: usize| f32::from(at(7, i)) / 255.0;
    let shape = |i: usize| {
        let [a, b, c] = [0, 1, 2].map(|plane| scale_of(at(plane, i)));
        [a, b, c, opacity(i)]
    };
    let rotation = |i: usize| rotation_of(u32::from_le_bytes([3, 4, 5, 6].map(|plane| at(plane, i))));
    let color = |i: usize| {
        let [red, green, blue] = [8, 9, 10].map(|plane| srgb.linear(f32::from(at(plane, i))));
        [red, green, blue, opacity(i)]
    };
    template.shapes =
        Some(Shapes { scale_opacity: (0..count).map(shape).collect(), rotation: (0..count).map(rotation).collect() });
    template.look = has_colors.then(|| Look { colors: (0..count).map(color).collect(), light });
    template.hash = template_hash(bytes);
    Ok(template)
}

impl StreamTemplate {
    /// Decodes a template, or an avatar.
    ///
    /// # Errors
    /// [`StreamError::Version`] or [`StreamError::Malformed`].
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        let is_avatar = bytes.starts_with(&AVATAR_MAGIC) || bytes.starts_with(&TRACKED_MAGIC);
        if is_avatar { decode(bytes) } else { Self::decode_surface(bytes) }
    }

    /// Returns whether the Gaussians are anisotropic.
    #[must_use]
    pub fn has_axes(&self) -> bool {
        self.shapes.is_some()
    }

    /// Returns whether the template holds the colours, so that poses alone drive it.
    #[must_use]
    pub fn has_colors(&self) -> bool {
        self.look.is_some()
    }

    /// Computes the colours of an avatar, linear RGB and opacity of each Gaussian, lit in a pose of [`Self::pose`]. Returns false, and
    /// changes nothing, for a template whose colours are separate messages.
    pub fn avatar_colors(&self, posed: &Posed, colors: &mut Vec<[f32; 4]>) -> bool {
        let Some(look) = &self.look else { return false };
        colors.clone_from(&look.colors);
        for (color, normal) in colors.iter_mut().zip(&posed.normal) {
            let shade = light::shade(&look.light, [normal[0], normal[1], normal[2]]);
            color.iter_mut().zip(shade).for_each(|(value, shade)| *value *= shade);
        }
        true
    }

    /// Poses the shapes of anisotropic Gaussians, whose centres are those of [`Self::pose`] in `posed`, with the same growth. A rotation is
    /// the normalised blend of the joints' quaternions. Returns false, and changes nothing, for a template of isotropic Gaussians.
    pub fn pose_axes(&self, motion: &Motion, posed: &Posed, axes: &mut PosedAxes) -> bool {
        let Some(shapes) = &self.shapes else { return false };
        let turns: Vec<[f32; 4]> = self.world_from_canonical(motion).iter().map(rotation_part).collect();
        axes.scale_opacity.clone_from(&shapes.scale_opacity);
        if self.nodes > 0 {
            let sizes = self.center_scale.iter().zip(&posed.center_scale);
            for (row, (at_rest, now)) in axes.scale_opacity.iter_mut().zip(sizes) {
                let growth = if at_rest[3] > 0.0 { now[3] / at_rest[3] } else { 1.0 };
                row.iter_mut().take(3).for_each(|scale| *scale *= growth);
            }
        }
        axes.rotation.clear();
        axes.rotation.extend(self.skin.iter().zip(&shapes.rotation).map(|(skin, own)| {
            let mut sum = [0.0f32; 4];
            for (joint, share) in skin.shares() {
                let turn = turns.get(joint).copied().unwrap_or(IDENTITY);
                // A quaternion and its negative are the same rotation.
                let along: f32 = sum.iter().zip(turn).map(|(a, b)| a * b).sum();
                let share = if along < 0.0 { -share } else { share };
                sum.iter_mut().zip(turn).for_each(|(sum, turn)| *sum += share * turn);
            }
            product(unit(sum), *own)
        }));
        true
    }
}

/// Returns the unit quaternion of the linear part of a rigid motion.
fn rotation_part(rows: &[[f32; 4]; 3]) -> [f32; 4] {
    from_rows(rows.map(|[x, y, z, _]| [x, y, z]))
}

fn scale_code(scale_m: f32) -> u8 {
    let share = libm::logf(scale_m.max(LEAST_SCALE_M) / LEAST_SCALE_M) / SCALE_RANGE;
    (255.0 * share.min(1.0) + 0.5) as u8
}

fn scale_of(code: u8) -> f32 {
    LEAST_SCALE_M * libm::expf(SCALE_RANGE * f32::from(code) / 255.0)
}

/// Packs a rotation: the index of its largest component in two bits, the other three in ten bits each.
fn rotation_code(q: [f32; 4]) -> u32 {
    let q = unit(q);
    let largest = (0..4).fold(0, |best, k| if q[k].abs() > q[best].abs() { k } else { best });
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut code = largest as u32;
    for k in (0..4).filter(|k| *k != largest) {
        let share = (sign * q[k] * core::f32::consts::FRAC_1_SQRT_2 + 0.5).clamp(0.0, 1.0);
        code = code << 10 | (ROTATION_STEPS * share + 0.5) as u32;
    }
    code
}

/// Unpacks a rotation.
fn rotation_of(code: u32) -> [f32; 4] {
    let largest = (code >> 30) as usize;
    let mut q = [0.0; 4];
    let (mut shift, mut squared) = (20, 0.0);
    for k in (0..4).filter(|k| *k != largest) {
        let share = (code >> shift & 0x3ff) as f32 / ROTATION_STEPS;
        q[k] = (share - 0.5) * core::f32::consts::SQRT_2;
        squared += q[k] * q[k];
        shift = i32::max(shift - 10, 0);
    }
    q[largest] = libm::sqrtf((1.0 - squared).max(0.0));
    unit(q)
}

#[cfg(test)]
#[path = "avatar_tests.rs"]
mod tests;

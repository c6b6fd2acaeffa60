//! Template of a person that is driven by poses alone: anisotropic Gaussians with their colours.
//!
//! A message is `FLA`, the codec's version, the length of a template without nodes and that template, the terms of the light as 27 `f32`,
//! then planes of bytes with one element per Gaussian in the template's order: three of logarithms of scales, four of a rotation, one of
//! the opacity, three of sRGB. The inner template holds centres, skin, normals and one isotropic size for viewers that draw isotropic
//! Gaussians. The hash is that of the whole message. Every further message of an avatar is a pose: no node translations, no colours.

use alloc::vec::Vec;

use flyrig_model::{
    light,
    quaternion::{IDENTITY, from_rows, product, unit},
};

use crate::{
    attributes::AvatarAttributes,
    bytes::Fields,
    error::StreamError,
    message::{AVATAR_MAGIC, CODEC_VERSION},
    motion::Motion,
    pose::Posed,
    srgb::Srgb,
    template::{EncodedTemplate, MAX_TEMPLATE_BYTES, StreamTemplate, TemplateSource, template_hash},
};

const WHAT: &str = "avatar";
/// Smallest scale, metres, and natural logarithm of the largest over it (0.1 m).
const LEAST_SCALE_M: f32 = 2e-4;
const SCALE_RANGE: f32 = 6.214_608;
/// Number of planes of bytes.
const PLANES: usize = 11;
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
    /// Linear RGB, 0..=1.
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
/// let encoded = AvatarSource { template, gaussians: &[gaussian], light }.encode()?;
/// assert!(StreamTemplate::decode(&encoded.bytes)?.is_avatar());
/// # Ok::<(), flyrig_stream::StreamError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct AvatarSource<'a> {
    /// Centres with isotropic sizes, normals and skin; without nodes.
    pub template: TemplateSource<'a>,
    /// Attributes of the Gaussians, in the order of `template`.
    pub gaussians: &'a [AvatarGaussian],
    /// Light: factors of red, green and blue for each term of the surface's normal in the world.
    pub light: light::Terms,
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
    /// [`StreamError::Template`] when counts differ, there are nodes, or a number is not finite.
    pub fn encode(&self) -> Result<EncodedTemplate, StreamError> {
        let check = |holds: bool, problem| if holds { Ok(()) } else { Err(StreamError::Template(problem)) };
        check(self.template.nodes.is_empty(), "an avatar has no nodes: it is driven by poses alone")?;
        check(self.gaussians.len() == self.template.center_scale.len(), "its lists differ in length")?;
        let numbers = |g: &AvatarGaussian| {
            g.scale_m.iter().chain(&g.rotation).chain(&g.color).chain([&g.opacity]).all(|v| v.is_finite())
        };
        check(self.gaussians.iter().all(numbers), "a Gaussian is not finite")?;
        check(self.light.as_flattened().iter().all(|term| term.is_finite()), "its light is not finite")?;
        let inner = self.template.encode()?;
        let srgb = Srgb::new();
        let mut bytes = Vec::new();
        bytes.extend(AVATAR_MAGIC);
        bytes.push(CODEC_VERSION);
        bytes.extend((inner.bytes.len() as u32).to_le_bytes());
        bytes.extend(&inner.bytes);
        bytes.extend(self.light.as_flattened().iter().flat_map(|term| term.to_le_bytes()));
        let rows: Vec<[u8; PLANES]> = inner
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
        for plane in 0..PLANES {
            bytes.extend(rows.iter().map(|row| row[plane]));
        }
        let template = decode(&bytes)?;
        Ok(EncodedTemplate { template, bytes, gaussian_order: inner.gaussian_order, node_order: Vec::new() })
    }
}

/// Decodes an avatar.
///
/// # Errors
/// [`StreamError::Version`] or [`StreamError::Malformed`].
fn decode(bytes: &[u8]) -> Result<StreamTemplate, StreamError> {
    let mut fields = Fields::new(WHAT, AVATAR_MAGIC, bytes)?;
    fields.check(bytes.len() <= MAX_TEMPLATE_BYTES, "it is too large")?;
    let length = fields.u32()? as usize;
    fields.check(length <= fields.bytes.len(), "it is cut short")?;
    let (inner, rest) = fields.bytes.split_at(length);
    fields.check(rest.len() >= LIGHT_BYTES, "it is cut short")?;
    let (terms, planes) = rest.split_at(LIGHT_BYTES);
    let mut light = [[0.0; 3]; light::TERMS];
    for (term, bytes) in light.as_flattened_mut().iter_mut().zip(terms.as_chunks().0) {
        *term = f32::from_le_bytes(*bytes);
    }
    fields.check(light.as_flattened().iter().all(|term| term.is_finite()), "its light is not finite")?;
    let mut template = StreamTemplate::decode_surface(inner)?;
    fields.check(template.nodes() == 0, "it has nodes")?;
    let count = template.gaussians();
    fields.check(planes.len() == PLANES * count, "its planes are of another number of Gaussians")?;
    let srgb = Srgb::new();
    let at = |plane: usize, i: usize| planes[plane * count + i];
    let mut avatar = AvatarAttributes {
        scale_opacity: Vec::with_capacity(count),
        rotation: Vec::with_capacity(count),
        colors: Vec::with_capacity(count),
        light,
    };
    for i in 0..count {
        let opacity = f32::from(at(7, i)) / 255.0;
        let [a, b, c] = [0, 1, 2].map(|plane| scale_of(at(plane, i)));
        avatar.scale_opacity.push([a, b, c, opacity]);
        avatar.rotation.push(rotation_of(u32::from_le_bytes([3, 4, 5, 6].map(|plane| at(plane, i)))));
        let [red, green, blue] = [8, 9, 10].map(|plane| srgb.linear(f32::from(at(plane, i))));
        avatar.colors.push([red, green, blue, opacity]);
    }
    template.hash = template_hash(bytes);
    template.avatar = Some(avatar);
    Ok(template)
}

impl StreamTemplate {
    /// Decodes a template, or an avatar.
    ///
    /// # Errors
    /// [`StreamError::Version`] or [`StreamError::Malformed`].
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        if bytes.starts_with(&AVATAR_MAGIC) { decode(bytes) } else { Self::decode_surface(bytes) }
    }

    /// Returns whether the template is an avatar, whose colours are part of it.
    #[must_use]
    pub fn is_avatar(&self) -> bool {
        self.avatar.is_some()
    }

    /// Computes the colours of an avatar, linear RGB and opacity of each Gaussian, lit in a pose of [`Self::pose`]. Returns false, and
    /// changes nothing, for a template whose colours are separate messages.
    pub fn avatar_colors(&self, posed: &Posed, colors: &mut Vec<[f32; 4]>) -> bool {
        let Some(avatar) = &self.avatar else { return false };
        colors.clone_from(&avatar.colors);
        for (color, normal) in colors.iter_mut().zip(&posed.normal) {
            let shade = light::shade(&avatar.light, [normal[0], normal[1], normal[2]]);
            color.iter_mut().zip(shade).for_each(|(value, shade)| *value *= shade);
        }
        true
    }

    /// Poses the shapes of an avatar's Gaussians, whose centres are those of [`Self::pose`]. A rotation is the normalised blend of the joints'
    /// quaternions. Returns false, and changes nothing, for a template of isotropic Gaussians.
    pub fn pose_axes(&self, motion: &Motion, posed: &mut PosedAxes) -> bool {
        let Some(avatar) = &self.avatar else { return false };
        let turns: Vec<[f32; 4]> = self.world_from_canonical(motion).iter().map(rotation_part).collect();
        posed.scale_opacity.clone_from(&avatar.scale_opacity);
        posed.rotation.clear();
        posed.rotation.extend(self.skin.iter().zip(&avatar.rotation).map(|(skin, own)| {
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

/// Encoded length of the light, bytes.
const LIGHT_BYTES: usize = 4 * 3 * light::TERMS;

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

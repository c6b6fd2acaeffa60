//! Avatars as templates of the person stream, which viewers pose and draw themselves.

use flyrig_avatar::{Avatar, Bones, PosedAvatar};
use flyrig_body::Skeleton;
use flyrig_renderer::SH_DEGREE_0;
use flyrig_stream::{AvatarGaussian, AvatarSource, EncodedTemplate, StreamError, TemplateSource};
use glam::{DVec3, Vec3};

use super::stream_frame::stream_joints;

/// Encodes an avatar in its rest pose, with the mean shape of its clothes and hair and its colours of order zero, for viewers that poses
/// alone drive.
///
/// # Errors
/// [`StreamError::Template`] for a value that is not finite or too large for the format.
pub fn encode_posed_avatar(avatar: &Avatar) -> Result<EncodedTemplate, StreamError> {
    encode(avatar, &avatar.template.skeleton, false, true)
}

/// Encodes an avatar without deformation and colours, which come with every frame. Without `is_deformed` it has its mean shape and no
/// nodes. `skeleton` is that of the tracked person, which may have more joints: fingers.
pub(crate) fn encode_tracked_avatar(
    avatar: &Avatar,
    skeleton: &Skeleton,
    is_deformed: bool,
) -> Result<EncodedTemplate, StreamError> {
    encode(avatar, skeleton, is_deformed, false)
}

fn encode(
    avatar: &Avatar,
    skeleton: &Skeleton,
    is_deformed: bool,
    has_colors: bool,
) -> Result<EncodedTemplate, StreamError> {
    let hanging = avatar.hanging.as_ref().filter(|_| is_deformed);
    let undeformed = hanging.map(|hanging| vec![DVec3::ZERO; hanging.nodes.len()]);
    let mut rest = PosedAvatar::default();
    avatar.pose(&Bones::at_rest(&avatar.template.skeleton), undeformed.as_deref(), &mut rest);
    let constants = avatar.parameters.harmonics.chunks(avatar.parameters.order().coefficients());
    let rows = rest.scale_opacity.iter().zip(&rest.rotation).zip(constants);
    let gaussians: Vec<AvatarGaussian> = rows
        .map(|((&[x, y, z, opacity], &rotation), constant)| {
            let constant = constant.first().filter(|_| has_colors).copied().unwrap_or_default();
            AvatarGaussian { scale_m: [x, y, z], opacity, rotation, color: linear(constant) }
        })
        .collect();
    let rows = rest.center.iter().zip(&gaussians);
    let center_scale: Vec<[f32; 4]> = rows.map(|(&[x, y, z, _], g)| [x, y, z, disc_size(g.scale_m)]).collect();
    let normals: Vec<[f32; 3]> = avatar.normals().iter().map(Vec3::to_array).collect();
    let skin: Vec<_> = avatar.skin.iter().map(|skin| (skin.joints.map(u32::from), skin.weights)).collect();
    let (nodes, node_weights): (Vec<[f32; 3]>, Vec<_>) = hanging.map_or_else(Default::default, |hanging| {
        let hung = hanging.gaussian_nodes.iter().copied().zip(hanging.gaussian_weights.iter().copied());
        (hanging.nodes.iter().map(Vec3::to_array).collect(), hung.collect())
    });
    let template = TemplateSource {
        joints: &stream_joints(skeleton),
        center_scale: &center_scale,
        normals: &normals,
        skin: &skin,
        node_weights: &node_weights,
        nodes: &nodes,
    };
    AvatarSource { template, gaussians: &gaussians, light: has_colors.then_some(avatar.light.terms) }.encode()
}

/// Returns the linear RGB, 0..=1, of a constant harmonic.
pub(super) fn linear([r, g, b, _]: [f32; 4]) -> [f32; 3] {
    [r, g, b].map(|value| (SH_DEGREE_0 * value).clamp(0.0, 1.0))
}

/// Returns the size of an isotropic Gaussian whose disc has the same area.
fn disc_size(mut scales: [f32; 3]) -> f32 {
    scales.sort_by(f32::total_cmp);
    (scales[1] * scales[2]).sqrt()
}

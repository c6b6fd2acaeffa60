//! Avatars as stream templates, which viewers pose and render themselves.

use anyhow::{Context as _, Result};
use flyrig_avatar::{Avatar, Bones, PosedAvatar};
use flyrig_fusion::stream_joints;
use flyrig_renderer::SH_DEGREE_0;
use flyrig_stream::{AvatarGaussian, AvatarSource, EncodedTemplate, TemplateSource};
use glam::Vec3;

/// Encodes an avatar in its rest pose, with the mean shape of its clothes and hair and its colours of order zero.
///
/// # Errors
/// A value is not finite or too large for the format.
pub fn encode_avatar(avatar: &Avatar) -> Result<EncodedTemplate> {
    let template = &avatar.template;
    let mut rest = PosedAvatar::default();
    avatar.pose(&Bones::at_rest(&template.skeleton), None, &mut rest);
    let coefficients = avatar.parameters.order().coefficients();
    let constants = avatar.parameters.harmonics.chunks(coefficients);
    let rows = rest.scale_opacity.iter().zip(&rest.rotation).zip(constants);
    let gaussians: Vec<AvatarGaussian> = rows
        .map(|((&[x, y, z, opacity], &rotation), constant)| {
            let color = constant.first().copied().unwrap_or_default();
            let color = [0, 1, 2].map(|k| (SH_DEGREE_0 * color[k]).clamp(0.0, 1.0));
            AvatarGaussian { scale_m: [x, y, z], opacity, rotation, color }
        })
        .collect();
    // Viewers of isotropic Gaussians render discs of equal area.
    let size = |[x, y, z]: [f32; 3]| {
        let mut scales = [x, y, z];
        scales.sort_by(f32::total_cmp);
        (scales[1] * scales[2]).sqrt()
    };
    let rows = rest.center.iter().zip(&gaussians);
    let center_scale: Vec<[f32; 4]> = rows.map(|(&[x, y, z, _], g)| [x, y, z, size(g.scale_m)]).collect();
    let normals: Vec<[f32; 3]> = avatar.normals().iter().map(Vec3::to_array).collect();
    let skin: Vec<_> = avatar.skin.iter().map(|skin| (skin.joints.map(u32::from), skin.weights)).collect();
    let template = TemplateSource {
        joints: &stream_joints(&template.skeleton),
        center_scale: &center_scale,
        normals: &normals,
        skin: &skin,
        node_weights: &[],
        nodes: &[],
    };
    AvatarSource { template, gaussians: &gaussians, light: avatar.light.terms }
        .encode()
        .context("the avatar cannot be sent to viewers")
}

#[cfg(test)]
mod tests {
    use flyrig_avatar::AvatarScene;
    use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
    use flyrig_gpu::{AdapterChoice, GpuContext};
    use flyrig_renderer::HarmonicOrder;
    use flyrig_stream::{Motion, MotionEncoder, Posed, PosedAxes, StreamTemplate};
    use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
    use flyrig_viewer::{PeopleScene, ShownPerson};
    use glam::{DQuat, DVec2, DVec3, Vec4};

    use super::*;

    /// Returns a striped avatar whose clothes hang 3 cm in front of the body, with stretched Gaussians in all directions.
    fn avatar() -> Avatar {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 12_000, 5).unwrap();
        let graph = build_graph(&template, &surface, 100, DEFAULT_SIGMA2_M2).unwrap();
        let stripes = |p: &Vec3| if (p.y * 20.0) as i32 % 2 == 0 { [0.8, 0.1, 0.1] } else { [0.1, 0.3, 0.7] };
        let colors: Vec<[f32; 3]> = surface.positions.iter().map(stripes).collect();
        let mut avatar = Avatar::new(&template, &surface, Some(&graph), &colors, HarmonicOrder::One).unwrap();
        for (i, shape) in avatar.parameters.shape.iter_mut().enumerate() {
            shape[i % 2] += 0.5;
            avatar.parameters.offset[i] = [0.002 * (i as f32).sin(), 0.0, 0.001, 0.0];
        }
        // A lamp from the side, and a red one from above.
        avatar.light.terms[1] = [0.4; 3];
        avatar.light.terms[8] = [-0.1; 3];
        avatar.light.terms[2][0] = 0.3;
        avatar.hanging.as_mut().unwrap().mean.iter_mut().for_each(|by| *by = DVec3::Z * 0.03);
        avatar
    }

    #[test]
    fn viewers_draw_from_a_pose_what_the_avatar_shows() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap().fastest();
        let avatar = avatar();
        let encoded = encode_avatar(&avatar).unwrap();
        let template = StreamTemplate::decode(&encoded.bytes).unwrap();
        assert!(encoded.bytes.len() < 12_000 * 40, "{} bytes", encoded.bytes.len());
        let skeleton = &avatar.template.skeleton;
        let mut pose = skeleton.rest_pose();
        pose.root_translation = DVec3::new(0.2, 0.9, -0.1);
        for (k, rotation) in pose.joint_rotations.iter_mut().enumerate() {
            *rotation *= DQuat::from_rotation_z(0.25 * (k as f64 * 2.3).sin());
        }
        let motion = Motion {
            root_translation: pose.root_translation.as_vec3().to_array(),
            joint_rotations: pose.joint_rotations.iter().map(|rotation| rotation.as_quat().to_array()).collect(),
            ..Motion::default()
        };
        let bytes = MotionEncoder::new(&encoded).encode(&motion).unwrap();
        assert!(bytes.len() <= 512, "{} bytes a frame", bytes.len());
        let motion = Motion::decode(&bytes, &template).unwrap();
        let (mut posed, mut axes) = (Posed::default(), PosedAxes::default());
        template.pose(&motion, &mut posed);
        assert!(template.pose_axes(&motion, &mut axes));

        let mut ours = PeopleScene::new(&gpu).unwrap();
        let mut colors = Vec::new();
        assert!(template.avatar_colors(&posed, &mut colors));
        let colors = colors.as_slice();
        let shown = ShownPerson { posed: &posed, colors, axes: Some(&axes) };
        let mut theirs = AvatarScene::new(&gpu, &avatar).unwrap();
        theirs.pose(&avatar, &Bones::new(skeleton, &pose), None);
        let middle = pose.root_translation;
        for side in [DVec3::Z, DVec3::NEG_Z, DVec3::X] {
            let camera = Camera {
                id: "view".into(),
                intrinsics: Intrinsics {
                    width: 160,
                    height: 224,
                    focal_px: DVec2::splat(240.0),
                    center_px: DVec2::new(80.0, 112.0),
                    lens: Lens::PINHOLE,
                },
                camera_from_world: Isometry::look_at(middle + side * 2.6, middle, DVec3::Y),
                time_offset_nanos: 0,
                color: Default::default(),
            };
            ours.set_people([shown]).unwrap();
            let (found, expected) = (ours.draw(&camera).unwrap(), theirs.draw(&camera).unwrap());
            let opaque = expected.rgba.chunks_exact(4).filter(|pixel| pixel[3] > 200).count();
            assert!(opaque > 2000, "{opaque} pixels show the person");
            let squares: f64 =
                found.rgba.iter().zip(&expected.rgba).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum();
            let decibels = 10.0 * (255.0f64.powi(2) * found.rgba.len() as f64 / squares.max(1.0)).log10();
            assert!(decibels > 38.0, "{side}: {decibels} dB");
            // Beside a person without an avatar, both are rendered.
            let mut far = posed.clone();
            far.center_scale.iter_mut().for_each(|row| row[0] += 100.0);
            let plain = ShownPerson::from((&far, colors));
            ours.set_people([plain, shown]).unwrap();
            let both = ours.draw(&camera).unwrap();
            let most = both.rgba.iter().zip(&found.rgba).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(most.unwrap() <= 1, "{side}: {most:?}");
        }
    }

    #[test]
    fn what_cannot_be_sent_is_named() {
        let mut avatar = avatar();
        avatar.parameters.offset[7] = Vec4::NAN.to_array();
        let error = format!("{:#}", encode_avatar(&avatar).unwrap_err());
        assert!(error.contains("cannot be sent") && error.contains("not finite"), "{error}");
    }
}

//! Avatars as stream templates, which viewers pose and render themselves.

use anyhow::{Context as _, Result};
use flyrig_avatar::Avatar;
use flyrig_fusion::encode_posed_avatar;
use flyrig_stream::EncodedTemplate;

/// Encodes an avatar for viewers that poses alone drive, see [`encode_posed_avatar`].
///
/// # Errors
/// A value is not finite or too large for the format.
pub fn encode_avatar(avatar: &Avatar) -> Result<EncodedTemplate> {
    encode_posed_avatar(avatar).context("the avatar cannot be sent to viewers")
}

#[cfg(test)]
mod tests {
    use flyrig_avatar::{AvatarScene, Bones};
    use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
    use std::sync::Arc;

    use flyrig_fusion::{
        FrameSet, GivenPerception, GivenPerson, Outcome, PersonEncoder, PersonId, PersonMemory, PersonMessages,
        SessionBuilder, SessionSettings,
    };
    use flyrig_gpu::{AdapterChoice, GpuContext};
    use flyrig_renderer::HarmonicOrder;
    use flyrig_stream::{ColorDecoder, ColorSettings, Motion, MotionEncoder, Posed, PosedAxes, StreamTemplate};
    use flyrig_types::{
        Camera, Frame, Image, Intrinsics, Isometry, Lens, Mask, PixelFormat, PoseTrack, RenderedView, Rig,
    };
    use flyrig_viewer::{PeopleScene, ShownPerson};
    use glam::{DQuat, DVec2, DVec3, Vec3, Vec4};

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
        assert!(template.pose_axes(&motion, &posed, &mut axes));

        let mut ours = PeopleScene::new(&gpu).unwrap();
        let mut colors = Vec::new();
        assert!(template.avatar_colors(&posed, &mut colors));
        let colors = colors.as_slice();
        let shown = ShownPerson { posed: &posed, colors, axes: Some(&axes) };
        let mut theirs = AvatarScene::new(&gpu, &avatar).unwrap();
        theirs.pose(&avatar, &Bones::new(skeleton, &pose), None);
        let middle = pose.root_translation;
        for side in [DVec3::Z, DVec3::NEG_Z, DVec3::X] {
            let camera = beside(middle, side, "view");
            ours.set_people([shown]).unwrap();
            let (found, expected) = (ours.draw(&camera).unwrap(), theirs.draw(&camera).unwrap());
            let opaque = expected.rgba.chunks_exact(4).filter(|pixel| pixel[3] > 200).count();
            assert!(opaque > 2000, "{opaque} pixels show the person");
            let loss = decibels(&found, &expected);
            assert!(loss > 38.0, "{side}: {loss} dB");
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

    /// Returns a camera 2.6 m beside a point.
    fn beside(middle: DVec3, side: DVec3, name: &str) -> Camera {
        Camera {
            id: name.into(),
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
        }
    }

    /// Returns how much two images differ, decibels.
    fn decibels(found: &RenderedView, expected: &RenderedView) -> f64 {
        let squares: f64 = found.rgba.iter().zip(&expected.rgba).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum();
        10.0 * (255.0f64.powi(2) * found.rgba.len() as f64 / squares.max(1.0)).log10()
    }

    /// A tracked person who is made of an avatar: viewers get its axes once, and then motion and colours.
    #[test]
    fn viewers_draw_a_tracked_avatar_as_the_rig_does() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap().fastest();
        let avatar = avatar();
        let mut pose = avatar.template.skeleton.rest_pose();
        for (k, rotation) in pose.joint_rotations.iter_mut().enumerate() {
            *rotation *= DQuat::from_rotation_z(0.25 * (k as f64 * 2.3).sin());
        }
        let middle = pose.root_translation;
        let sides = [("a", DVec3::Z), ("b", DVec3::NEG_Z), ("c", DVec3::X)];
        let cameras: Vec<Camera> = sides.map(|(name, side)| beside(middle, side, name)).into();
        let rig = Rig { cameras: cameras.clone(), world_up: DVec3::Y };
        // Images of the avatar with its clothes moved, in a darker light.
        let mut truth = avatar.clone();
        truth.light.terms[0] = [0.6; 3];
        truth.hanging.as_mut().unwrap().mean.iter_mut().for_each(|by| *by = DVec3::new(0.02, 0.0, 0.03));
        let mut scene = AvatarScene::new(&gpu, &truth).unwrap();
        scene.pose(&truth, &Bones::new(&truth.template.skeleton, &pose), None);
        let frame = |camera: &Camera| {
            let view = scene.draw(camera).unwrap();
            let (width, height) = (view.width, view.height);
            let rgb: Vec<u8> = view.rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
            let mask = view.rgba.iter().skip(3).step_by(4).copied().collect();
            Some(Arc::new(Frame {
                camera: camera.id.clone(),
                sequence: 0,
                capture_nanos: 0,
                exposure_nanos: None,
                image: Image::new(width, height, PixelFormat::Rgb8, rgb).unwrap(),
                mask: Some(Mask::new(width, height, mask).unwrap()),
            }))
        };
        let frames: Vec<_> = cameras.iter().map(frame).collect();

        let track = PoseTrack::new(vec![(0, pose.clone()), (1_000_000_000, pose.clone())]).unwrap();
        let (person, template) = (PersonId::default(), avatar.template.clone());
        let given = GivenPerson { person, template, track, repeat: true };
        let mut settings = SessionSettings::default();
        settings.body.gaussians = 12_000;
        let mut session = SessionBuilder::new(gpu.clone(), rig.clone())
            .settings(settings)
            .perception(GivenPerception::new(&rig, vec![given]).dressed())
            .person(person, PersonMemory::of_avatar(Arc::new(avatar)))
            .build()
            .unwrap();
        let mut received = None;
        for index in 0..6 {
            let set = FrameSet { index, master_nanos: index as i64 * 33_000_000, frames: frames.clone() };
            assert_eq!(session.process(&set).unwrap(), Outcome::Updated);
            let frame = session.person_frame(person, &set).unwrap().unwrap();
            let (encoder, template, decoder) = received.get_or_insert_with(|| {
                let template = StreamTemplate::decode(&frame.template().bytes).unwrap();
                let decoder = ColorDecoder::new(&template);
                (PersonEncoder::new(&frame, ColorSettings::default(), 1), template, decoder)
            });
            let PersonMessages { motion, colors, .. } = encoder.encode(&frame).unwrap();
            for layer in &colors {
                decoder.ingest(layer).unwrap();
            }
            let motion = Motion::decode(&motion, template).unwrap();
            let (mut posed, mut axes, mut colors) = (Posed::default(), PosedAxes::default(), Vec::new());
            template.pose(&motion, &mut posed);
            assert!(template.has_axes() && !template.has_colors() && template.nodes() == 100);
            assert!(template.pose_axes(&motion, &posed, &mut axes));
            decoder.colors(&mut colors);
            let mut viewer = PeopleScene::new(&gpu).unwrap();
            viewer.set_people([ShownPerson { posed: &posed, colors: &colors, axes: Some(&axes) }]).unwrap();
            for camera in &cameras {
                let (found, expected) = (viewer.draw(camera).unwrap(), session.render(camera).unwrap());
                let loss = decibels(&found, &expected);
                assert!(loss > 38.0, "{index} {}: {loss} dB", camera.id);
            }
            // The images have made it darker than the avatar was.
            let mean = |list: &[[f32; 4]]| list.iter().map(|c| c[0] + c[1] + c[2]).sum::<f32>() / list.len() as f32;
            assert!(index < 5 || mean(&colors) < 0.8, "{}", mean(&colors));
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

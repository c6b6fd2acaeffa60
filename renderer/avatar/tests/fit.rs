//! Fitting finds an avatar that explains its images, and does the same again.

#![allow(clippy::unwrap_used)]

use flyrig_avatar::{
    AtlasLayout, Avatar, AvatarFitSettings, AvatarModel, AvatarScene, Bones, LocalSettings, TrainingFrame,
};
use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
use flyrig_fit::{Fit, FitSettings, TrainingView};
use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::HarmonicOrder;
use flyrig_types::{Camera, Intrinsics, Isometry, Pose};
use glam::{DQuat, DVec3};

const SIZE: u32 = 96;

fn avatar(color: impl Fn(usize) -> [f32; 3], gaussians: usize) -> Avatar {
    let template = default_template(&ShapeParams::default()).unwrap();
    let surface = sample_surface(&template, gaussians, 1).unwrap();
    let graph = build_graph(&template, &surface, 30, DEFAULT_SIGMA2_M2).unwrap();
    let colors: Vec<[f32; 3]> = (0..surface.len()).map(color).collect();
    Avatar::new(&template, &surface, Some(&graph), &colors, HarmonicOrder::One).unwrap()
}

/// Around a body that stands at the origin with y up.
fn camera(angle: f64) -> Camera {
    let center = DVec3::Y * 0.9;
    let eye = center + DQuat::from_rotation_y(-angle) * (DVec3::Z * 2.6);
    Camera::new("view", Intrinsics::pinhole(SIZE, SIZE, 110.0), Isometry::look_at(eye, center, DVec3::Y))
}

/// Frames and images of an avatar.
fn take(gpu: &GpuContext, truth: &Avatar) -> (Vec<TrainingFrame>, Vec<TrainingView>) {
    let mut scene = AvatarScene::new(gpu, truth).unwrap();
    let (mut frames, mut views) = (Vec::new(), Vec::new());
    for turn in [0.0, 0.4] {
        let skeleton = &truth.template.skeleton;
        let mut pose = skeleton.rest_pose();
        pose.joint_rotations.iter_mut().skip(3).step_by(4).for_each(|joint| *joint *= DQuat::from_rotation_z(turn));
        let bones = Bones::new(skeleton, &pose);
        scene.pose(truth, &bones, None);
        for angle in [0.0, 2.1, 4.2] {
            let camera = camera(angle);
            let view = scene.draw(&camera).unwrap();
            views.push(TrainingView::cut(frames.len(), &camera, &view.rgba).unwrap());
        }
        frames.push(TrainingFrame { pose, translations: Vec::new() });
    }
    (frames, views)
}

fn fit_of(gpu: &GpuContext, model: AvatarModel, views: &[TrainingView]) -> Fit<AvatarModel> {
    Fit::new(gpu, model, views.to_vec(), FitSettings::default()).unwrap()
}

#[test]
fn a_fit_explains_its_images_and_the_same_steps_give_the_same_bytes() {
    on_both(|gpu| {
        let truth = avatar(|i| [[0.5, 0.1, 0.1], [0.1, 0.4, 0.6], [0.6, 0.6, 0.2]][i / 40 % 3], 1500);
        let (frames, views) = take(gpu, &truth);
        let run = |steps: u32| {
            let settings = AvatarFitSettings { color_rate: [5e-2, 1e-2], ..AvatarFitSettings::default() };
            let model = AvatarModel::new(avatar(|_| [0.2; 3], 1500), frames.clone(), settings);
            let mut fit = fit_of(gpu, model, &views);
            assert_eq!(fit.images(), 6);
            let before = fit.decibels().unwrap();
            for step in 0..steps {
                let report = fit.step(step as f32 / steps as f32).unwrap();
                assert!(report.loss.is_finite() && report.decibels.is_finite());
            }
            (before, fit.decibels().unwrap(), fit.into_model().into_avatar())
        };
        let (before, after, _) = run(120);
        assert!(after > before + 4.0, "{before} {after}");
        assert!(run(7).2.to_bytes().unwrap() == run(7).2.to_bytes().unwrap());
    });
}

#[test]
fn a_fit_that_was_killed_ends_as_one_that_was_not() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let truth = avatar(|i| [[0.5, 0.1, 0.1], [0.1, 0.4, 0.6], [0.6, 0.6, 0.2]][i / 40 % 3], 1500);
    let (mut frames, views) = take(&gpu, &truth);
    frames.iter_mut().for_each(|frame| frame.translations = truth.hanging.as_ref().unwrap().mean.clone());
    let networks = LocalSettings { stages: 2, layout: AtlasLayout::FrontBack, side: 32, ..LocalSettings::default() };
    let geometry = LocalSettings { colors: false, ..networks.clone() };
    for networks in [None, Some(networks), Some(geometry)] {
        let begin = || {
            let settings = AvatarFitSettings {
                refine_poses: true,
                skin_correction: true,
                refine_nodes: true,
                ..AvatarFitSettings::default()
            };
            let mut model = AvatarModel::new(avatar(|_| [0.2; 3], 1500), frames.clone(), settings);
            if let Some(networks) = &networks {
                model.use_networks(&[], networks, 1).unwrap();
            }
            fit_of(&gpu, model, &views)
        };
        let bytes = |fit: &Fit<AvatarModel>| fit.model().avatar().to_bytes().unwrap();
        // Past several rounds of six images.
        let run = |fit: &mut Fit<AvatarModel>, steps: std::ops::Range<u32>| {
            for step in steps {
                fit.step(step as f32 / 120.0).unwrap();
            }
        };
        let mut whole = begin();
        run(&mut whole, 0..120);
        let mut killed = begin();
        run(&mut killed, 0..91);
        let state = killed.checkpoint("a take", 120).unwrap();
        drop(killed);
        let mut resumed = begin();
        let progress = resumed.resume(&state, "a take").unwrap();
        assert_eq!((progress.done, progress.total), (91, 120));
        run(&mut resumed, 91..120);
        assert!(bytes(&whole) == bytes(&resumed), "{networks:?}");

        // A refused state changes nothing.
        let mut other = begin();
        let before = bytes(&other);
        let mut refused = |bytes: &[u8], settings: &str| other.resume(bytes, settings).unwrap_err();
        assert!(refused(&state, "another take").contains("another take"));
        assert!(refused(b"", "a take").contains("no state of a fit"));
        assert!(refused(&before, "a take").contains("no state of a fit"));
        assert!(refused(&state[..state.len() - 4], "a take").contains("no state of a fit"));
        let mut poisoned = state.clone();
        let last = poisoned.len() - 4;
        poisoned[last..].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(refused(&poisoned, "a take").contains("is damaged"));
        assert!(before == bytes(&other));
    }
}

#[test]
fn wrong_poses_are_corrected() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let truth = avatar(|i| [[0.5, 0.1, 0.1], [0.1, 0.4, 0.6], [0.6, 0.6, 0.2]][i / 40 % 3], 1500);
    let (frames, views) = take(&gpu, &truth);
    let joints = truth.template.skeleton.joints();
    let arms: Vec<usize> = (0..joints.len()).filter(|i| joints[*i].name.ends_with("Arm")).collect();
    let hands = ["LeftHand", "RightHand"].map(|name| truth.template.skeleton.joint(name).unwrap());
    let mut wrong = frames.clone();
    for (frame, turn) in wrong.iter_mut().zip([0.08, -0.08]) {
        arms.iter().for_each(|arm| frame.pose.joint_rotations[*arm] *= DQuat::from_rotation_z(turn));
        frame.pose.root_translation += DVec3::X * turn * 0.2;
    }
    let run = |refine_poses: bool| {
        let settings = AvatarFitSettings { refine_poses, ..AvatarFitSettings::default() };
        let mut fit = fit_of(&gpu, AvatarModel::new(truth.clone(), wrong.clone(), settings), &views);
        for step in 0..300 {
            fit.step(step as f32 / 300.0).unwrap();
        }
        // Shoulder and upper arm may share a turn: what counts is where it brings the wrist.
        let wrists = |pose: &Pose| {
            let world = truth.template.skeleton.world_from_joint(pose);
            hands.each_ref().map(|hand| world[*hand].w_axis.truncate())
        };
        let mut off = 0.0;
        for (i, frame) in frames.iter().enumerate() {
            let (found, right) = (wrists(&fit.model().pose(i).unwrap()), wrists(&frame.pose));
            off += found.iter().zip(&right).map(|(found, right)| found.distance(*right)).sum::<f64>() / 4.0;
        }
        assert!(fit.model().pose(frames.len()).is_none());
        (off, fit.decibels().unwrap())
    };
    let (without, with) = (run(false), run(true));
    assert!(without.0 > 0.02 && with.0 < 0.4 * without.0, "{without:?} {with:?}");
    assert!(with.1 > without.1 + 3.0, "{without:?} {with:?}");
}

#[test]
fn wrong_node_translations_of_one_frame_are_corrected() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let truth = avatar(|i| [[0.5, 0.1, 0.1], [0.1, 0.4, 0.6], [0.6, 0.6, 0.2]][i / 40 % 3], 1500);
    let (mut frames, views) = take(&gpu, &truth);
    let right = truth.hanging.as_ref().unwrap().mean.clone();
    frames.iter_mut().for_each(|frame| frame.translations = right.clone());
    frames[0].translations.iter_mut().for_each(|node| *node += DVec3::new(0.012, 0.0, 0.008));
    let off = |frames: &[TrainingFrame]| {
        let rows = frames.iter().flat_map(|frame| frame.translations.iter().zip(&right));
        rows.map(|(found, right)| found.distance(*right)).sum::<f64>() / (2 * right.len()) as f64
    };
    let run = |refine_nodes: bool| {
        let settings = AvatarFitSettings { refine_nodes, ..AvatarFitSettings::default() };
        let mut fit = fit_of(&gpu, AvatarModel::new(truth.clone(), frames.clone(), settings), &views);
        for step in 0..150 {
            fit.step(step as f32 / 150.0).unwrap();
        }
        (fit.decibels().unwrap(), off(&fit.into_model().into_parts().1))
    };
    let ((without_db, without), (with_db, with)) = (run(false), run(true));
    assert!((without - off(&frames)).abs() < 1e-9, "{without}");
    // Half of the nodes are hidden or move along the line of sight, where images of 96 pixels tell little.
    assert!(with < 0.9 * without && with_db > without_db + 1.0, "{without} {with}, {without_db} {with_db} dB");
}

#[test]
fn a_broken_avatar_stays_where_it_is() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let mut broken = avatar(|_| [0.2; 3], 1000);
    broken.parameters.shape.fill([f32::NAN; 4]);
    let frames = vec![TrainingFrame { pose: broken.template.skeleton.rest_pose(), translations: Vec::new() }];
    let all = vec![255; SIZE as usize * SIZE as usize * 4];
    let views = [TrainingView::cut(0, &camera(0.0), &all).unwrap()];
    let mut fit = fit_of(&gpu, AvatarModel::new(broken, frames, AvatarFitSettings::default()), &views);
    assert!(fit.step(f32::NAN).unwrap().loss.is_finite());
    fit.into_model().into_avatar().to_bytes().unwrap_err();
}

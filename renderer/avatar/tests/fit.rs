//! Fitting finds an avatar that explains its images, and does the same again.

#![allow(clippy::unwrap_used)]

use flyrig_avatar::{
    AtlasLayout, Avatar, AvatarError, AvatarScene, Bones, Fit, FitSettings, LocalSettings, TrainingFrame, TrainingView,
};
use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::HarmonicOrder;
use flyrig_types::{Camera, Intrinsics, Isometry, Lens, Pose};
use glam::{DQuat, DVec2, DVec3};

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
    let rotation = DQuat::from_rotation_x(std::f64::consts::PI) * DQuat::from_rotation_y(angle);
    let place = rotation.inverse() * DVec3::new(0.0, 0.0, -2.6) + DVec3::Y * 0.9;
    Camera {
        id: "view".into(),
        intrinsics: Intrinsics {
            width: SIZE,
            height: SIZE,
            focal_px: DVec2::splat(110.0),
            center_px: DVec2::splat(f64::from(SIZE) / 2.0),
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry { rotation, translation: -(rotation * place) },
        time_offset_nanos: 0,
        color: Default::default(),
    }
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

#[test]
fn a_fit_explains_its_images_and_the_same_steps_give_the_same_bytes() {
    on_both(|gpu| {
        let truth = avatar(|i| [[0.5, 0.1, 0.1], [0.1, 0.4, 0.6], [0.6, 0.6, 0.2]][i / 40 % 3], 1500);
        let (frames, views) = take(gpu, &truth);
        let run = |steps: u32| {
            let mut ours = avatar(|_| [0.2; 3], 1500);
            let settings = FitSettings { color_rate: [5e-2, 1e-2], ..FitSettings::default() };
            let mut fit = Fit::new(gpu, &ours, frames.clone(), views.clone(), settings).unwrap();
            assert_eq!(fit.images(), 6);
            let before = fit.decibels(&ours).unwrap();
            for step in 0..steps {
                let report = fit.step(&mut ours, step as f32 / steps as f32).unwrap();
                assert!(report.loss.is_finite() && report.decibels.is_finite());
            }
            (before, fit.decibels(&ours).unwrap(), ours)
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
    let (frames, views) = take(&gpu, &truth);
    let networks = LocalSettings { stages: 2, layout: AtlasLayout::FrontBack, side: 32, ..LocalSettings::default() };
    let geometry = LocalSettings { colors: false, ..networks.clone() };
    for networks in [None, Some(networks), Some(geometry)] {
        let begin = || {
            let mut ours = avatar(|_| [0.2; 3], 1500);
            let settings = FitSettings { refine_poses: true, skin_correction: true, ..FitSettings::default() };
            let mut fit = Fit::new(&gpu, &ours, frames.clone(), views.clone(), settings).unwrap();
            if let Some(networks) = &networks {
                fit.use_networks(&mut ours, &[], networks).unwrap();
            }
            (fit, ours)
        };
        // Past several rounds of six images.
        let run = |(fit, ours): &mut (Fit, Avatar), steps: std::ops::Range<u32>| {
            for step in steps {
                fit.step(ours, step as f32 / 120.0).unwrap();
            }
        };
        let mut whole = begin();
        run(&mut whole, 0..120);
        let mut killed = begin();
        run(&mut killed, 0..91);
        let state = killed.0.checkpoint(&mut killed.1, "a take", 120).unwrap();
        drop(killed);
        let mut resumed = begin();
        let progress = resumed.0.resume(&mut resumed.1, &state, "a take").unwrap();
        assert_eq!((progress.done, progress.total), (91, 120));
        run(&mut resumed, 91..120);
        assert!(whole.1.to_bytes().unwrap() == resumed.1.to_bytes().unwrap(), "{networks:?}");

        // A refused state changes nothing.
        let mut other = begin();
        let before = other.1.to_bytes().unwrap();
        let mut refused = |bytes: &[u8], settings: &str| other.0.resume(&mut other.1, bytes, settings).unwrap_err();
        assert!(refused(&state, "another take").contains("another take"));
        assert!(refused(b"", "a take").contains("no state of a fit"));
        assert!(refused(&before, "a take").contains("no state of a fit"));
        assert!(refused(&state[..state.len() - 4], "a take").contains("no state of a fit"));
        let mut poisoned = state.clone();
        let last = poisoned.len() - 4;
        poisoned[last..].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(refused(&poisoned, "a take").contains("is damaged"));
        assert!(before == other.1.to_bytes().unwrap());
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
        let mut ours = truth.clone();
        let settings = FitSettings { refine_poses, skin_correction: false, ..FitSettings::default() };
        let mut fit = Fit::new(&gpu, &ours, wrong.clone(), views.clone(), settings).unwrap();
        for step in 0..300 {
            fit.step(&mut ours, step as f32 / 300.0).unwrap();
        }
        // Shoulder and upper arm may share a turn: what counts is where it brings the wrist.
        let wrists = |pose: &Pose| {
            let world = truth.template.skeleton.world_from_joint(pose);
            hands.each_ref().map(|hand| world[*hand].w_axis.truncate())
        };
        let mut off = 0.0;
        for (i, frame) in frames.iter().enumerate() {
            let (found, right) = (wrists(&fit.pose(i).unwrap()), wrists(&frame.pose));
            off += found.iter().zip(&right).map(|(found, right)| found.distance(*right)).sum::<f64>() / 4.0;
        }
        assert!(fit.pose(frames.len()).is_none());
        (off, fit.decibels(&ours).unwrap())
    };
    let (without, with) = (run(false), run(true));
    assert!(without.0 > 0.02 && with.0 < 0.4 * without.0, "{without:?} {with:?}");
    assert!(with.1 > without.1 + 3.0, "{without:?} {with:?}");
}

#[test]
fn images_that_show_nobody_and_frames_that_are_missing_are_refused() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let ours = avatar(|_| [0.2; 3], 1000);
    let all = vec![255; SIZE as usize * SIZE as usize * 4];
    assert!(TrainingView::cut(0, &camera(0.0), &[]).is_none());
    assert!(TrainingView::cut(0, &camera(0.0), &vec![0; all.len()]).is_none());
    let refused = |views: Vec<TrainingView>| match Fit::new(&gpu, &ours, Vec::new(), views, FitSettings::default()) {
        Err(AvatarError::Images(text)) => text,
        other => panic!("{other:?}"),
    };
    assert!(refused(Vec::new()).contains("no person is in any image"));
    assert!(refused(vec![TrainingView::cut(3, &camera(0.0), &all).unwrap()]).contains("without a pose"));
    // A broken avatar stays where it is; the image that fills everything is cut to itself.
    let mut broken = ours.clone();
    broken.parameters.shape.fill([f32::NAN; 4]);
    let frames = vec![TrainingFrame { pose: ours.template.skeleton.rest_pose(), translations: Vec::new() }];
    let views = vec![TrainingView::cut(0, &camera(0.0), &all).unwrap()];
    let mut fit = Fit::new(&gpu, &broken, frames, views, FitSettings::default()).unwrap();
    assert!(fit.step(&mut broken, f32::NAN).unwrap().loss.is_finite());
    broken.to_bytes().unwrap_err();
}

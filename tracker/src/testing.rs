//! Synthetic rigs, bodies and landmarks for the tests.

use flyrig_body::{ShapeParams, Template, default_template, skin_mesh};
use flyrig_solve::exp_rotation;
use flyrig_types::{Camera, Intrinsics, Isometry, Lens, Mask, Pose, Rig};
use glam::{DQuat, DVec2, DVec3};
use rand::{RngExt, SeedableRng, rngs::StdRng};

use crate::landmarks::keypoints::{Keypoint, LANDMARK_COUNT, ViewKeypoints};
use crate::masks::gate::drawn_body;
use crate::pose::body_model::{BodyModel, JointTurns};
use crate::pose::fit::{FitProblem, FitView};

pub(crate) fn body() -> Template {
    default_template(&ShapeParams::default()).unwrap()
}

/// Returns a pinhole camera of square images at the world's origin, focal length 90 pixels.
pub(crate) fn small_camera(id: &str, side: usize) -> Camera {
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: id.into(),
        intrinsics: Intrinsics {
            width: side as u32,
            height: side as u32,
            focal_px: DVec2::splat(90.0),
            center_px: DVec2::splat(0.5 * side as f64 - 0.5),
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry::IDENTITY,
    }
}

/// Returns cameras on a ring of 3.5 m around the origin, z up, with some distortion.
pub(crate) fn ring(count: usize) -> Rig {
    let cameras = (0..count)
        .map(|i| {
            let angle = i as f64 * std::f64::consts::TAU / (count as f64 + 0.5);
            let eye = DVec3::new(3.5 * angle.cos(), 3.5 * angle.sin(), 1.5);
            Camera {
                time_offset_nanos: 0,
                color: Default::default(),
                id: format!("{i}").into(),
                intrinsics: Intrinsics {
                    width: 800,
                    height: 800,
                    focal_px: DVec2::splat(900.0),
                    center_px: DVec2::new(402.0, 395.0),
                    lens: Lens::RadialTangential { radial: [-0.05, 0.02, 0.0], tangential: [1e-3, -5e-4] },
                },
                camera_from_world: Isometry::look_at(eye, DVec3::new(0.0, 0.0, 1.0), DVec3::Z),
            }
        })
        .collect();
    Rig { cameras, world_up: DVec3::Z }
}

pub(crate) fn keypoints_of(camera: &Camera, points: &[DVec3; LANDMARK_COUNT]) -> ViewKeypoints {
    points.map(|point| match camera.project(point) {
        Some(pixel) => Keypoint { pixel, confidence: 0.9, ..Default::default() },
        None => Keypoint::default(),
    })
}

/// Returns a fit to landmarks alone, without a last pose.
pub(crate) fn fit_problem<'a>(model: &'a BodyModel, views: &'a [FitView], landmark_spread: f64) -> FitProblem<'a> {
    FitProblem { model, views, lines: &[], points: [None; LANDMARK_COUNT], before: None, landmark_spread, robust: 2.0 }
}

/// Returns the mask of a posed body.
pub(crate) fn mask_of(camera: &Camera, template: &Template, pose: &Pose) -> Mask {
    let (vertices, _) = skin_mesh(template, pose);
    let ([x0, y0, ..], body) = drawn_body(camera, &vertices, &template.triangles, 4.0).unwrap();
    body.paste(camera.intrinsics.width as usize, camera.intrinsics.height as usize, x0, y0).unwrap()
}

/// Returns [`keypoints_of`] with uniform noise of about `noise_px` standard deviation.
pub(crate) fn noisy_keypoints(
    camera: &Camera,
    points: &[DVec3; LANDMARK_COUNT],
    noise_px: f64,
    rng: &mut StdRng,
) -> ViewKeypoints {
    keypoints_of(camera, points).map(|mut keypoint| {
        let mut uniform = || rng.random_range(-1.7..1.7) * noise_px;
        keypoint.pixel += DVec2::new(uniform(), uniform());
        keypoint
    })
}

/// Returns a body that stands near the origin of a z-up world in a comfortable pose.
pub(crate) fn random_turns(model: &BodyModel, seed: u64) -> JointTurns {
    let mut rng = StdRng::seed_from_u64(seed);
    let mut turns = model.bind_turns(DVec3::new(rng.random_range(-0.2..0.2), rng.random_range(-0.2..0.2), 1.0));
    for (turn, range) in turns.turns.iter_mut().zip(&model.ranges) {
        if let Some(range) = range {
            let component = |low: f64, high: f64, sigma: f64, rng: &mut StdRng| {
                (rng.random_range(-1.0..1.0) * sigma).clamp(low, high)
            };
            let v = DVec3::new(
                component(range.low.x, range.high.x, range.sigma.x.min(0.6), &mut rng),
                component(range.low.y, range.high.y, range.sigma.y.min(0.4), &mut rng),
                component(range.low.z, range.high.z, range.sigma.z.min(0.6), &mut rng),
            );
            *turn = exp_rotation(range.axes * v);
        }
    }
    // Stand up (y up to z up), face anywhere.
    turns.turns[0] = DQuat::from_rotation_z(rng.random_range(-3.0..3.0))
        * DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2)
        * exp_rotation(DVec3::new(0.1, 0.0, -0.1));
    turns
}

//! Linear blend skinning: CPU and GPU against the plain f64 reference.
// Helpers of tests may stop a test.
#![allow(clippy::unwrap_used, clippy::panic)]

use flyrig_body::{
    BodyError, GpuSkinner, ShapeParams, SurfaceGaussians, default_template, sample_surface, skin_mesh, skin_normal_f64,
    skin_point_f64,
};
use flyrig_gpu::{GpuContext, StorageBuffer, testing::on_both};
use flyrig_types::Pose;
use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};

/// Metres, at places some metres from the origin: f32 there resolves 2.4e-7.
const POSITION_TOLERANCE: f64 = 5e-6;
const NORMAL_TOLERANCE: f64 = 2e-5;

fn random_pose(rest: &Pose, seed: u64) -> Pose {
    let mut rng = rand::rngs::StdRng::seed_from_u64(seed);
    let mut pose = rest.clone();
    pose.root_translation = DVec3::new(1.5, -2.0, 0.9);
    for rotation in &mut pose.joint_rotations {
        let axis = DVec3::from_array(rng.random::<[f64; 3]>()) - 0.5;
        *rotation = DQuat::from_axis_angle(axis.normalize(), rng.random::<f64>() * 0.8) * *rotation;
    }
    pose
}

#[test]
fn the_reference_moves_a_point_as_by_hand() {
    let skeleton = default_template(&ShapeParams::default()).unwrap().skeleton;
    let knee = skeleton.joint("LeftLeg").unwrap();
    let at = skeleton.canonical_origins()[knee];
    let mut pose = skeleton.rest_pose();
    pose.joint_rotations[knee] = DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2);
    let matrices = skeleton.world_from_canonical(&pose);
    let skin = |joints, weights| flyrig_body::SkinWeights { joints, weights };
    let shin = skin([knee as u16, 0, 0, 0], [1.0, 0.0, 0.0, 0.0]);
    // A quarter turn about x takes "down" to "back".
    let moved = skin_point_f64(&matrices, &shin, at - DVec3::Y * 0.3);
    assert!((moved - (at - DVec3::Z * 0.3)).length() < 1e-9, "{moved}");
    let thigh = skeleton.joint("LeftUpLeg").unwrap() as u16;
    let half = skin([knee as u16, thigh, 0, 0], [0.5, 0.5, 0.0, 0.0]);
    let moved = skin_point_f64(&matrices, &half, at - DVec3::Y * 0.3);
    assert!((moved - (at - (DVec3::Y + DVec3::Z) * 0.15)).length() < 1e-9, "{moved}");
    // Weights that do not add up are scaled, no weight leaves the point alone, missing joints count nothing.
    let doubled = skin([knee as u16, thigh, 0, 0], [1.0, 1.0, 0.0, 0.0]);
    assert!((skin_point_f64(&matrices, &doubled, at - DVec3::Y * 0.3) - moved).length() < 1e-9);
    assert_eq!(skin_point_f64(&matrices, &skin([0; 4], [0.0; 4]), DVec3::ONE), DVec3::ONE);
    assert_eq!(skin_point_f64(&matrices, &skin([999; 4], [0.25; 4]), DVec3::ONE), DVec3::ONE);
    assert_eq!(skin_point_f64(&[], &shin, DVec3::ONE), DVec3::ONE);
}

#[test]
fn at_rest_nothing_moves() {
    let body = default_template(&ShapeParams::woman()).unwrap();
    let (positions, normals) = skin_mesh(&body, &body.skeleton.rest_pose());
    let moved = positions.iter().zip(&body.positions).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
    let turned = normals.iter().zip(&body.normals).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
    assert!(moved < 1e-5 && turned < 1e-5, "{moved} {turned}");
}

#[test]
fn mesh_skinning_agrees_with_the_reference() {
    let body = default_template(&ShapeParams::man()).unwrap();
    let pose = random_pose(&body.skeleton.rest_pose(), 1);
    let matrices = body.skeleton.world_from_canonical(&pose);
    let (positions, normals) = skin_mesh(&body, &pose);
    for i in 0..positions.len() {
        let expected = skin_point_f64(&matrices, &body.skin[i], body.positions[i].as_dvec3());
        assert!((positions[i].as_dvec3() - expected).length() < POSITION_TOLERANCE);
        let expected = skin_normal_f64(&matrices, &body.skin[i], body.normals[i].as_dvec3());
        assert!((normals[i].as_dvec3() - expected).length() < NORMAL_TOLERANCE);
    }
}

struct GpuRun {
    center_scale: Vec<[f32; 4]>,
    normal: Vec<[f32; 4]>,
}

fn run_gpu(
    gpu: &GpuContext,
    gaussians: &SurfaceGaussians,
    pose: &Pose,
    displacement: Option<&[[f32; 4]]>,
) -> Result<GpuRun, BodyError> {
    let skeleton = default_template(&ShapeParams::man()).unwrap().skeleton;
    let skinner = GpuSkinner::new(gpu, gaussians, &skeleton).unwrap();
    let center_scale = StorageBuffer::zeroed(gpu, "centres", gaussians.len()).unwrap();
    let normal = StorageBuffer::zeroed(gpu, "normals", gaussians.len()).unwrap();
    let displacement = displacement.map(|d| StorageBuffer::from_slice(gpu, "displacements", d).unwrap());
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    skinner.encode(gpu, &mut encoder, &skeleton, pose, displacement.as_ref(), &center_scale, &normal)?;
    gpu.queue.submit([encoder.finish()]);
    Ok(GpuRun { center_scale: center_scale.read(gpu).unwrap(), normal: normal.read(gpu).unwrap() })
}

#[test]
fn gpu_skinning_agrees_with_the_reference() {
    on_both(|gpu| {
        let body = default_template(&ShapeParams::man()).unwrap();
        let mut gaussians = sample_surface(&body, 3001, 2).unwrap();
        // One without weights, one on a joint that does not exist: both stay where they are.
        gaussians.skin[10].weights = [0.0; 4];
        gaussians.skin[11].joints = [500; 4];
        let pose = random_pose(&body.skeleton.rest_pose(), 9);
        let mut rng = rand::rngs::StdRng::seed_from_u64(3);
        let mut displacement: Vec<[f32; 4]> =
            (0..gaussians.len()).map(|_| rng.random::<[f32; 4]>().map(|x| (x - 0.5) * 0.1)).collect();
        displacement[20][1] = f32::NAN;
        displacement[21][2] = f32::NEG_INFINITY;
        displacement[22][3] = f32::NAN;
        let matrices = body.skeleton.world_from_canonical(&pose);
        for displacement in [None, Some(displacement.as_slice())] {
            let run = run_gpu(gpu, &gaussians, &pose, displacement).unwrap();
            for i in 0..gaussians.len() {
                let moved =
                    displacement.map_or(DVec3::ZERO, |d| DVec3::new(d[i][0].into(), d[i][1].into(), d[i][2].into()));
                let moved = if moved.is_finite() { moved } else { DVec3::ZERO };
                let expected = skin_point_f64(&matrices, &gaussians.skin[i], gaussians.positions[i].as_dvec3() + moved);
                let [x, y, z, scale] = run.center_scale[i];
                let error = (DVec3::new(x.into(), y.into(), z.into()) - expected).length();
                assert!(error < POSITION_TOLERANCE, "Gaussian {i}: {error} m");
                let by = displacement.map_or([0.0; 4], |d| d[i]);
                let grows = by.iter().all(|v| v.is_finite()) && by[3] > 0.0;
                let growth = if grows { 1.0 + by[3] } else { 1.0 };
                assert!((scale - growth * gaussians.scale_m[i]).abs() < 1e-8, "Gaussian {i}");
                let expected = skin_normal_f64(&matrices, &gaussians.skin[i], gaussians.normals[i].as_dvec3());
                let [x, y, z, depth] = run.normal[i];
                assert!((depth - growth * gaussians.depth_m[i]).abs() < 1e-9);
                assert!(
                    (DVec3::new(x.into(), y.into(), z.into()) - expected).length() < NORMAL_TOLERANCE,
                    "normal {i}"
                );
            }
        }
    });
}

#[test]
fn poses_that_do_not_fit_are_refused_before_the_gpu_sees_them() {
    on_both(|gpu| {
        let body = default_template(&ShapeParams::man()).unwrap();
        let gaussians = sample_surface(&body, 8, 2).unwrap();
        let rest = body.skeleton.rest_pose();
        let mut poisoned = rest.clone();
        poisoned.joint_rotations[4].x = f64::NAN;
        let mut far = rest.clone();
        far.root_translation.z = f64::INFINITY;
        let mut short = rest.clone();
        short.joint_rotations.pop();
        for pose in [poisoned, far, short] {
            assert!(matches!(run_gpu(gpu, &gaussians, &pose, None), Err(BodyError::Pose(_))));
        }
        assert!(matches!(
            run_gpu(gpu, &gaussians, &rest, Some(&[[0.0; 4]; 7])),
            Err(BodyError::Buffer { found: 7, needed: 8, .. })
        ));
        // Missing rotations keep their joints at rest on the CPU.
        let short = Pose { joint_rotations: Vec::new(), ..rest.clone() };
        assert_eq!(body.skeleton.world_from_joint(&short), body.skeleton.world_from_joint(&rest));
    });
}

use flyrig_avatar::KnownPoses;
use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
use flyrig_renderer::HarmonicOrder;
use glam::DQuat;

use super::*;
use crate::PhotoSettings;

/// Avatar of the built-in body as a rig makes it, with clothes that stand off by `clothes_m` to the front.
fn avatar(clothes_m: f64) -> Avatar {
    let template = default_template(&ShapeParams::default()).unwrap();
    let surface = sample_surface(&template, 40_000, 5).unwrap();
    let graph = build_graph(&template, &surface, 120, DEFAULT_SIGMA2_M2).unwrap();
    let mut avatar = Avatar::new(&template, &surface.inset(), Some(&graph), &[], HarmonicOrder::Zero).unwrap();
    avatar.hanging.as_mut().unwrap().mean.fill(DVec3::Z * clothes_m);
    avatar
}

/// Returns the distance from a point to the nearest of others, metres.
fn nearest(point: Vec3, others: &[Vec3]) -> f32 {
    others.iter().map(|other| other.distance(point)).fold(f32::INFINITY, f32::min)
}

#[test]
fn the_mesh_is_closed_and_lies_on_the_surface_that_the_gaussians_draw() {
    let avatar = avatar(0.02);
    let (person, report) = MeshedPerson::of_avatar(
        &avatar,
        &PersonOptions { triangles: 30_000, texture_side: 256, ..PersonOptions::default() },
    )
    .unwrap();
    let mesh = &person.template;
    mesh.check().unwrap();
    let topology = report.topology;
    assert!(topology.is_closed_manifold() && topology.components == 1 && topology.volume_m3 > 0.04, "{topology:?}");
    assert!(topology.triangles <= 30_000 && report.simplified_by_m < 1e-3, "{report:?}");
    assert!(person.texture.covered > 256 * 256 / 4);
    let body = avatar.surface();
    let truth = sample_surface(&body, 40_000, 9).unwrap();
    let off: Vec<f32> = mesh.positions.iter().step_by(37).map(|p| nearest(*p, &truth.positions)).collect();
    let mean = off.iter().sum::<f32>() / off.len() as f32;
    // The points of the truth are 7 mm apart: half of that is their own share.
    assert!(mean < 5e-3, "{mean}");
    assert!(report.skin.inpainted + report.skin.isolated < report.skin.taken / 10, "{:?}", report.skin);
}

#[test]
fn poses_and_nodes_move_the_mesh_as_they_move_the_body() {
    let avatar = avatar(0.0);
    let (person, _) = MeshedPerson::of_avatar(
        &avatar,
        &PersonOptions { triangles: 30_000, texture_side: 256, ..PersonOptions::default() },
    )
    .unwrap();
    let skeleton = &person.template.skeleton;
    let mut pose = skeleton.rest_pose();
    pose.root_translation = DVec3::new(0.4, 0.1, -0.2);
    pose.joint_rotations[0] *= DQuat::from_rotation_y(0.5);
    let arm = skeleton.joint("LeftForeArm").unwrap();
    pose.joint_rotations[arm] *= DQuat::from_rotation_z(0.7);
    let nodes = avatar.hanging.as_ref().unwrap().nodes.len();
    let translations = vec![DVec3::new(0.0, 0.0, 0.03); nodes];
    let (moved, normals) = person.posed(&pose, Some(&translations));
    let mut posed = PosedAvatar::default();
    avatar.pose(&Bones::new(skeleton, &pose), Some(&translations), &mut posed);
    let drawn: Vec<Vec3> = posed.surface_points().map(|point| point.drawn(DRAWN_BEYOND)).collect();
    let off: Vec<f32> = moved.iter().step_by(37).map(|p| nearest(*p, &drawn)).collect();
    assert!(off.iter().sum::<f32>() / (off.len() as f32) < 6e-3);
    assert!(normals.iter().all(|normal| (normal.length() - 1.0).abs() < 1e-3));
    // Without nodes it keeps its mean shape; lists of another graph are ignored.
    assert_eq!(person.posed(&pose, None).0, person.posed(&pose, Some(&translations[..3])).0);
}

#[test]
fn poisoned_gaussians_are_left_out() {
    let mut avatar = avatar(0.0);
    for i in 0..3 {
        avatar.parameters.offset[1000 * i] = [f32::NAN, f32::INFINITY, 0.0, 0.0];
    }
    let (_, report) = MeshedPerson::of_avatar(
        &avatar,
        &PersonOptions { triangles: 30_000, texture_side: 256, ..PersonOptions::default() },
    )
    .unwrap();
    assert_eq!(report.mesh.dropped.not_finite, 3);

    let template = default_template(&ShapeParams::default()).unwrap();
    let few = sample_surface(&template, 10, 5).unwrap();
    let few = Avatar::new(&template, &few, None, &[], HarmonicOrder::Zero).unwrap();
    let error = MeshedPerson::of_avatar(
        &few,
        &PersonOptions { triangles: 30_000, texture_side: 256, ..PersonOptions::default() },
    )
    .unwrap_err()
    .to_string();
    assert!(error.contains("10") && error.contains("1000"), "{error}");
}

#[test]
fn the_texture_takes_the_mean_light_of_known_poses() {
    let mut avatar = avatar(0.0);
    avatar.light.terms[2] = [0.5, 0.4, 0.3];
    let options = PersonOptions { triangles: 30_000, texture_side: 256, ..PersonOptions::default() };
    let (person, _) = MeshedPerson::of_avatar(&avatar, &options).unwrap();
    assert!(person.mean_shades(&avatar).iter().all(|shade| shade.distance(Vec3::ONE) < 1e-6), "no known pose");
    let mut lying = avatar.template.skeleton.rest_pose();
    lying.joint_rotations[0] = DQuat::from_rotation_x(1.5) * lying.joint_rotations[0];
    let poses = [avatar.template.skeleton.rest_pose(), lying];
    avatar.known_poses = KnownPoses::new(&poses);
    let shades = person.mean_shades(&avatar);
    let normals = poses.each_ref().map(|pose| person.posed(pose, None).1);
    for (i, shade) in shades.iter().enumerate().step_by(97) {
        let of = |k: usize| normals.iter().map(|n| f64::from(avatar.light.shade(n[i])[k])).sum::<f64>() / 2.0;
        let off = (0..3).map(|k| (f64::from(shade[k]) - of(k)).abs()).fold(0.0, f64::max);
        assert!(off < 2e-3, "{i}: {shade}");
    }
    let lit = person.lit_texture(&shades).unwrap();
    assert!(lit.rgb != person.texture.rgb && lit.covered == person.texture.covered);
    assert!(person.lit_texture(&shades[1..]).is_err());
    // Without photographs the texture stays as it is.
    let kept = person.photographed(&avatar.light, (&[], &[]), None, &PhotoSettings::default()).unwrap();
    assert!(kept.seen <= 0.0 && kept.atlas == person.texture);
}

//! Degenerate geometry through the whole deformation.

use flyrig_body::{DEFAULT_SIGMA2_M2, build_graph};
use flyrig_types::Isometry;
use glam::{DVec2, DVec3, Vec3};

use super::small_scene::{SceneShot, SmallScene, TestedDeformation};
use super::{gpu, options};

struct Hard {
    name: &'static str,
    scene: fn(&mut SmallScene),
    shot: fn(&mut SceneShot),
    /// Whether there is anything to follow.
    moves: Option<bool>,
}

fn nodes(scene: &mut SmallScene, count: usize) {
    scene.graph = build_graph(&scene.template, &scene.surface, count, DEFAULT_SIGMA2_M2).unwrap();
}

fn pictures(scene: &mut SmallScene, side: u32) {
    for camera in &mut scene.cameras {
        let i = &mut camera.intrinsics;
        (i.width, i.height) = (side, side);
        i.focal_px = DVec2::splat(1.2 * f64::from(side));
        i.center_px = DVec2::splat(0.5 * f64::from(side) - 0.5);
    }
}

fn look(scene: &mut SmallScene, eye: DVec3, target: DVec3) {
    for camera in &mut scene.cameras {
        camera.camera_from_world = Isometry::look_at(eye, target, DVec3::Y);
    }
}

/// Scene in which no Gaussian hangs on node 0, which has no neighbours.
fn isolate(scene: &mut SmallScene) {
    let graph = &mut scene.graph;
    graph.neighbors[0] = [0; 4];
    graph.neighbors.iter_mut().skip(1).flatten().for_each(|n| *n = (*n).max(1));
    for (nodes, weights) in graph.gaussian_nodes.iter_mut().zip(&mut graph.gaussian_weights) {
        for (node, weight) in nodes.iter().zip(weights) {
            if *node == 0 {
                *weight = 0.0;
            }
        }
    }
}

/// Scene in which all Gaussians on node 2 are transparent.
fn hide(scene: &mut SmallScene) {
    for ((nodes, weights), color) in
        scene.graph.gaussian_nodes.iter().zip(&scene.graph.gaussian_weights).zip(&mut scene.colors)
    {
        if nodes.iter().zip(weights).any(|(node, weight)| *node == 2 && *weight > 0.0) {
            color[3] = 0.0;
        }
    }
}

fn masks(shot: &mut SceneShot, value: u8) {
    shot.rgba.iter_mut().for_each(|rgba| rgba.iter_mut().skip(3).step_by(4).for_each(|a| *a = value));
}

const MIDDLE: DVec3 = DVec3::new(0.0, 0.9, 0.0);
const AS_SEEN: fn(&mut SceneShot) = |_| ();

const CASES: [Hard; 22] = [
    Hard { name: "nothing", scene: |_| (), shot: AS_SEEN, moves: Some(true) },
    Hard {
        name: "coincident",
        scene: |s| s.surface.positions.fill(Vec3::new(0.0, 1.0, 0.1)),
        shot: AS_SEEN,
        moves: None,
    },
    Hard { name: "zero scale", scene: |s| s.surface.scale_m.fill(0.0), shot: AS_SEEN, moves: Some(false) },
    Hard { name: "1e4 px wide", scene: |s| s.surface.scale_m.fill(600.0), shot: AS_SEEN, moves: None },
    Hard { name: "one is 1e4 px wide", scene: |s| s.surface.scale_m[7] = 600.0, shot: AS_SEEN, moves: None },
    Hard {
        name: "transparent",
        scene: |s| s.colors.iter_mut().for_each(|c| c[3] = 0.0),
        shot: AS_SEEN,
        moves: Some(false),
    },
    Hard {
        name: "opacities about the clamp",
        scene: |s| s.colors.iter_mut().zip(0..).for_each(|(c, i)| c[3] = [0.985, 0.99, 0.995, 1.0][i % 4]),
        shot: AS_SEEN,
        moves: Some(true),
    },
    Hard {
        name: "every third colour NaN",
        scene: |s| s.colors.iter_mut().step_by(3).for_each(|c| c[1] = f32::NAN),
        shot: AS_SEEN,
        moves: Some(true),
    },
    Hard { name: "1 pixel", scene: |s| pictures(s, 1), shot: AS_SEEN, moves: None },
    Hard { name: "3 pixels", scene: |s| pictures(s, 3), shot: AS_SEEN, moves: None },
    Hard { name: "cameras inside of the body", scene: |s| look(s, MIDDLE, DVec3::Z), shot: AS_SEEN, moves: None },
    Hard {
        name: "body on the image plane",
        scene: |s| look(s, MIDDLE + DVec3::X, MIDDLE + DVec3::X + DVec3::Z),
        shot: AS_SEEN,
        moves: None,
    },
    Hard {
        name: "body behind the cameras",
        scene: |s| look(s, MIDDLE + 3.0 * DVec3::Z, MIDDLE + 9.0 * DVec3::Z),
        shot: AS_SEEN,
        moves: Some(false),
    },
    Hard { name: "1 km away", scene: |s| look(s, MIDDLE + 1e3 * DVec3::Z, MIDDLE), shot: AS_SEEN, moves: None },
    Hard { name: "four nodes", scene: |s| nodes(s, 4), shot: AS_SEEN, moves: Some(true) },
    Hard { name: "one node", scene: |s| nodes(s, 1), shot: AS_SEEN, moves: Some(true) },
    Hard { name: "an isolated node", scene: isolate, shot: AS_SEEN, moves: Some(true) },
    Hard { name: "a node that nobody sees", scene: hide, shot: AS_SEEN, moves: Some(true) },
    Hard { name: "one camera", scene: |s| s.cameras.truncate(1), shot: AS_SEEN, moves: Some(true) },
    Hard { name: "no camera", scene: |s| s.cameras.clear(), shot: AS_SEEN, moves: Some(false) },
    Hard { name: "empty masks", scene: |_| (), shot: |shot| masks(shot, 0), moves: None },
    Hard { name: "full masks", scene: |_| (), shot: |shot| masks(shot, 255), moves: None },
];

#[test]
fn hard_scenes_give_finite_steps_that_never_raise_the_loss() {
    for Hard { name, scene: spoil, shot: spoil_shot, moves } in CASES {
        // What the cameras see is a sound person.
        let mut seen = SmallScene::new(80, 10, 48);
        let mut scene = SmallScene::new(80, 10, 48);
        spoil(&mut scene);
        seen.cameras.clone_from(&scene.cameras);
        let mut device = TestedDeformation::new(gpu(), &scene, options());
        let (mut steps, mut losses) = (0, Vec::new());
        for frame in 0..3 {
            let mut shot = seen.shot(f64::from(frame));
            spoil_shot(&mut shot);
            if let Some(report) = device.track(&scene, &shot) {
                assert!(!report.poisoned && report.dropped == 0, "{name}: {report:?}");
                assert!(report.losses.is_sorted_by(|a, b| a >= b), "{name}: {report:?}");
                assert!(report.losses.iter().all(|loss| loss.is_finite()), "{name}: {report:?}");
                steps += report.accepted;
                losses = report.losses;
            }
            let t = device.deformation.tracker.translations();
            assert!(t.iter().all(|t| t.is_finite() && t.length() <= 0.25), "{name}: {t:?}");
            let pose = scene.pose(f64::from(frame));
            assert!(device.centers(&scene, &pose).iter().flatten().all(|v| v.is_finite()), "{name}");
        }
        let t = device.deformation.tracker.translations();
        let longest = t.iter().map(|t| t.length()).fold(0.0, f64::max);
        println!("{name:28} {steps} steps, longest translation {:.1} mm, last losses {losses:.3?}", longest * 1e3);
        assert!(moves.is_none_or(|moves| moves == (longest > 0.0)), "{name}: {longest}");
        match name {
            "an isolated node" => assert!(t[0] == DVec3::ZERO, "{name}: {t:?}"),
            "a node that nobody sees" => assert!(t[2] != DVec3::ZERO, "{name}: it goes along"),
            _ => {}
        }
    }
}

//! The pose's own error is found, and not taken for cloth.

use std::convert::Infallible;

use flyrig_body::{
    DEFAULT_SIGMA2_M2, DeformationGraph, ShapeParams, SkinWeights, SurfaceGaussians, Template, build_graph,
    default_template, sample_surface, skin_point_f64,
};
use flyrig_types::Pose;
use glam::{DQuat, DVec3};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use super::super::{DataTerm, DeformSettings, DeformTracker, PointDerivatives, PoseCorrection, PoseFreedom};
use super::*;

/// Squared distance of every Gaussian to its goal, times a weight, in a pose that errs.
struct PosedGoals<'a> {
    template: &'a Template,
    surface: &'a SurfaceGaussians,
    pose: Pose,
    goals: Vec<DVec3>,
}

/// Of the order of what three silhouettes say.
const WEIGHT: f64 = 5e3;

impl PosedGoals<'_> {
    fn offs(&self, displacement: &[[f32; 4]], correction: &PoseCorrection) -> Vec<DVec3> {
        let bones = self.template.skeleton.world_from_canonical(&correction.apply(&self.pose));
        let off = |g: usize| {
            let moved = DVec3::new(displacement[g][0].into(), displacement[g][1].into(), displacement[g][2].into());
            let x = self.surface.positions[g].as_dvec3() + moved;
            skin_point_f64(&bones, &self.surface.skin[g], x) - self.goals[g]
        };
        (0..self.surface.len()).map(off).collect()
    }
}

impl DataTerm for PosedGoals<'_> {
    type Error = Infallible;

    fn loss(&mut self, displacement: &[[f32; 4]], correction: &PoseCorrection) -> Result<f64, Infallible> {
        Ok(WEIGHT * self.offs(displacement, correction).iter().map(|off| off.length_squared()).sum::<f64>())
    }

    fn derivatives(
        &mut self,
        displacement: &[[f32; 4]],
        correction: &PoseCorrection,
        out: &mut Vec<PointDerivatives>,
    ) -> Result<f64, Infallible> {
        let pose = correction.apply(&self.pose);
        let weight = WEIGHT as f32;
        let slope = |off: DVec3| (2.0 * weight * off.as_vec3()).extend(1.0).to_array();
        *out = vec![PointDerivatives {
            world_from_canonical: self.template.skeleton.world_from_canonical(&pose),
            world_from_joint: self.template.skeleton.world_from_joint(&pose),
            gradient: self.offs(displacement, correction).into_iter().map(slope).collect(),
            curvature: (0..2 * self.surface.len())
                .map(
                    |i| if i % 2 == 0 { [2.0 * weight, 0.0, 0.0, 2.0 * weight] } else { [0.0, 2.0 * weight, 0.0, 0.0] },
                )
                .collect(),
        }];
        self.loss(displacement, correction)
    }
}

struct Body {
    template: Template,
    surface: SurfaceGaussians,
    graph: DeformationGraph,
    pose: Pose,
}

fn body() -> Body {
    let template = default_template(&ShapeParams::default()).unwrap();
    let surface = sample_surface(&template, 4000, 1).unwrap();
    let graph = build_graph(&template, &surface, 150, DEFAULT_SIGMA2_M2).unwrap();
    let mut rng = StdRng::seed_from_u64(3);
    let mut turn = || DQuat::from_scaled_axis(DVec3::from([(); 3].map(|()| rng.random_range(-0.3..0.3))));
    let joints = template.skeleton.joints().len();
    let pose =
        Pose { root_translation: DVec3::new(0.1, 0.2, 1.0), joint_rotations: (0..joints).map(|_| turn()).collect() };
    Body { template, surface, graph, pose }
}

fn nodes(body: &Body) -> Vec<(DVec3, SkinWeights)> {
    let node = |&g: &u32| (body.surface.positions[g as usize].as_dvec3(), body.surface.skin[g as usize]);
    body.graph.node_gaussian.iter().map(node).collect()
}

#[test]
fn the_basis_matches_differences() {
    let body = body();
    let mut fix = PoseFix::new(&body.template.skeleton, nodes(&body), PoseFreedom::default());
    let skeleton = &body.template.skeleton;
    let still = vec![DVec3::ZERO; body.graph.nodes.len()];
    let bones = skeleton.world_from_canonical(&body.pose);
    let basis = fix.basis(&bones, &skeleton.world_from_joint(&body.pose), &still);
    let at = |correction: &PoseCorrection| -> Vec<DVec3> {
        let bones = skeleton.world_from_canonical(&correction.apply(&body.pose));
        fix.nodes.iter().map(|(x, skin)| skin_point_f64(&bones, skin, *x)).collect()
    };
    let (mut worst, mut largest) = (0.0f64, 0.0f64);
    for unknown in 0..basis.unknowns {
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let h = 1e-5;
            let moved = |sign: f64| {
                let mut correction = fix.now.clone();
                match unknown.checked_sub(1) {
                    None => correction.shift += axis * (sign * h),
                    Some(k) => correction.turns[fix.joints[k]] += axis * (sign * h),
                }
                at(&correction)
            };
            let (up, down) = (moved(1.0), moved(-1.0));
            for (n, (up, down)) in up.iter().zip(down).enumerate() {
                let world = (*up - down) / (2.0 * h);
                let entry =
                    basis.of_node[n].iter().find(|(k, _)| *k == unknown).map_or(DVec3::ZERO, |(_, m)| *m * axis);
                let ours = skin_jacobian_f64(&bones, &fix.nodes[n].1) * entry;
                worst = worst.max((ours - world).length());
                largest = largest.max(world.length());
            }
        }
    }
    println!("basis against differences: {worst:.1e} of {largest:.2}");
    assert!(worst < 1e-7 * largest.max(1.0), "{worst}");
    // The price's gradient and its bend.
    fix.now.shift = DVec3::new(0.01, -0.02, 0.03);
    let joint = fix.joints[3];
    fix.now.turns[joint] = DVec3::new(0.1, 0.0, -0.05);
    let (slope, bend, h) = (fix.gradient(), fix.stiffness(), 1e-4);
    let price = |fix: &PoseFix| fix.loss();
    let base = price(&fix);
    let shifted = |by: f64| {
        let mut step = vec![DVec3::ZERO; slope.len()];
        step[4] = DVec3::X * by;
        step
    };
    fix.step(&shifted(h), 1.0);
    let up = price(&fix);
    fix.step(&shifted(-2.0 * h), 1.0);
    let down = price(&fix);
    assert!(((up - down) / (2.0 * h) - slope[4].x).abs() < 1e-4 * slope[4].x.abs());
    assert!(((up + down - 2.0 * base) / (h * h) - bend[4]).abs() < 1e-3 * bend[4]);
}

#[test]
fn an_error_of_the_pose_goes_into_the_pose_and_cloth_into_the_nodes() {
    let body = body();
    let skeleton = &body.template.skeleton;
    let bones = skeleton.world_from_canonical(&body.pose);
    // The truth: smooth cloth of 1 cm on the right pose.
    let goal = |g: usize| {
        let x = body.surface.positions[g].as_dvec3();
        let cloth = body.surface.normals[g].as_dvec3() * 0.01;
        skin_point_f64(&bones, &body.surface.skin[g], x + cloth)
    };
    let mut wrong = body.pose.clone();
    wrong.root_translation += DVec3::new(0.02, -0.015, 0.01);
    let joint = PoseFix::new(skeleton, nodes(&body), PoseFreedom::default()).joints[4];
    wrong.joint_rotations[joint] *= DQuat::from_rotation_x(0.12);
    let run = |free: bool| {
        let mut data = PosedGoals {
            template: &body.template,
            surface: &body.surface,
            pose: wrong.clone(),
            goals: (0..body.surface.len()).map(goal).collect(),
        };
        let settings = DeformSettings { anchor: if free { 1000.0 } else { 0.0 }, ..DeformSettings::default() };
        let mut tracker = DeformTracker::new(&body.graph, &body.surface.skin, settings).unwrap();
        if free {
            tracker = tracker.with_pose(skeleton, nodes(&body), PoseFreedom::default()).unwrap();
        }
        let mut last = 0.0;
        for _ in 0..12 {
            let report = tracker.track(&mut data).unwrap();
            assert!(report.losses.is_sorted_by(|a, b| a >= b), "{report:?}");
            last = *report.losses.last().unwrap();
        }
        let t = tracker.translations().iter().map(|t| t.length()).fold(0.0, f64::max);
        (last, t, tracker.correction().clone())
    };
    let (stiff, stiff_cloth, none) = run(false);
    let (free, free_cloth, found) = run(true);
    let found_turn = found.turns[joint].x;
    println!("loss {stiff:.3} without, {free:.3} with a free pose; farthest node {stiff_cloth:.3}, {free_cloth:.3} m");
    println!("shift {:?}, turn {found_turn:.3} of -0.120", found.shift);
    assert!(none == PoseCorrection::default());
    assert!(free < 1.05 * stiff && free_cloth < 0.5 * stiff_cloth);
    assert!((-0.13..-0.04).contains(&found_turn) && found.shift.length() > 0.015);
    assert!(found.apply(&wrong).is_valid());
}

#[test]
fn poses_that_do_not_fit_are_harmless() {
    let body = body();
    let make = || DeformTracker::new(&body.graph, &body.surface.skin, DeformSettings::default()).unwrap();
    assert!(make().with_pose(&body.template.skeleton, Vec::new(), PoseFreedom::default()).is_err());
    let free = PoseFreedom { turn: f64::NAN, ..PoseFreedom::default() };
    assert!(make().with_pose(&body.template.skeleton, nodes(&body), free).is_err());
    let fix = PoseFix::new(&body.template.skeleton, nodes(&body), PoseFreedom::default());
    let still = vec![DVec3::ZERO; body.graph.nodes.len()];
    for bones in [Vec::new(), vec![DMat4::NAN; body.pose.joint_rotations.len()]] {
        let basis = fix.basis(&bones, &bones, &still);
        assert!(basis.of_node.iter().all(Vec::is_empty));
    }
}

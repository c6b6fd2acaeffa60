//! Tests of long runs and hard matrices. Those that take minutes are ignored by default: `make test-long`.

use super::tests::{Goals, body, goals, tracker, true_displacement, wide};
use super::*;
use glam::{DMat3, DQuat};
use std::convert::Infallible;

/// Returns the mean distance of the seen Gaussians from the true clothes, early and late in a run.
fn drift(frames: usize) -> (f64, f64) {
    let body = body(500, 30);
    let mut data = goals(&body);
    let mut tracker = tracker(&body, DeformSettings { regularization: 20.0, ..DeformSettings::default() });
    let still = data.goals.clone();
    let (mut early, mut late) = (0.0, 0.0);
    for frame in 0..frames {
        // Cloth that swings once in 97 frames.
        let swing = (frame as f64 * std::f64::consts::TAU / 97.0).sin();
        for (g, goal) in data.goals.iter_mut().enumerate() {
            *goal = still[g] + true_displacement(body.surface.positions[g]) * (0.5 * swing);
        }
        tracker.track(&mut data).unwrap();
        let seen = (0..body.surface.len()).filter(|&g| data.weights[g] > 0.0);
        let off = |g: usize| data.off(g, wide(tracker.displacement()[g])).length();
        let error = seen.clone().map(off).sum::<f64>() / seen.count() as f64;
        assert!(error.is_finite());
        if (100..200).contains(&frame) {
            early += error / 100.0;
        }
        if frame + 100 >= frames {
            late += error / 100.0;
        }
    }
    (early, late)
}

#[test]
fn a_thousand_frames_do_not_drift() {
    let (early, late) = drift(1000);
    println!("mean error of frames 100 to 200: {:.3} mm, of the last 100 of 1,000: {:.3} mm", early * 1e3, late * 1e3);
    assert!(late <= 1.1 * early);
}

#[test]
#[ignore = "takes a minute: make test-long"]
fn ten_thousand_frames_do_not_drift() {
    let (early, late) = drift(10_000);
    println!("mean error of frames 100 to 200: {:.3} mm, of the last 100 of 10,000: {:.3} mm", early * 1e3, late * 1e3);
    assert!(late <= 1.1 * early);
}

/// Matrices that constrain one direction only, or hardly any, or far too strongly.
struct Flat<'a> {
    inner: Goals<'a>,
    keep: [f64; 3],
    /// Rotation of the constrained directions from Gaussian to Gaussian, radians.
    turn: f64,
}

impl DataTerm for Flat<'_> {
    type Error = Infallible;

    fn loss(&mut self, displacement: &[[f32; 4]]) -> Result<f64, Infallible> {
        self.inner.loss(displacement)
    }

    fn derivatives(&mut self, displacement: &[[f32; 4]], out: &mut Vec<PointDerivatives>) -> Result<f64, Infallible> {
        let loss = self.inner.derivatives(displacement, out)?;
        for (g, h) in out[0].curvature.chunks_exact_mut(2).enumerate() {
            let turn = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(0.3, 1.0, -0.7) * self.turn * g as f64));
            let m = turn * DMat3::from_diagonal(DVec3::from(self.keep) * f64::from(h[0][0])) * turn.transpose();
            let entry = |r: usize, c: usize| m.col(c)[r] as f32;
            h[0] = [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1)];
            h[1] = [entry(1, 2), entry(2, 2), 0.0, 0.0];
        }
        Ok(loss)
    }
}

#[test]
fn nearly_singular_matrices_give_finite_steps_that_lower_the_loss() {
    let body = body(2_000, 60);
    let mut moved = 0;
    for regularization in [0.0, 1e-9, 200.0, 1e9] {
        for keep in [[1.0, 0.0, 0.0], [1.0, 1e-6, 1e-12], [0.0; 3], [1e-30; 3], [1e20; 3], [1e-20, 1.0, 1e15]] {
            for turn in [0.0, 0.1] {
                let settings = DeformSettings { regularization, ..DeformSettings::default() };
                let mut tracker = tracker(&body, settings);
                let mut data = Flat { inner: goals(&body), keep, turn };
                let told = format!("{regularization} {keep:?} {turn}");
                let mut before = f64::INFINITY;
                for _ in 0..4 {
                    let report = tracker.track(&mut data).unwrap();
                    assert!(report.losses.is_sorted_by(|a, b| a >= b), "{told}: {report:?}");
                    assert!(tracker.translations().iter().all(|t| t.is_finite()), "{told}");
                    moved += report.accepted;
                    // The first frame has no history yet, which the second one adds to the loss.
                    let after = data.loss(tracker.displacement()).unwrap();
                    assert!(after <= before || regularization > 0.0, "{told}: {before} {after}");
                    before = after;
                }
            }
        }
    }
    println!("{moved} steps taken");
    assert!(moved > 100, "{moved}");
}

#[test]
fn a_frame_without_anything_to_gain_gets_no_iteration_until_something_moves() {
    let body = body(2_000, 60);
    let mut data = goals(&body);
    let mut resting = tracker(&body, DeformSettings::default());
    let mut rested = 0;
    for _ in 0..40 {
        rested += usize::from(resting.track(&mut data).unwrap().at_rest);
    }
    assert!(rested > 15, "{rested} of 40 frames of a person who stands still");
    data.goals.iter_mut().for_each(|goal| goal.x += 0.03);
    let report = resting.track(&mut data).unwrap();
    assert!(!report.at_rest && report.accepted > 0, "{report:?}");
    let mut never = tracker(&body, DeformSettings { rest: 0.0, ..DeformSettings::default() });
    assert!((0..40).all(|_| !never.track(&mut goals(&body)).unwrap().at_rest), "the switch");
}

/// Scales the person, the cameras and everything with a unit of length by `unit`; weights are units of loss per square
/// metre.
fn solved_in(unit: f64) -> (Vec<DVec3>, Vec<f64>) {
    let mut body = body(2_000, 60);
    body.surface.positions.iter_mut().for_each(|x| *x *= unit as f32);
    body.graph.nodes.iter_mut().for_each(|x| *x *= unit as f32);
    body.bones.iter_mut().for_each(|bone| bone.w_axis = (bone.w_axis.truncate() * unit).extend(1.0));
    let surface = &body.surface;
    let goal = |g: usize| {
        let x = (surface.positions[g].as_dvec3() / unit).as_vec3();
        let moved = surface.positions[g].as_dvec3() + true_displacement(x) * unit;
        flyrig_body::skin_point_f64(&body.bones, &surface.skin[g], moved)
    };
    let mut data = goals(&body);
    data.goals = (0..surface.len()).map(goal).collect();
    data.weights.iter_mut().for_each(|w| *w /= unit * unit);
    let plain = DeformSettings::default();
    let settings = DeformSettings {
        regularization: plain.regularization / (unit * unit),
        max_step_m: plain.max_step_m * unit,
        max_translation_m: plain.max_translation_m * unit,
        thickness_m: plain.thickness_m.map(|v| v * unit),
        rest: 0.0,
        ..plain
    };
    let mut tracker = tracker(&body, settings);
    let mut losses = Vec::new();
    for _ in 0..15 {
        let report = tracker.track(&mut data).unwrap();
        assert!(report.losses.is_sorted_by(|a, b| a >= b), "{unit}: {report:?}");
        losses.extend(report.losses.last().copied());
    }
    (tracker.translations().iter().map(|t| *t / unit).collect(), losses)
}

#[test]
fn from_millimetres_to_kilometres_the_solution_is_the_same() {
    let (metres, losses) = solved_in(1.0);
    let longest = metres.iter().map(|t| t.length()).fold(0.0, f64::max);
    // Powers of two round nothing: what were left would know of metres.
    for (unit, most) in
        [(0.5f64.powi(10), 0.0), (2f64.powi(10), 0.0), (1e-6, 1e-5), (1e-3, 1e-5), (1e3, 1e-5), (1e6, 1e-5)]
    {
        let (moved, its_losses) = solved_in(unit);
        let off = metres.iter().zip(&moved).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max) / longest;
        let by_loss = losses.iter().zip(&its_losses).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max);
        println!("unit {unit:.0e} m: nodes within {off:.1e} of the longest translation, losses within {by_loss:.1e}");
        assert!(off <= most && by_loss <= most, "{unit}: {off} {by_loss}");
    }
}

#[test]
fn far_from_the_origin_the_solution_is_the_same() {
    let near = body(2_000, 60);
    let solve = |far: f64| {
        let mut body = body(2_000, 60);
        body.bones.iter_mut().for_each(|bone| bone.w_axis.x += far);
        let mut data = goals(&body);
        let mut tracker = tracker(&body, DeformSettings::default());
        for _ in 0..4 {
            tracker.track(&mut data).unwrap();
        }
        tracker.translations().to_vec()
    };
    let (here, there) = (solve(0.0), solve(5e3));
    let worst = here.iter().zip(&there).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
    assert_eq!(near.graph.nodes.len(), here.len());
    println!("5 km away: nodes within {worst:.1e} m");
    assert!(worst < 1e-6, "{worst}");
}

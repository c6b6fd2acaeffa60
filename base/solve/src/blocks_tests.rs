//! Small bundle adjustment of cameras and points, against the dense solution and the truth.

use glam::DVec3;
use nalgebra::{DMatrix, DVector};

use super::*;
use crate::minimize::Stop;
use crate::motion::RigidMotion;
use crate::normal::NormalEquations;
use crate::rotation::{exp_rotation, left_jacobian_inverse, log_rotation};
use crate::testing::RandomGeometry as _;
use flyrig_model::SplitMix64;

const FOCAL: f64 = 500.0;

/// Unknowns: cameras (6 each: turn, shift), one common focal length (1), points (3 each).
#[derive(Debug, Clone, PartialEq)]
struct Scene {
    cameras: Vec<RigidMotion>,
    focal: f64,
    points: Vec<DVec3>,
}

#[derive(Debug, Clone)]
struct Bundle {
    sizes: Vec<usize>,
    cameras: usize,
    is_schur: bool,
    kernel: Kernel,
    /// Observations: camera, point, pixel, weight.
    seen: Vec<(usize, usize, [f64; 2], f64)>,
    /// Prior poses of the first two cameras, which fix the gauge.
    anchors: Vec<RigidMotion>,
    /// Residuals with a wrong shape.
    lie: Option<(usize, usize)>,
}

impl BlockProblem for Bundle {
    type Unknowns = Scene;

    fn block_sizes(&self) -> &[usize] {
        &self.sizes
    }

    fn first_eliminated(&self) -> usize {
        if self.is_schur { self.cameras + 1 } else { self.sizes.len() }
    }

    fn residual_count(&self) -> usize {
        self.seen.len() + self.anchors.len()
    }

    fn residual(&self, at: &Scene, index: usize, with_jacobians: bool) -> Option<Residual> {
        let Some(&(camera, point, pixel, weight)) = self.seen.get(index) else {
            return Some(self.anchor(at, index - self.seen.len()));
        };
        let local = at.cameras[camera].apply(at.points[point]);
        if local.z < 0.1 {
            return None;
        }
        let (x, y) = (local.x / local.z, local.y / local.z);
        let mut jacobians = Vec::new();
        if with_jacobians {
            let scale = at.focal / local.z;
            let by_local = DMatrix::from_row_slice(2, 3, &[scale, 0.0, -scale * x, 0.0, scale, -scale * y]);
            let [by_turn, by_shift, by_point] = at.cameras[camera].apply_jacobian(at.points[point]);
            let matrix = |m: glam::DMat3| DMatrix::from_column_slice(3, 3, &m.to_cols_array());
            let mut by_camera = DMatrix::zeros(2, 6);
            by_camera.columns_mut(0, 3).copy_from(&(&by_local * matrix(by_turn)));
            by_camera.columns_mut(3, 3).copy_from(&(&by_local * matrix(by_shift)));
            jacobians.push((camera, by_camera));
            jacobians.push((self.cameras, DMatrix::from_column_slice(2, 1, &[x, y])));
            jacobians.push((self.cameras + 1 + point, by_local * matrix(by_point)));
            if let Some((liar, block)) = self.lie
                && liar == index
            {
                jacobians.push((block, DMatrix::zeros(2, 3)));
            }
        }
        let error = DVector::from_column_slice(&[at.focal * x - pixel[0], at.focal * y - pixel[1]]);
        Some(Residual { error, jacobians, kernel: self.kernel, weight })
    }

    fn moved(&self, at: &Scene, step: &[f64]) -> Scene {
        let v = |k: usize| DVec3::new(step[k], step[k + 1], step[k + 2]);
        let start = 6 * self.cameras;
        Scene {
            cameras: at.cameras.iter().enumerate().map(|(i, c)| c.moved(v(6 * i), v(6 * i + 3))).collect(),
            focal: at.focal + step[start],
            points: at.points.iter().enumerate().map(|(i, p)| *p + v(start + 1 + 3 * i)).collect(),
        }
    }
}

impl Bundle {
    fn anchor(&self, at: &Scene, camera: usize) -> Residual {
        let (now, anchor) = (at.cameras[camera], self.anchors[camera]);
        let turn = log_rotation(now.rotation * anchor.rotation.inverse());
        let shift = now.translation - anchor.translation;
        let mut jacobian = DMatrix::identity(6, 6) * 1000.0;
        let turned = left_jacobian_inverse(turn) * 1000.0;
        jacobian.view_mut((0, 0), (3, 3)).copy_from_slice(&turned.to_cols_array());
        Residual {
            error: DVector::from_iterator(6, turn.to_array().into_iter().chain(shift.to_array())) * 1000.0,
            jacobians: vec![(camera, jacobian)],
            kernel: Kernel::Squares,
            weight: 1.0,
        }
    }
}

/// Returns cameras on a ring around a cloud of points, with pixel noise; the truth and a perturbed start.
fn bundle(cameras: usize, points: usize, noise_px: f64, seed: u64) -> (Bundle, Scene, Scene) {
    let mut random = SplitMix64(seed);
    let truth = Scene {
        cameras: (0..cameras)
            .map(|i| {
                let around = exp_rotation(DVec3::Y * (i as f64 * 1.3)) * exp_rotation(random.vector() * 0.1);
                RigidMotion { rotation: around, translation: DVec3::new(0.0, 0.0, 4.0) + random.vector() * 0.3 }
            })
            .collect(),
        focal: FOCAL,
        points: (0..points).map(|_| random.vector()).collect(),
    };
    let mut seen = Vec::new();
    for (c, camera) in truth.cameras.iter().enumerate() {
        for (p, point) in truth.points.iter().enumerate() {
            let local = camera.apply(*point);
            let mut pixel = |v: f64| FOCAL * v / local.z + noise_px * random.signed();
            seen.push((c, p, [pixel(local.x), pixel(local.y)], 1.0));
        }
    }
    let sizes = [vec![6; cameras], vec![1], vec![3; points]].concat();
    let anchors = truth.cameras[..2].to_vec();
    let bundle = Bundle { sizes, cameras, is_schur: true, kernel: Kernel::Squares, seen, anchors, lie: None };
    let step: Vec<f64> = (0..bundle.sizes.iter().sum()).map(|_| 0.05 * random.signed()).collect();
    let mut start = bundle.moved(&truth, &step);
    start.focal = FOCAL * 1.05;
    (bundle, truth, start)
}

fn worst_m(a: &Scene, b: &Scene) -> f64 {
    a.points.iter().zip(&b.points).map(|(a, b)| (*a - *b).length()).fold(0.0, f64::max)
}

#[test]
fn every_jacobian_matches_differences() {
    let (bundle, _, start) = bundle(3, 7, 1.0, 41);
    for index in 0..bundle.residual_count() {
        let error = jacobian_error(&bundle, &start, index, 1e-6).unwrap();
        assert!(error < 1e-6, "residual {index}: {error}");
    }
    // A derivative by a block that does not matter is found wrong.
    struct Wrong(Bundle);
    impl BlockProblem for Wrong {
        type Unknowns = Scene;
        fn block_sizes(&self) -> &[usize] {
            self.0.block_sizes()
        }
        fn residual_count(&self) -> usize {
            self.0.residual_count()
        }
        fn residual(&self, at: &Scene, index: usize, with: bool) -> Option<Residual> {
            let mut residual = self.0.residual(at, index, with)?;
            residual.jacobians.pop();
            Some(residual)
        }
        fn moved(&self, at: &Scene, step: &[f64]) -> Scene {
            self.0.moved(at, step)
        }
    }
    assert!(jacobian_error(&Wrong(bundle), &start, 0, 1e-6).unwrap() > 0.1);
}

#[test]
fn exact_pixels_give_the_scene_back_by_either_way() {
    let (mut bundle, truth, start) = bundle(4, 20, 0.0, 42);
    for is_schur in [true, false] {
        bundle.is_schur = is_schur;
        let solution = minimize_blocks(&bundle, &start, &Convergence::default()).unwrap();
        let worst = worst_m(&solution.unknowns, &truth);
        println!("schur {is_schur}: {} steps, cost {:.1e}, worst {worst:.1e} m", solution.steps, solution.cost);
        assert!(worst < 1e-8 && (solution.unknowns.focal - FOCAL).abs() < 1e-5, "{worst}");
        assert!(solution.stop != Stop::StepLimit);
    }
}

#[test]
fn the_schur_complement_changes_neither_steps_nor_covariance_and_repeats_bit_by_bit() {
    let (schur, _, start) = bundle(4, 15, 1.0, 43);
    let dense = Bundle { is_schur: false, ..schur.clone() };
    for damping in [0.0, 1e-3, 1.0] {
        let a = Assembled(&schur).linearize(&start).unwrap().step(damping, 1e-9).unwrap();
        let b = Assembled(&dense).linearize(&start).unwrap().step(damping, 1e-9).unwrap();
        assert!((&a - &b).amax() < 1e-8 * b.amax(), "{damping}: {}", (&a - &b).amax());
    }
    let options = Convergence::default();
    let a = minimize_blocks(&schur, &start, &options).unwrap();
    assert_eq!(a, minimize_blocks(&schur, &start, &options).unwrap());
    let b = minimize_blocks(&dense, &start, &options).unwrap();
    assert!(worst_m(&a.unknowns, &b.unknowns) < 1e-6 && (a.cost - b.cost).abs() < 1e-9 * b.cost);
    let (kept, all) = (block_covariance(&schur, &a.unknowns).unwrap(), block_covariance(&dense, &a.unknowns).unwrap());
    assert_eq!((kept.nrows(), all.nrows()), (25, 70));
    let worst = (&kept - all.view((0, 0), (25, 25))).amax() / kept.amax();
    assert!(worst < 1e-6, "{worst}");
}

#[test]
fn covariance_predicts_the_spread_of_the_focal_length() {
    let mut ratios = Vec::new();
    for seed in 0..400 {
        let (mut bundle, _, start) = bundle(4, 12, 1.0, 100 + seed);
        // Uniform noise of ±1 pixel has a variance of a third.
        bundle.seen.iter_mut().for_each(|seen| seen.3 = 3.0);
        // The anchors' standard deviation is 1 mm and 1 mrad.
        let mut random = SplitMix64(seed);
        let mut noise = || random.vector() * (3f64.sqrt() * 1e-3);
        bundle.anchors.iter_mut().for_each(|anchor| *anchor = anchor.moved(noise(), noise()));
        let solution = minimize_blocks(&bundle, &start, &Convergence::default()).unwrap();
        let variance = block_covariance(&bundle, &solution.unknowns).unwrap()[(24, 24)];
        ratios.push((solution.unknowns.focal - FOCAL).powi(2) / variance);
    }
    let ratio = ratios.iter().sum::<f64>() / ratios.len() as f64;
    println!("focal length: squared error over its variance {ratio:.2} in the mean of {} scenes", ratios.len());
    assert!((0.6..1.6).contains(&ratio), "{ratio}");
}

#[test]
fn robust_kernels_bear_a_tenth_of_wrong_pixels_and_squares_do_not() {
    let (mut bundle, truth, start) = bundle(5, 20, 0.2, 44);
    let mut random = SplitMix64(45);
    for seen in bundle.seen.iter_mut().step_by(11) {
        seen.2 = [seen.2[0] + 60.0 + 40.0 * random.signed(), seen.2[1] - 50.0];
    }
    // Bounded kernels need a start in their reach, as of the kernel before.
    let mut at = start;
    for (kernel, bound_m) in [
        (Kernel::Squares, 1.0),
        (Kernel::Huber(1.0), 0.05),
        (Kernel::Cauchy(1.0), 5e-3),
        (Kernel::GemanMcClure(3.0), 5e-3),
    ] {
        bundle.kernel = kernel;
        let before = Assembled(&bundle).cost(&at);
        let solution = minimize_blocks(&bundle, &at, &Convergence::default()).unwrap();
        let worst = worst_m(&solution.unknowns, &truth);
        println!("{kernel:?}: {} steps, worst {worst:.1e} m", solution.steps);
        assert!(solution.cost < before && worst < bound_m, "{kernel:?}: {worst}");
        if kernel == Kernel::Squares {
            assert!(worst > 0.03, "the outliers matter: {worst}");
        }
        at = solution.unknowns;
    }
}

#[test]
fn a_free_gauge_and_unseen_points_have_no_covariance_but_a_solution() {
    let (bundle, truth, start) = bundle(3, 12, 0.0, 46);
    let free = Bundle { anchors: Vec::new(), ..bundle.clone() };
    let solution = minimize_blocks(&free, &start, &Convergence::default()).unwrap();
    assert!(solution.cost < 1e-8, "{}", solution.cost);
    assert!(block_covariance(&free, &solution.unknowns).is_none());
    let mut unseen = bundle.clone();
    unseen.seen.retain(|(_, point, ..)| *point != 5);
    let solution = minimize_blocks(&unseen, &start, &Convergence::default()).unwrap();
    assert_eq!(solution.unknowns.points[5], start.points[5], "nothing moves it");
    assert!(
        worst_m(
            &Scene {
                points: [&solution.unknowns.points[..5], &solution.unknowns.points[6..]].concat(),
                ..truth.clone()
            },
            &Scene { points: [&truth.points[..5], &truth.points[6..]].concat(), ..truth.clone() }
        ) < 1e-7
    );
    assert!(block_covariance(&unseen, &solution.unknowns).is_none());
    assert!(block_covariance(&bundle, &truth).is_some());
}

#[test]
fn poisoned_empty_and_misshapen_problems_are_refused_by_name() {
    let (bundle, _, start) = bundle(2, 6, 0.5, 47);
    let options = Convergence::default();
    let refused = |bundle: &Bundle, start: &Scene| minimize_blocks(bundle, start, &options).unwrap_err();
    for (pixel, weight) in [(f64::NAN, 1.0), (f64::INFINITY, 1.0), (0.0, f64::NAN), (0.0, -1.0), (0.0, f64::INFINITY)] {
        let mut poisoned = bundle.clone();
        (poisoned.seen[3].2[0], poisoned.seen[3].3) = (pixel, weight);
        assert_eq!(refused(&poisoned, &start), BlockError::Start { index: 3 });
    }
    let mut ignored = bundle.clone();
    (ignored.seen[3].2[0], ignored.seen[3].3) = (f64::NAN, 0.0);
    let solution = minimize_blocks(&ignored, &start, &options).unwrap();
    assert!(solution.cost.is_finite() && solution.unknowns.points.iter().all(|p| p.is_finite()));
    let no_scale = Bundle { kernel: Kernel::Cauchy(0.0), ..bundle.clone() };
    assert_eq!(refused(&no_scale, &start), BlockError::Start { index: 0 });
    let mut behind = start.clone();
    behind.points[1] = DVec3::new(0.0, 0.0, -100.0);
    assert!(matches!(refused(&bundle, &behind), BlockError::Start { .. }));
    for (block, word) in [(99, "no block 99"), (0, "2x3 instead of 2x6"), (4, "more than one"), (3, "twice")] {
        let lying = Bundle { lie: Some((0, block)), ..bundle.clone() };
        let message = refused(&lying, &start).to_string();
        assert!(message.contains("residual block 0") && message.contains(word), "{message}");
        assert!(jacobian_error(&lying, &start, 0, 1e-6).is_none() && block_covariance(&lying, &start).is_none());
    }
    let huge = Bundle {
        kernel: Kernel::Squares,
        seen: bundle.seen.iter().map(|s| (s.0, s.1, [6e153; 2], 1.0)).collect(),
        ..bundle.clone()
    };
    assert_eq!(refused(&huge, &start), BlockError::Overflow);
    let empty = Bundle { seen: Vec::new(), anchors: Vec::new(), ..bundle };
    let solution = minimize_blocks(&empty, &start, &options).unwrap();
    assert_eq!((solution.unknowns, solution.cost.to_bits()), (start.clone(), 0));
    assert!(block_covariance(&empty, &start).is_none());
}

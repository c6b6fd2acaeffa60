//! Joint least squares of a body's shape and its poses in several frame sets.
//!
//! Poses are eliminated by the Schur complement, derivatives by the shape are finite differences of the template.

use flyrig_body::Template;
use flyrig_solve::{ArrowNormal, Convergence, DenseNormal, EliminatedBlock, Problem, minimize};
use glam::DVec3;
use nalgebra::DVector;
use rayon::prelude::*;

use crate::pose::body_model::{BodyModel, JointTurns};
use crate::pose::fit::{FitProblem, ShapeDerivatives};
use crate::pose::line_point::LinePoint;
use crate::shape::body_shape::{ShapeSpace, UnscaledBody};

/// Step of the finite differences by the shape's parameters.
const STEP: f64 = 0.01;
/// Largest number of solver steps.
const MAX_STEPS: usize = 20;
/// Relative gain below which the solver stops. Lengths and the whole body's scale trade against each other at little cost: with
/// 1e-3 a calibration that differed by 1e-7 ended at bodies of 1.55 and 1.56 m, one in shoes and one without.
const MIN_GAIN: f64 = 1e-5;

/// Measurements of one frame set.
#[derive(Debug, Clone)]
pub(crate) struct ShapeSet<'a> {
    /// Landmarks and views; model and outline are replaced by those of the current shape.
    pub problem: FitProblem<'a>,
    /// Points of the body's outline with the image lines that they belong on.
    pub outline: Vec<LinePoint>,
}

/// Parameters of the shape, and a pose for each frame set.
#[derive(Debug, Clone)]
pub(crate) struct ShapeAndPoses {
    pub shape: Vec<f64>,
    pub poses: Vec<JointTurns>,
}

/// Fit of one shape and all poses to all frame sets.
pub(crate) struct ShapeProblem<'a> {
    pub space: &'a ShapeSpace,
    pub sets: &'a [ShapeSet<'a>],
}

impl ShapeProblem<'_> {
    /// Returns improved shape and poses, and the standard deviations of the shape's parameters; `None` when the start has
    /// no finite cost.
    pub fn solve(&self, start: &ShapeAndPoses) -> Option<(ShapeAndPoses, Vec<f64>)> {
        let options = Convergence { max_steps: MAX_STEPS, min_gain: MIN_GAIN, ..Convergence::default() };
        let solution = minimize(self, start, &options)?;
        let covariance = self.linearize(&solution.unknowns)?.covariance()?;
        let sigma = covariance.diagonal().iter().map(|variance| variance.max(0.0).sqrt()).collect();
        Some((solution.unknowns, sigma))
    }

    /// Returns template and model of a shape.
    fn model(&self, shape: &[f64]) -> Option<(Template, BodyModel)> {
        let template = self.space.template(shape).ok()?;
        let model = BodyModel::new(&template).ok()?;
        Some((template, model))
    }

    /// Calls `then` with the fit of one frame set to the body of a shape.
    fn with_set<T>(
        set: &ShapeSet<'_>,
        template: &Template,
        model: &BodyModel,
        then: impl FnOnce(&FitProblem<'_>) -> T,
    ) -> T {
        let mut outline = set.outline.clone();
        for point in &mut outline {
            point.hang(model, template);
        }
        then(&FitProblem { model, lines: &outline, ..set.problem.clone() })
    }

    /// Returns the derivatives of a model by the parameters of its shape; `unscaled` is its body before scale, lengths and
    /// girths.
    fn derivatives(
        &self,
        shape: &[f64],
        unscaled: &UnscaledBody<'_>,
        (template, model): (&Template, &BodyModel),
    ) -> Option<ShapeDerivatives> {
        let columns: Vec<_> = (0..shape.len())
            .into_par_iter()
            .map(|k| {
                // Towards the middle of the range, where bodies exist.
                let step = if ShapeSpace::clamped(k, shape[k] + STEP) > shape[k] + 0.5 * STEP { STEP } else { -STEP };
                let mut moved = shape.to_vec();
                moved[k] += step;
                let of_targets = ShapeSpace::is_target(k).then(|| self.space.unscaled(&moved)).transpose().ok()?;
                let other = of_targets.as_ref().unwrap_or(unscaled).scaled(&moved).ok()?;
                let other_model = BodyModel::new(&other).ok()?;
                let change = |a: DVec3, b: DVec3| (a - b) / step;
                let pairs = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).map(|(a, b)| change(*a, *b)).collect::<Vec<_>>();
                let local = |model: &BodyModel, i: usize| {
                    let mark = &model.marks[i];
                    mark.point - model.origins[mark.joint]
                };
                let positions = other.positions.iter().zip(&template.positions);
                Some((
                    pairs(&other_model.origins, &model.origins),
                    pairs(&other_model.offsets, &model.offsets),
                    std::array::from_fn(|i| change(local(&other_model, i), local(model, i))),
                    positions.map(|(a, b)| change(a.as_dvec3(), b.as_dvec3())).collect::<Vec<_>>(),
                ))
            })
            .collect::<Option<_>>()?;
        let mut derivatives = ShapeDerivatives { count: shape.len(), ..ShapeDerivatives::default() };
        for (origins, offsets, marks, positions) in columns {
            derivatives.origins.push(origins);
            derivatives.offsets.push(offsets);
            derivatives.marks.push(marks);
            derivatives.positions.push(positions);
        }
        Some(derivatives)
    }

    /// Returns the residual of each parameter and its derivative.
    fn prior(&self, shape: &[f64]) -> Vec<(f64, f64)> {
        let prior = self.space.prior();
        prior.iter().zip(shape).map(|((_, mean, sigma), value)| ((value - mean) / sigma, 1.0 / sigma)).collect()
    }
}

impl Problem for ShapeProblem<'_> {
    type Unknowns = ShapeAndPoses;
    type Normal = ArrowNormal;

    fn cost(&self, at: &ShapeAndPoses) -> f64 {
        let Some((template, model)) = self.model(&at.shape) else { return f64::NAN };
        let costs = self.sets.par_iter().zip(&at.poses);
        let data: Vec<f64> =
            costs.map(|(set, pose)| Self::with_set(set, &template, &model, |problem| problem.cost(pose))).collect();
        // In a fixed order, so that the same input gives the same bits.
        data.iter().sum::<f64>() + self.prior(&at.shape).iter().map(|(error, _)| 0.5 * error * error).sum::<f64>()
    }

    fn linearize(&self, at: &ShapeAndPoses) -> Option<ArrowNormal> {
        let unscaled = self.space.unscaled(&at.shape).ok()?;
        let template = unscaled.scaled(&at.shape).ok()?;
        let model = BodyModel::new(&template).ok()?;
        let derivatives = self.derivatives(&at.shape, &unscaled, (&template, &model))?;
        let count = at.shape.len();
        let mut kept = DenseNormal::zeros(count);
        for (k, (error, slope)) in self.prior(&at.shape).into_iter().enumerate() {
            kept.gradient[k] += error * slope;
            kept.matrix[(k, k)] += slope * slope;
        }
        let equations: Vec<DenseNormal> = self
            .sets
            .par_iter()
            .zip(&at.poses)
            .map(|(set, pose)| {
                Self::with_set(set, &template, &model, |problem| problem.linearize_with(pose, Some(&derivatives)))
            })
            .collect();
        let mut eliminated = Vec::with_capacity(equations.len());
        for DenseNormal { matrix, gradient } in equations {
            let poses = gradient.len() - count;
            kept.matrix += matrix.view((poses, poses), (count, count));
            kept.gradient += gradient.rows(poses, count);
            eliminated.push(EliminatedBlock {
                normal: DenseNormal {
                    matrix: matrix.view((0, 0), (poses, poses)).into_owned(),
                    gradient: gradient.rows(0, poses).into_owned(),
                },
                coupling: vec![(0, matrix.view((poses, 0), (count, poses)).into_owned())],
            });
        }
        Some(ArrowNormal { kept, eliminated })
    }

    fn moved(&self, at: &ShapeAndPoses, step: &DVector<f64>) -> ShapeAndPoses {
        let count = at.shape.len();
        let moved = |(k, value): (usize, &f64)| ShapeSpace::clamped(k, value + step[k]);
        let mut first = count;
        let mut poses = Vec::with_capacity(at.poses.len());
        for (set, pose) in self.sets.iter().zip(&at.poses) {
            let size = set.problem.pose_size();
            poses.push(set.problem.moved(pose, &step.rows(first, size).into_owned()));
            first += size;
        }
        ShapeAndPoses { shape: at.shape.iter().enumerate().map(moved).collect(), poses }
    }
}

#[cfg(test)]
mod tests {
    use flyrig_body::skin_mesh;
    use flyrig_types::Camera;

    use super::*;
    use crate::image::view::{View, observe};
    use crate::pose::fit::FitView;
    use crate::pose::outline::SeenBody;
    use crate::testing::{body, fit_problem, keypoints_of, mask_of, random_turns, ring};

    fn views(cameras: &[Camera], model: &BodyModel, turns: &JointTurns) -> Vec<FitView> {
        let one = |(slot, camera): (usize, &Camera)| {
            let view = View::new(camera);
            let seen = observe(camera, &view, &keypoints_of(camera, &model.marks(turns)), 0.3);
            FitView {
                slot,
                view,
                seen,
                shift: [DVec3::ZERO; crate::landmarks::keypoints::LANDMARK_COUNT],
                delay_secs: 0.0,
            }
        };
        cameras.iter().enumerate().map(one).collect()
    }

    fn outline(
        cameras: &[Camera],
        (truth, true_turns): (&Template, &JointTurns),
        (template, model, turns): (&Template, &BodyModel, &JointTurns),
    ) -> Vec<LinePoint> {
        let true_model = BodyModel::new(truth).unwrap();
        let (vertices, normals) = skin_mesh(template, &model.to_pose(turns));
        let one = |(index, camera): (usize, &Camera)| {
            let view = View::new(camera);
            let seen =
                SeenBody { camera, view: &view, template, model, vertices: &vertices, normals: &normals, gate: None };
            seen.match_mask(&mask_of(camera, truth, &true_model.to_pose(true_turns)), index, 0.1, 0.01)
        };
        cameras.iter().enumerate().flat_map(one).collect()
    }

    /// Returns the measurements of a person in several poses, matched with a body in estimates of these poses.
    fn sets<'a>(
        cameras: &[Camera],
        (truth, true_turns): (&Template, &[JointTurns]),
        (template, model, turns): (&Template, &'a BodyModel, &[JointTurns]),
        seen: &'a [Vec<FitView>],
    ) -> Vec<ShapeSet<'a>> {
        let poses = true_turns.iter().zip(turns).zip(seen);
        poses
            .map(|((true_turns, turns), views)| ShapeSet {
                problem: fit_problem(model, views, 1.0),
                outline: outline(cameras, (truth, true_turns), (template, model, turns)),
            })
            .collect()
    }

    /// A person of another shape, and the space that the shape lies in.
    fn person() -> (ShapeSpace, Vec<f64>, Template) {
        let space = ShapeSpace::new(&body());
        let prior = space.prior();
        let true_value = |name: &str, mean: f64| match name {
            "scale" => 1.05,
            "thighs" => 1.04,
            "forearms" => 0.95,
            "thigh-girth" => 1.15,
            "trunk-depth" => 1.1,
            "weight" => 0.6,
            _ => mean,
        };
        let values: Vec<f64> = prior.iter().map(|(name, mean, _)| true_value(name, *mean)).collect();
        let template = space.template(&values).unwrap();
        (space, values, template)
    }

    #[test]
    fn landmarks_and_outlines_bring_lengths_and_girths_back() {
        let (space, values, truth) = person();
        let rig = ring(3);
        let true_model = BodyModel::new(&truth).unwrap();
        let true_turns: Vec<JointTurns> = (0..4).map(|seed| random_turns(&true_model, seed)).collect();
        let mut at = ShapeAndPoses {
            shape: space.prior().iter().map(|(_, mean, _)| *mean).collect(),
            poses: true_turns.clone(),
        };
        let mut template = space.template(&at.shape).unwrap();
        let error = |template: &Template| {
            let pairs = template.positions.iter().zip(&truth.positions);
            pairs.map(|(a, b)| f64::from(a.distance(*b))).sum::<f64>() / truth.positions.len() as f64
        };
        let first = error(&template);
        let mut sigma = Vec::new();
        for _ in 0..3 {
            let model = BodyModel::new(&template).unwrap();
            let seen: Vec<Vec<FitView>> =
                true_turns.iter().map(|turns| views(&rig.cameras, &true_model, turns)).collect();
            let sets = sets(&rig.cameras, (&truth, &true_turns), (&template, &model, &at.poses), &seen);
            (at, sigma) = ShapeProblem { space: &space, sets: &sets }.solve(&at).unwrap();
            template = space.template(&at.shape).unwrap();
        }
        assert!(error(&template) < 0.35 * first, "{} of {first} m", error(&template));
        for (index, (name, ..)) in space.prior().iter().enumerate() {
            assert!(sigma[index].is_finite() && sigma[index] > 0.0, "{name}");
            if ["scale", "thighs", "forearms", "thigh-girth"].contains(name) {
                assert!(
                    (at.shape[index] - values[index]).abs() < 0.04,
                    "{name}: {} {}",
                    at.shape[index],
                    values[index]
                );
            }
        }
    }

    #[test]
    fn every_start_ends_at_the_bottom_of_the_valley() {
        let (space, _, truth) = person();
        let rig = ring(3);
        let true_model = BodyModel::new(&truth).unwrap();
        let true_turns: Vec<JointTurns> = (0..4).map(|seed| random_turns(&true_model, seed)).collect();
        let shape: Vec<f64> = space.prior().iter().map(|(_, mean, _)| *mean).collect();
        let template = space.template(&shape).unwrap();
        let model = BodyModel::new(&template).unwrap();
        let seen: Vec<Vec<FitView>> = true_turns.iter().map(|turns| views(&rig.cameras, &true_model, turns)).collect();
        let sets = sets(&rig.cameras, (&truth, &true_turns), (&template, &model, &true_turns), &seen);
        let problem = ShapeProblem { space: &space, sets: &sets };
        let from = |shape: Vec<f64>| ShapeAndPoses { shape, poses: true_turns.clone() };
        let options = Convergence { max_steps: 200, min_gain: 1e-9, ..Convergence::default() };
        let best = minimize(&problem, &from(shape.clone()), &options).unwrap().cost;
        for by in [0.0, 0.02, -0.02, 0.05] {
            let moved = |(k, v): (usize, &f64)| ShapeSpace::clamped(k, if k % 2 == 0 { v + by } else { v - by });
            let (solved, _) = problem.solve(&from(shape.iter().enumerate().map(moved).collect())).unwrap();
            let cost = problem.cost(&solved);
            assert!(cost < 1.005 * best, "{by}: {cost} {best}");
        }
    }

    #[test]
    fn the_gradient_matches_differences_of_the_cost() {
        let (space, values, truth) = person();
        let rig = ring(3);
        let true_model = BodyModel::new(&truth).unwrap();
        let true_turns = random_turns(&true_model, 1);
        // Off the truth, so that nothing vanishes.
        let at = ShapeAndPoses {
            shape: values.iter().enumerate().map(|(k, v)| v + if k % 2 == 0 { 0.02 } else { -0.02 }).collect(),
            poses: vec![random_turns(&true_model, 1)],
        };
        let template = space.template(&at.shape).unwrap();
        let model = BodyModel::new(&template).unwrap();
        let seen = views(&rig.cameras, &true_model, &true_turns);
        let sets = [ShapeSet {
            problem: fit_problem(&model, &seen, 1.0),
            outline: outline(&rig.cameras, (&truth, &true_turns), (&template, &model, &at.poses[0])),
        }];
        let problem = ShapeProblem { space: &space, sets: &sets };
        let ArrowNormal { kept, eliminated } = problem.linearize(&at).unwrap();
        let analytic: Vec<f64> = kept.gradient.iter().chain(eliminated[0].normal.gradient.iter()).copied().collect();
        let largest = analytic.iter().fold(0.0f64, |most, g| most.max(g.abs()));
        let count = space.prior().len();
        // Targets are piecewise linear and their derivatives are differences; root shifts leave out a pixel's size.
        let exact = |k: usize| k < count - 3 || k >= count + 3;
        for k in (0..analytic.len()).filter(|&k| exact(k)) {
            let step = if k < count { 1e-3 } else { 1e-5 };
            let cost = |by: f64| {
                let mut flat = DVector::zeros(analytic.len());
                flat[k] = by;
                problem.cost(&problem.moved(&at, &flat))
            };
            let numeric = (cost(step) - cost(-step)) / (2.0 * step);
            let tolerance = if k < count { 0.03 } else { 2e-3 };
            assert!(
                (numeric - analytic[k]).abs() < tolerance * (0.02 * largest + numeric.abs()),
                "{k}: {numeric} {}",
                analytic[k]
            );
        }
    }

    #[test]
    fn a_start_that_is_not_finite_has_no_solution() {
        let (space, mut values, truth) = person();
        let model = BodyModel::new(&truth).unwrap();
        let turns = random_turns(&model, 1);
        let seen = views(&ring(2).cameras, &model, &turns);
        let sets = [ShapeSet { problem: fit_problem(&model, &seen, 1.0), outline: Vec::new() }];
        values[0] = f64::NAN;
        let start = ShapeAndPoses { shape: values, poses: vec![turns] };
        assert!(ShapeProblem { space: &space, sets: &sets }.solve(&start).is_none());
    }
}

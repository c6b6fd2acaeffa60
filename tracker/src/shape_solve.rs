//! Shape of a body and its poses in several frame sets, solved together.

use flyrig_body::Template;
use flyrig_solve::{ArrowNormal, Convergence, DenseNormal, EliminatedBlock, Problem, minimize};
use glam::DVec3;
use nalgebra::DVector;
use rayon::prelude::*;

use crate::body_model::{BodyModel, Turns};
use crate::body_shape::ShapeSpace;
use crate::fit::{FitProblem, ShapeDerivatives};
use crate::outline::OutlinePoint;

/// Step of the derivatives by the shape's parameters.
const STEP: f64 = 0.01;
/// Steps of the solver.
const MAX_STEPS: usize = 6;

/// A frame set as the shape is fitted to it.
#[derive(Debug, Clone)]
pub(crate) struct ShapeSet<'a> {
    /// Landmarks and views; its model and outline are replaced.
    pub problem: FitProblem<'a>,
    /// Points of the body's outline with the lines they belong on.
    pub outline: Vec<OutlinePoint>,
}

/// Parameters of the shape, and a pose for each set.
#[derive(Debug, Clone)]
pub(crate) struct ShapeAndPoses {
    pub shape: Vec<f64>,
    pub poses: Vec<Turns>,
}

/// Shape and poses that explain all sets.
pub(crate) struct ShapeProblem<'a> {
    pub space: &'a ShapeSpace,
    pub sets: &'a [ShapeSet<'a>],
}

impl ShapeProblem<'_> {
    /// Returns shape and poses better than the start, and the standard deviations of the shape's parameters; `None` when the
    /// start makes no sense.
    pub fn solve(&self, start: &ShapeAndPoses) -> Option<(ShapeAndPoses, Vec<f64>)> {
        let options = Convergence { max_steps: MAX_STEPS, min_gain: 1e-3, ..Convergence::default() };
        let solution = minimize(self, start, &options)?;
        let covariance = self.linearize(&solution.unknowns)?.covariance()?;
        let sigma = covariance.diagonal().iter().map(|variance| variance.max(0.0).sqrt()).collect();
        Some((solution.unknowns, sigma))
    }

    fn model(&self, shape: &[f64]) -> Option<(Template, BodyModel)> {
        let template = self.space.template(shape).ok()?;
        let model = BodyModel::new(&template).ok()?;
        Some((template, model))
    }

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
        then(&FitProblem { model, outline: &outline, ..set.problem.clone() })
    }

    fn derivatives(&self, shape: &[f64], template: &Template, model: &BodyModel) -> Option<ShapeDerivatives> {
        let columns: Vec<_> = (0..shape.len())
            .into_par_iter()
            .map(|k| {
                // Towards the middle of the range, where there are bodies.
                let step = if self.space.clamped(k, shape[k] + STEP) > shape[k] + 0.5 * STEP { STEP } else { -STEP };
                let mut moved = shape.to_vec();
                moved[k] += step;
                let (other, other_model) = self.model(&moved)?;
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
        let data: Vec<f64> = costs
            .map(|(set, pose)| Self::with_set(set, &template, &model, |problem| problem.cost(pose)))
            .collect();
        // In a fixed order, so that the same input gives the same bits.
        data.iter().sum::<f64>() + self.prior(&at.shape).iter().map(|(error, _)| 0.5 * error * error).sum::<f64>()
    }

    fn linearize(&self, at: &ShapeAndPoses) -> Option<ArrowNormal> {
        let (template, model) = self.model(&at.shape)?;
        let derivatives = self.derivatives(&at.shape, &template, &model)?;
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
        let moved = |(k, value): (usize, &f64)| self.space.clamped(k, value + step[k]);
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

//! Tracking of the deformation from frame set to frame set: steps, damping, limits and the loss's floor.

use flyrig_body::{DeformationGraph, SkinWeights, displacement};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::deform::carry::to_canonical;
use crate::deform::data::{DataTerm, PointDerivatives};
use crate::deform::normal::NormalMatrix;
use crate::deform::regularizer::Regularizer;
use crate::deform::settings::{DeformSettings, DeformSolver, FIRST_FRAMES};
use crate::deform::thickness::Thickness;
use crate::error::{TrackError, TrackErrorKind};

/// Limits of the damping, shares of the mean diagonal.
const DAMPING_RANGE: (f64, f64) = (1e-3, 1e6);
/// Ratios of actual to predicted decrease of the loss above and below which the damping changes after a step.
const GOOD_GAIN: f64 = 0.75;
const POOR_GAIN: f64 = 0.25;
/// Least predicted decrease of the loss, as a share of it, for a step to be tried: the images' sums are `f32`, and rounding
/// would otherwise decide on the damping of the next frame sets.
const LEAST_GAIN: f64 = 1e-5;
/// Damping that keeps the matrix regular where neither image nor neighbour constrains a node, as a share of its mean
/// diagonal, so that the unit of length does not matter.
const LEAST_DAMPING: f64 = 1e-11;
/// Longest step of [`DeformTracker::align`], in longest steps of [`DeformTracker::track`].
const ALIGN_STEPS: f64 = 3.0;

/// Report of the solver on one frame set.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DeformReport {
    /// Total loss (Eq. 3) before the first iteration and after each one; for [`DeformSolver::Paper`], which does not
    /// evaluate its steps, before each one.
    pub losses: Vec<f64>,
    /// Accepted steps.
    pub accepted: usize,
    /// Steps that were rejected because the loss did not fall.
    pub refused: usize,
    /// Gaussians that were dropped because a derivative was not finite.
    pub dropped: usize,
    /// Whether the loss was not finite, so that the frame set changed nothing.
    pub poisoned: bool,
    /// Whether the loss was at its floor, so that no iteration was made.
    pub at_rest: bool,
}

/// Translations of the graph's nodes, tracked over time. The state stays finite: a frame set whose loss is not finite
/// changes nothing.
#[derive(Debug)]
pub struct DeformTracker {
    settings: DeformSettings,
    rest: Vec<Vec3>,
    gaussian_nodes: Vec<[u32; 4]>,
    gaussian_weights: Vec<[f32; 4]>,
    skin: Vec<SkinWeights>,
    regularizer: Regularizer,
    matrix: NormalMatrix,
    translations: Vec<DVec3>,
    smooth: Vec<DVec3>,
    displacement: Vec<[f32; 4]>,
    derivatives: Vec<PointDerivatives>,
    thickness: Option<Thickness>,
    damping: f64,
    /// Loss at which the last iteration gained almost nothing.
    floor: Option<f64>,
    frame: u64,
}

impl DeformTracker {
    /// Creates a tracker at rest. `skin` holds the weights of the Gaussians that `graph` was built for.
    ///
    /// # Errors
    /// [`TrackErrorKind::Template`] when graph and skin do not fit together or the settings are not usable.
    pub fn new(graph: &DeformationGraph, skin: &[SkinWeights], settings: DeformSettings) -> Result<Self, TrackError> {
        let fail = |message: String| Err(TrackError::new(TrackErrorKind::Template, message));
        if let Some(fault) = settings.fault() {
            return fail(format!("the deformation's settings are not usable: {fault}"));
        }
        let nodes = graph.nodes.len();
        let count = graph.gaussian_nodes.len();
        let in_graph = |list: &[u32; 4]| list.iter().all(|&node| (node as usize) < nodes);
        let fits = graph.gaussian_weights.len() == count
            && skin.len() == count
            && graph.neighbors.len() == nodes
            && graph.neighbors.iter().chain(&graph.gaussian_nodes).all(in_graph);
        if !fits {
            return fail(format!(
                "a deformation graph of {nodes} nodes and {count} Gaussians does not fit {} skin weights; build both \
                 from the same surface",
                skin.len()
            ));
        }
        let edges: Vec<(u32, u32, f64)> = (0u32..)
            .zip(&graph.neighbors)
            .flat_map(|(node, others)| others.iter().filter(move |&&other| other != node).map(move |&o| (node, o, 1.0)))
            .collect();
        let matrix = NormalMatrix::new(nodes, &graph.gaussian_nodes, &graph.gaussian_weights, &edges);
        let regularizer = Regularizer {
            edges,
            spatial: settings.regularization * settings.spatial,
            temporal: settings.regularization * settings.temporal,
            anchor: settings.anchor,
            mean: vec![DVec3::ZERO; nodes],
            history: false,
        };
        Ok(Self {
            damping: settings.damping,
            settings,
            rest: graph.nodes.clone(),
            gaussian_nodes: graph.gaussian_nodes.clone(),
            gaussian_weights: graph.gaussian_weights.clone(),
            skin: skin.to_vec(),
            regularizer,
            matrix,
            translations: vec![DVec3::ZERO; nodes],
            smooth: vec![DVec3::ZERO; nodes],
            displacement: vec![[0.0; 4]; count],
            derivatives: Vec::new(),
            thickness: None,
            floor: None,
            frame: 0,
        })
    }

    /// Scales the stiffness of parts of the body (head, hands and feet are stiffer than clothes): an edge's share of Eq. 4
    /// is multiplied by the geometric mean of its two nodes' numbers. Gradient descent ignores it.
    ///
    /// # Errors
    /// [`TrackErrorKind::Template`] unless there is one finite number above 0 per node.
    pub fn with_stiffness(mut self, of_node: &[f64]) -> Result<Self, TrackError> {
        let nodes = self.translations.len();
        if of_node.len() != nodes || !of_node.iter().all(|s| s.is_finite() && *s > 0.0) {
            let message = format!("{} numbers above 0 for the stiffness of {nodes} nodes", of_node.len());
            return Err(TrackError::new(TrackErrorKind::Template, message));
        }
        if matches!(self.settings.solver, DeformSolver::GaussNewton { .. }) {
            for (i, j, stiff) in &mut self.regularizer.edges {
                *stiff = (of_node[*i as usize] * of_node[*j as usize]).sqrt();
            }
            let edges = &self.regularizer.edges;
            self.matrix = NormalMatrix::new(nodes, &self.gaussian_nodes, &self.gaussian_weights, edges);
        }
        Ok(self)
    }

    /// Estimates the thickness of clothes on each part where images constrain it, and applies it where they do not. Takes
    /// one canonical unit normal and one part number per node, and whether the node belongs to loose clothes, such as a skirt around the legs:
    /// those of a part are as thick as each other, and say nothing about the rest of it. Gradient descent ignores the thickness.
    ///
    /// # Errors
    /// [`TrackErrorKind::Template`] unless there are one finite normal and one part per node.
    pub fn with_thickness(mut self, normals: Vec<DVec3>, parts: &[(usize, bool)]) -> Result<Self, TrackError> {
        let nodes = self.translations.len();
        if normals.len() != nodes || parts.len() != nodes || !normals.iter().all(|n| n.is_finite()) {
            let message = format!("{} finite normals and {} parts for {nodes} nodes", normals.len(), parts.len());
            return Err(TrackError::new(TrackErrorKind::Template, message));
        }
        if matches!(self.settings.solver, DeformSolver::GaussNewton { .. }) {
            self.thickness = Some(Thickness::new(normals, parts.iter().copied(), self.settings.thickness_m));
        }
        Ok(self)
    }

    /// Starts from a known mean shape: translations of the nodes, canonical metres. Smoothness and thickness are measured from
    /// it, and [`Self::reset`] returns to it.
    ///
    /// # Errors
    /// [`TrackErrorKind::Template`] unless there is one finite translation per node.
    pub fn with_mean(mut self, translations: &[DVec3]) -> Result<Self, TrackError> {
        self.set_mean(translations)?;
        self.reset();
        Ok(self)
    }

    /// Replaces the mean shape, canonical metres, from the next frame set on; translations are kept.
    ///
    /// # Errors
    /// Those of [`Self::with_mean`].
    pub fn set_mean(&mut self, translations: &[DVec3]) -> Result<(), TrackError> {
        self.check_translations(translations)?;
        self.regularizer.mean = translations.to_vec();
        if let Some(thickness) = &mut self.thickness {
            thickness.forget();
        }
        Ok(())
    }

    /// Resets to the mean shape; the next frame set counts as the first.
    pub fn reset(&mut self) {
        self.restore(self.regularizer.mean.clone());
        self.smooth.clone_from(&self.translations);
        if let Some(thickness) = &mut self.thickness {
            thickness.forget();
        }
        self.damping = self.settings.damping;
        self.floor = None;
        self.frame = 0;
    }

    /// Keeps the translations; the next frame set counts as the first again.
    pub fn restart(&mut self) {
        self.smooth.clone_from(&self.translations);
        self.damping = self.settings.damping;
        self.floor = None;
        self.frame = 0;
    }

    /// Resumes from translations of an earlier tracker of the same graph, canonical metres; the next frame set counts as
    /// the first.
    ///
    /// # Errors
    /// [`TrackErrorKind::Template`] unless there is one finite translation per node.
    pub fn resume(&mut self, translations: &[DVec3]) -> Result<(), TrackError> {
        self.check_translations(translations)?;
        self.reset();
        self.restore(translations.to_vec());
        self.smooth.clone_from(&self.translations);
        Ok(())
    }

    fn check_translations(&self, translations: &[DVec3]) -> Result<(), TrackError> {
        let nodes = self.translations.len();
        if translations.len() != nodes || !translations.iter().all(|t| t.is_finite()) {
            let message = format!("{} finite translations for {nodes} nodes of the graph", translations.len());
            return Err(TrackError::new(TrackErrorKind::Template, message));
        }
        Ok(())
    }

    /// Returns the canonical translations of the nodes, metres.
    #[must_use]
    pub fn translations(&self) -> &[DVec3] {
        &self.translations
    }

    /// Returns the canonical displacements t_x of the Gaussians (Eq. 2), metres, with their growth in w
    /// ([`flyrig_body::displacement`]).
    #[must_use]
    pub fn displacement(&self) -> &[[f32; 4]] {
        &self.displacement
    }

    /// Ingests one frame set, starting from the translations of the last one.
    ///
    /// # Errors
    /// Those of the data term; the state is then that of the last accepted step.
    pub fn track<D: DataTerm>(&mut self, data: &mut D) -> Result<DeformReport, D::Error> {
        let mut report = DeformReport::default();
        let start = self.translations.clone();
        // Before the first frame set there is nothing to stay close to.
        self.regularizer.history = self.frame > 0;
        if let Some(floor) = self.floor.filter(|_| self.frame >= FIRST_FRAMES) {
            let loss = data.loss(&self.displacement)? + self.prior(None);
            if loss <= floor * (1.0 + self.settings.rest) {
                report.losses.push(loss);
                report.at_rest = true;
                return Ok(report);
            }
        }
        for _ in 0..self.settings.iterations(self.frame) {
            let before = report.accepted;
            self.iterate(data, &mut report)?;
            if report.poisoned {
                self.restore(start);
                return Ok(report);
            }
            if report.accepted == before {
                break;
            }
        }
        self.floor = match report.losses[..] {
            [first, .., last] if self.settings.rest > 0.0 && last >= first * (1.0 - self.settings.rest) => Some(last),
            [_] if self.settings.rest > 0.0 => report.losses.last().copied(),
            _ => None,
        };
        let share = self.settings.smoothing;
        for (smooth, t) in self.smooth.iter_mut().zip(&self.translations) {
            *smooth += (*t - *smooth) * share;
        }
        if let Some(thickness) = &mut self.thickness {
            thickness.learn(&self.translations, &self.regularizer.mean, &self.matrix);
        }
        self.frame += 1;
        Ok(report)
    }

    /// Moves the nodes towards another data term before [`Self::track`], with at most this many steps, and without counting as a frame
    /// set.
    ///
    /// # Errors
    /// Those of the data term; the state is then that of the last accepted step.
    pub fn align<D: DataTerm>(&mut self, data: &mut D, iterations: usize) -> Result<DeformReport, D::Error> {
        let mut report = DeformReport::default();
        let (start, damping) = (self.translations.clone(), self.damping);
        let max_step_m = self.settings.max_step_m;
        self.regularizer.history = self.frame > 0;
        self.damping = self.settings.damping;
        self.settings.max_step_m = ALIGN_STEPS * max_step_m;
        let mut result = Ok(());
        for _ in 0..iterations {
            let before = report.accepted;
            result = self.iterate(data, &mut report);
            if result.is_err() || report.accepted == before {
                break;
            }
        }
        self.damping = damping;
        self.settings.max_step_m = max_step_m;
        if report.poisoned {
            self.restore(start);
        }
        result.map(|()| report)
    }

    /// Takes one step; [`DeformReport::poisoned`] where the loss is not finite.
    fn iterate<D: DataTerm>(&mut self, data: &mut D, report: &mut DeformReport) -> Result<(), D::Error> {
        let mut gradient = vec![DVec3::ZERO; self.translations.len()];
        let mut derivatives = std::mem::take(&mut self.derivatives);
        let data_loss = data.derivatives(&self.displacement, &mut derivatives);
        self.derivatives = derivatives;
        let loss = data_loss? + self.prior(Some(&mut gradient));
        if !loss.is_finite() {
            report.poisoned = true;
            return Ok(());
        }
        // Gauss-Newton has already reported the loss after its step.
        if report.losses.len() == report.accepted {
            report.losses.push(loss);
        }
        let mut by_data = vec![DVec3::ZERO; gradient.len()];
        report.dropped += self.gather(&mut by_data);
        for (sum, by_data) in gradient.iter_mut().zip(&by_data) {
            *sum += *by_data;
        }
        match self.settings.solver {
            DeformSolver::Paper { rate } => {
                let step: Vec<DVec3> = gradient.iter().map(|g| *g * -rate).collect();
                if self.step(&step).is_some() {
                    report.accepted += 1;
                }
                Ok(())
            }
            DeformSolver::GaussNewton { .. } => self.step_downhill(&gradient, loss, data, report),
        }
    }

    /// Adds the data's gradient by the nodes and builds its matrix; returns the number of dropped Gaussians.
    fn gather(&mut self, gradient: &mut [DVec3]) -> usize {
        let mut all_dropped = 0;
        let with_matrix = matches!(self.settings.solver, DeformSolver::GaussNewton { .. });
        self.matrix.clear();
        for derivatives in &self.derivatives {
            let (carried, dropped) = to_canonical(derivatives, &self.skin);
            all_dropped += dropped;
            self.matrix.accumulate(&carried, gradient, with_matrix);
        }
        all_dropped
    }

    /// Returns the regularisation terms of the loss and, where asked, their gradient by the nodes.
    fn prior(&self, gradient: Option<&mut [DVec3]>) -> f64 {
        self.regularizer.loss(&self.translations, &self.smooth, self.thickness.as_ref(), gradient)
    }

    /// Takes a damped Gauss-Newton step, with growing damping until the loss falls or the attempts end.
    fn step_downhill<D: DataTerm>(
        &mut self,
        gradient: &[DVec3],
        loss: f64,
        data: &mut D,
        report: &mut DeformReport,
    ) -> Result<(), D::Error> {
        let right: Vec<DVec3> = gradient.iter().map(|g| -*g).collect();
        if right.iter().all(|g| *g == DVec3::ZERO) {
            return Ok(());
        }
        for _ in 0..self.settings.attempts {
            let stiffness = self.regularizer.stiffness();
            let by_data = self.matrix.mean_diagonal();
            let damping = self.damping * by_data + LEAST_DAMPING * (by_data + stiffness * self.matrix.mean_edges());
            let step = self.matrix.solve(stiffness, damping + 2.0 * self.regularizer.anchor, &right);
            // Decrease of the quadratic model, which the step s solves: (A + damping) s = -g.
            let share = self.shrink(&step);
            let along: f64 = right.iter().zip(&step).map(|(r, s)| r.dot(*s)).sum();
            let squared: f64 = step.iter().map(|s| s.length_squared()).sum();
            let predicted = share * along - 0.5 * share * share * (along - damping * squared);
            if predicted < LEAST_GAIN * loss {
                return Ok(());
            }
            let state = self.translations.clone();
            let new = self.try_step(&step, data)?;
            if new < loss {
                let gain = (loss - new) / predicted;
                if gain > GOOD_GAIN {
                    self.damping = (self.damping / 4.0).max(DAMPING_RANGE.0);
                } else if gain < POOR_GAIN {
                    self.damping = (self.damping * 4.0).min(DAMPING_RANGE.1);
                }
                report.accepted += 1;
                report.losses.push(new);
                return Ok(());
            }
            self.restore(state);
            self.damping = (self.damping.max(DAMPING_RANGE.0) * 10.0).min(DAMPING_RANGE.1);
            report.refused += 1;
        }
        Ok(())
    }

    /// Returns the share of a step at which no node moves farther than the longest step.
    fn shrink(&self, step: &[DVec3]) -> f64 {
        let longest = step.iter().map(|s| s.length()).fold(0.0, f64::max);
        if longest > self.settings.max_step_m { self.settings.max_step_m / longest } else { 1.0 }
    }

    /// Moves the nodes within the limits; `None`, without any change, when the step is not finite.
    fn step(&mut self, step: &[DVec3]) -> Option<()> {
        if !step.iter().all(|s| s.is_finite()) {
            return None;
        }
        let shrink = self.shrink(step);
        let limit = self.settings.max_translation_m;
        for (t, s) in self.translations.iter_mut().zip(step) {
            *t = (*t + *s * shrink).clamp_length_max(limit);
        }
        self.displace();
        Some(())
    }

    /// Sets the translations and the displacements that follow.
    fn restore(&mut self, translations: Vec<DVec3>) {
        self.translations = translations;
        self.displace();
    }

    /// Moves the nodes and returns the loss there. A step or a loss that is not finite is undone, and so is one that the
    /// data term fails at.
    fn try_step<D: DataTerm>(&mut self, step: &[DVec3], data: &mut D) -> Result<f64, D::Error> {
        let old = self.translations.clone();
        if self.step(step).is_none() {
            return Ok(f64::NAN);
        }
        let loss = data.loss(&self.displacement);
        let total = loss.map(|loss| loss + self.prior(None));
        if !matches!(total, Ok(total) if total.is_finite()) {
            self.restore(old);
        }
        total
    }

    /// Computes the displacements of the Gaussians from those of the nodes (Eq. 2).
    fn displace(&mut self) {
        let (rest, translations) = (&self.rest, &self.translations);
        let hung = self.gaussian_nodes.par_iter().zip(&self.gaussian_weights);
        self.displacement.par_iter_mut().zip(hung).with_min_len(4096).for_each(|(out, (nodes, weights))| {
            *out = displacement(rest, translations, *nodes, *weights);
        });
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;

#[cfg(test)]
#[path = "stability_tests.rs"]
mod stability_tests;

//! The deformation from frame to frame.

use flyrig_body::{DeformationGraph, SkinWeights};
use glam::{DMat4, DVec3};

use super::carry::to_canonical;
use super::normal::NormalMatrix;
use super::regularizer::Regularizer;
use super::{DataTerm, DeformSettings, DeformSolver, PointDerivatives};
use crate::{TrackError, TrackErrorKind};

/// Damping never falls below or rises above these shares of the mean diagonal.
const DAMPING_RANGE: (f64, f64) = (1e-3, 1e6);
/// Shares of the predicted fall of the loss above and below which the damping changes after a step.
const GOOD_GAIN: f64 = 0.75;
const POOR_GAIN: f64 = 0.25;
/// Keeps the matrix regular where neither picture nor neighbour says anything, units of loss a square metre.
const LEAST_DAMPING: f64 = 1e-6;

/// What one frame did to the deformation.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DeformReport {
    /// Total loss (Eq. 3) before the first iteration and after each one that was made; of [`DeformSolver::Paper`], which
    /// never looks where it stepped to, before each one.
    pub losses: Vec<f64>,
    /// Steps that were taken.
    pub accepted: usize,
    /// Steps that were refused because the loss did not fall.
    pub refused: usize,
    /// Gaussians left out because a derivative was not finite.
    pub dropped: usize,
    /// The loss was not finite: all is as it was before the frame.
    pub poisoned: bool,
}

/// Translations of the graph's nodes, tracked over time. State that is not finite never comes in: a frame whose loss is
/// not finite leaves everything as it was.
#[derive(Debug)]
pub struct DeformTracker {
    settings: DeformSettings,
    gaussian_nodes: Vec<[u32; 4]>,
    gaussian_weights: Vec<[f32; 4]>,
    skin: Vec<SkinWeights>,
    regularizer: Regularizer,
    matrix: NormalMatrix,
    translations: Vec<DVec3>,
    smooth: Vec<DVec3>,
    displacement: Vec<[f32; 4]>,
    derivatives: PointDerivatives,
    damping: f64,
    frame: u64,
}

impl DeformTracker {
    /// At rest. `skin` holds the weights of the Gaussians that `graph` was built for.
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
        let edges: Vec<(u32, u32)> = (0u32..)
            .zip(&graph.neighbors)
            .flat_map(|(node, others)| others.iter().filter(move |&&other| other != node).map(move |&o| (node, o)))
            .collect();
        let matrix = NormalMatrix::new(nodes, &graph.gaussian_nodes, &graph.gaussian_weights, &edges);
        let regularizer = Regularizer {
            edges,
            spatial: settings.regularization * settings.spatial,
            temporal: settings.regularization * settings.temporal,
        };
        Ok(Self {
            damping: settings.damping,
            settings,
            gaussian_nodes: graph.gaussian_nodes.clone(),
            gaussian_weights: graph.gaussian_weights.clone(),
            skin: skin.to_vec(),
            regularizer,
            matrix,
            translations: vec![DVec3::ZERO; nodes],
            smooth: vec![DVec3::ZERO; nodes],
            displacement: vec![[0.0; 4]; count],
            derivatives: PointDerivatives::default(),
            frame: 0,
        })
    }

    /// Back to rest: the next frame counts as the first.
    pub fn reset(&mut self) {
        self.translations.fill(DVec3::ZERO);
        self.smooth.fill(DVec3::ZERO);
        self.displacement.fill([0.0; 4]);
        self.damping = self.settings.damping;
        self.frame = 0;
    }

    /// Canonical translations of the nodes, metres.
    #[must_use]
    pub fn translations(&self) -> &[DVec3] {
        &self.translations
    }

    /// Canonical displacements t_x of the Gaussians (Eq. 2), metres; w is 0.
    #[must_use]
    pub fn displacement(&self) -> &[[f32; 4]] {
        &self.displacement
    }

    /// Takes in one frame, starting from the last one's translations. `world_from_canonical` holds the bone matrices
    /// of this frame's pose.
    ///
    /// # Errors
    /// The data term's; the state is then that of the last accepted step.
    pub fn track<D: DataTerm>(
        &mut self,
        world_from_canonical: &[DMat4],
        data: &mut D,
    ) -> Result<DeformReport, D::Error> {
        let mut report = DeformReport::default();
        let start = self.translations.clone();
        for _ in 0..self.settings.iterations(self.frame) {
            let mut gradient = vec![DVec3::ZERO; self.translations.len()];
            let mut derivatives = std::mem::take(&mut self.derivatives);
            let data_loss = data.derivatives(&self.displacement, &mut derivatives);
            self.derivatives = derivatives;
            let loss = data_loss? + self.regularizer.loss(&self.translations, &self.smooth, Some(&mut gradient));
            if !loss.is_finite() {
                report.poisoned = true;
                self.translations = start;
                self.displace();
                return Ok(report);
            }
            // Gauss-Newton has told the loss after its step already.
            if report.losses.len() == report.accepted {
                report.losses.push(loss);
            }
            report.dropped += self.gather(world_from_canonical, &mut gradient);
            let before = report.accepted;
            match self.settings.solver {
                DeformSolver::Paper { rate } => {
                    let step = gradient.iter().map(|g| *g * -rate).collect();
                    if self.step(step).is_some() {
                        report.accepted += 1;
                    }
                }
                DeformSolver::GaussNewton { .. } => self.step_downhill(&gradient, loss, data, &mut report)?,
            }
            if report.accepted == before {
                break;
            }
        }
        let share = self.settings.smoothing;
        for (smooth, t) in self.smooth.iter_mut().zip(&self.translations) {
            *smooth += (*t - *smooth) * share;
        }
        self.frame += 1;
        Ok(report)
    }

    /// Adds the data's gradient and makes its matrix; the number of Gaussians left out.
    fn gather(&mut self, world_from_canonical: &[DMat4], gradient: &mut [DVec3]) -> usize {
        let (carried, dropped) = to_canonical(&self.derivatives, world_from_canonical, &self.skin);
        let with_matrix = matches!(self.settings.solver, DeformSolver::GaussNewton { .. });
        self.matrix.clear();
        for one in carried {
            let (nodes, weights) = (self.gaussian_nodes[one.gaussian], self.gaussian_weights[one.gaussian]);
            for (&node, weight) in nodes.iter().zip(weights) {
                gradient[node as usize] += one.gradient * f64::from(weight);
            }
            if with_matrix {
                self.matrix.add_gaussian(one.gaussian, nodes, weights, one.matrix);
            }
        }
        dropped
    }

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
            let damping = self.damping * self.matrix.mean_diagonal() + LEAST_DAMPING;
            let step = self.matrix.solve(self.regularizer.stiffness(), damping, &right);
            // Of the quadratic model, which the step s solves: (A + damping) s = -g.
            let share = self.shrink(&step);
            let along: f64 = right.iter().zip(&step).map(|(r, s)| r.dot(*s)).sum();
            let squared: f64 = step.iter().map(|s| s.length_squared()).sum();
            let predicted = share * along - 0.5 * share * share * (along - damping * squared);
            let (translations, displacement) = (self.translations.clone(), self.displacement.clone());
            let new = self.try_step(step, data)?;
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
            (self.translations, self.displacement) = (translations, displacement);
            self.damping = (self.damping.max(DAMPING_RANGE.0) * 10.0).min(DAMPING_RANGE.1);
            report.refused += 1;
        }
        Ok(())
    }

    /// The share of a step that keeps every node within the longest one.
    fn shrink(&self, step: &[DVec3]) -> f64 {
        let longest = step.iter().map(|s| s.length()).fold(0.0, f64::max);
        if longest > self.settings.max_step_m { self.settings.max_step_m / longest } else { 1.0 }
    }

    /// Moves the nodes, within the limits, and returns where they were; none, and nothing done, when the step is not
    /// finite.
    fn step(&mut self, step: Vec<DVec3>) -> Option<Vec<DVec3>> {
        if !step.iter().all(|s| s.is_finite()) {
            return None;
        }
        let shrink = self.shrink(&step);
        let limit = self.settings.max_translation_m;
        let moved: Vec<DVec3> =
            self.translations.iter().zip(step).map(|(t, s)| (*t + s * shrink).clamp_length_max(limit)).collect();
        let old = std::mem::replace(&mut self.translations, moved);
        self.displace();
        Some(old)
    }

    /// Moves the nodes and tells the loss there. A step or a loss that is not finite is undone, and so is one that the
    /// data term fails at.
    fn try_step<D: DataTerm>(&mut self, step: Vec<DVec3>, data: &mut D) -> Result<f64, D::Error> {
        let Some(old) = self.step(step) else { return Ok(f64::NAN) };
        let loss = data.loss(&self.displacement);
        let total = loss.map(|loss| loss + self.regularizer.loss(&self.translations, &self.smooth, None));
        if !matches!(total, Ok(total) if total.is_finite()) {
            self.translations = old;
            self.displace();
        }
        total
    }

    /// Eq. 2.
    fn displace(&mut self) {
        for ((out, nodes), weights) in
            self.displacement.iter_mut().zip(&self.gaussian_nodes).zip(&self.gaussian_weights)
        {
            let mut sum = DVec3::ZERO;
            for (&node, &weight) in nodes.iter().zip(weights) {
                sum += self.translations[node as usize] * f64::from(weight);
            }
            *out = sum.as_vec3().extend(0.0).to_array();
        }
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;

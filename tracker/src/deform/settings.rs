//! Settings of the deformation solver.

/// Method by which derivatives become a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DeformSolver {
    /// Plain gradient descent as in FlyHuman section 3.1: 10 iterations for the first 10 frames, then 2.
    Paper {
        /// Ratio of step to gradient, square metres per unit of loss. The paper gives no value.
        rate: f64,
    },
    /// Damped Gauss-Newton with the graph Laplacian.
    GaussNewton {
        /// Iterations per frame set for the first 10.
        first_iterations: usize,
        /// Iterations per frame set after them.
        iterations: usize,
    },
}

/// Weights and limits of the solver. In another unit of length, with every number that has metres in its unit converted,
/// the solution is the same.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeformSettings {
    /// Method of a step.
    pub solver: DeformSolver,
    /// λ_reg of Eq. 3. The paper's is 200; with a second-order step more of it gives the truer surface.
    pub regularization: f64,
    /// λ_spat of Eq. 4. The paper's 1.
    pub spatial: f64,
    /// λ_temp of Eq. 4. The paper's 2.
    pub temporal: f64,
    /// Weight of a node's squared distance from the place of its pose, units of loss per square metre. With 0, a common
    /// shift of all nodes costs nothing, and a free pose has nothing to gain.
    pub anchor: f64,
    /// Share of this frame set's translation in the smoothed one of Eq. 4, 0..=1. The paper gives no value.
    pub smoothing: f64,
    /// Initial Levenberg damping, as a share of the mean diagonal of the data's matrix.
    pub damping: f64,
    /// Largest motion of a node in one step, metres; a longer step is shortened as a whole.
    pub max_step_m: f64,
    /// Largest distance of a node from the place of its pose, metres.
    pub max_translation_m: f64,
    /// Plausible range of the thickness of clothes where no camera looks, metres; negative for a body thinner than its
    /// template.
    pub thickness_m: [f64; 2],
    /// Attempts with growing damping before an iteration gives up.
    pub attempts: usize,
    /// Share of the loss at which iterations stop: after a frame set that lowered its loss by less, frame sets whose loss
    /// is at most this share above get no iteration; with 0 every frame set gets its iterations.
    pub rest: f64,
}

impl Default for DeformSettings {
    fn default() -> Self {
        Self {
            solver: DeformSolver::GaussNewton { first_iterations: 4, iterations: 1 },
            regularization: 2000.0,
            spatial: 1.0,
            temporal: 2.0,
            anchor: 0.0,
            smoothing: 0.5,
            damping: 0.03,
            max_step_m: 0.02,
            max_translation_m: 0.25,
            thickness_m: [-0.02, 0.06],
            attempts: 3,
            rest: 0.01,
        }
    }
}

/// Number of frame sets that get the first iterations (FlyHuman section 4.1).
pub const FIRST_FRAMES: u64 = 10;

impl DeformSettings {
    /// Returns the iterations of frame set number `frame` since the last reset.
    pub(super) fn iterations(&self, frame: u64) -> usize {
        let first = frame < FIRST_FRAMES;
        match self.solver {
            DeformSolver::Paper { .. } => {
                if first {
                    10
                } else {
                    2
                }
            }
            DeformSolver::GaussNewton { first_iterations, iterations } => {
                if first {
                    first_iterations
                } else {
                    iterations
                }
            }
        }
    }

    /// Returns the fault of unusable settings.
    pub(super) fn fault(&self) -> Option<&'static str> {
        let weight = |v: f64| v.is_finite() && v >= 0.0;
        let length = |v: f64| v.is_finite() && v > 0.0;
        let DeformSolver::Paper { rate } = self.solver else {
            return self.fault_without_solver(weight, length);
        };
        if length(rate) { self.fault_without_solver(weight, length) } else { Some("the rate must be above 0") }
    }

    /// Returns the fault of all settings but the solver's.
    fn fault_without_solver(&self, weight: fn(f64) -> bool, length: fn(f64) -> bool) -> Option<&'static str> {
        if ![self.regularization, self.spatial, self.temporal, self.anchor, self.damping].into_iter().all(weight) {
            Some("weights and damping must be finite and not negative")
        } else if !(0.0..1.0).contains(&self.rest) {
            Some("the rest share must lie in 0 to 1, 1 excluded")
        } else if !(0.0..=1.0).contains(&self.smoothing) {
            Some("smoothing must lie in 0 to 1")
        } else if !length(self.max_step_m) || !length(self.max_translation_m) {
            Some("the longest step and translation must be above 0")
        } else if !(self.thickness_m[0] <= self.thickness_m[1] && self.thickness_m.iter().all(|v| v.is_finite())) {
            Some("the clothes' thinnest and thickest must be finite and in this order")
        } else {
            None
        }
    }
}

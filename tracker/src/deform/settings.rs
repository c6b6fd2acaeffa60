//! How the deformation is solved.

/// How a step is made from the derivatives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DeformSolver {
    /// Plain gradient descent as in FlyHuman section 3.1: 10 iterations for the first 10 frames, then 2.
    Paper {
        /// Length of a step over the gradient, square metres a unit of loss. The paper gives no value.
        rate: f64,
    },
    /// Damped Gauss-Newton with the graph Laplacian.
    GaussNewton {
        /// Iterations of the first 10 frames.
        first_iterations: usize,
        /// Iterations a frame after them.
        iterations: usize,
    },
}

/// Weights and limits. In another unit of length everything here that has metres in its unit must be given in that one,
/// and the solution is the same.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeformSettings {
    /// How to step.
    pub solver: DeformSolver,
    /// λ_reg of Eq. 3. The paper's is 200; with a second-order step more of it gives the truer surface.
    pub regularization: f64,
    /// λ_spat of Eq. 4. The paper's 1.
    pub spatial: f64,
    /// λ_temp of Eq. 4. The paper's 2.
    pub temporal: f64,
    /// Price of a node's distance from where its pose puts it, units of loss a square metre. Without, a shift of all nodes
    /// together costs nothing, and a free pose has nothing to win.
    pub anchor: f64,
    /// Share of this frame's translation in the smoothed one of Eq. 4, 0..=1. The paper gives no value.
    pub smoothing: f64,
    /// Levenberg damping to begin with, as a share of the mean diagonal of the data's matrix.
    pub damping: f64,
    /// A node moves no farther than this in one step, metres; a longer step is shortened as a whole.
    pub max_step_m: f64,
    /// No node is farther than this from where its pose puts it, metres.
    pub max_translation_m: f64,
    /// Thinnest (a body thinner than its template) and thickest clothes that are believed where nobody looks, metres.
    pub thickness_m: [f64; 2],
    /// Attempts with growing damping before an iteration gives up.
    pub attempts: usize,
    /// After a frame that lowered its loss by less than this share, frames whose loss is no more than this share above get
    /// no iteration; 0: every frame gets its iterations.
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

/// Frames that get the first iterations (FlyHuman section 4.1).
pub const FIRST_FRAMES: u64 = 10;

impl DeformSettings {
    /// Iterations of frame number `frame` since the last reset.
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

    /// What is wrong with the numbers.
    pub(super) fn fault(&self) -> Option<&'static str> {
        let weight = |v: f64| v.is_finite() && v >= 0.0;
        let length = |v: f64| v.is_finite() && v > 0.0;
        let DeformSolver::Paper { rate } = self.solver else {
            return self.fault_without_solver(weight, length);
        };
        if length(rate) { self.fault_without_solver(weight, length) } else { Some("the rate must be above 0") }
    }

    fn fault_without_solver(&self, weight: fn(f64) -> bool, length: fn(f64) -> bool) -> Option<&'static str> {
        if ![self.regularization, self.spatial, self.temporal, self.anchor, self.damping].into_iter().all(weight) {
            Some("weights and damping must be finite and not negative")
        } else if !(0.0..1.0).contains(&self.rest) {
            Some("the share at which there is rest must lie in 0 to 1, 1 excluded")
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

//! Rounds of bundle adjustment, in which noise, board velocities and outlier views are estimated in turn with the
//! unknowns.

use flyrig_solve::{Convergence, RigidMotion, block_covariance, log_rotation, median, minimize_blocks};
use glam::{DVec2, DVec3};
use nalgebra::DMatrix;

use crate::bundle::{BoardMotion, BoardShot, Bundle, Estimate, Free, seconds};

/// Rounds of estimating noise and velocities.
const ROUNDS: usize = 4;
/// Standard deviation of a corner's coordinate over the median distance of a two-dimensional normal error.
const SIGMA_PER_MEDIAN: f64 = 1.0 / 1.177;
/// Range of a corner's standard deviation, pixels.
const SIGMA_PX: (f64, f64) = (0.02, 20.0);
/// Longest gap between shots from which a board's velocity is estimated, seconds.
const LONGEST_GAP_S: f64 = 0.5;

/// Result of [`adjust`].
pub(crate) struct Adjusted {
    pub estimate: Estimate,
    /// Standard deviation of a corner's coordinate, pixels.
    pub sigma_px: f64,
    /// Reprojection error of each corner (projected minus observed), pixels, per shot, view and corner.
    pub off_px: Vec<Vec<Vec<DVec2>>>,
    /// Covariance of the free unknowns except the boards, in block order; `None` where the views leave some
    /// undetermined.
    pub covariance: Option<DMatrix<f64>>,
}

/// Minimises the reprojection errors from a start.
pub(crate) fn adjust(points: &[DVec3], shots: &[BoardShot], start: Estimate, free: Free) -> Option<Adjusted> {
    let cameras = start.cameras.len();
    let mut estimate = start;
    let mut sigma_px = 1.0;
    let mut motions = vec![BoardMotion::default(); shots.len()];
    for round in 0..ROUNDS {
        // Offsets need velocities, and those need places.
        let free = Free { lags: free.lags && round > 0, ..free };
        if free.lags {
            motions = board_motions(shots, &estimate.boards);
        }
        let bundle = Bundle::new(points, shots, &motions, cameras, free, sigma_px);
        let options = Convergence {
            max_steps: if round + 1 < ROUNDS { 20 } else { 60 },
            min_gain: 1e-9,
            ..Convergence::default()
        };
        estimate = minimize_blocks(&bundle, &estimate, &options).ok()?.unknowns;
        let off = off_px(&bundle, shots, &estimate)?;
        // A board that one camera saw fits whatever the cameras' poses are.
        let is_shared = |off: &&Vec<Vec<DVec2>>| cameras == 1 || off.len() > 1;
        let mut errors: Vec<f64> = off.iter().filter(is_shared).flatten().flatten().map(|off| off.length()).collect();
        sigma_px = (SIGMA_PER_MEDIAN * median(&mut errors)?).clamp(SIGMA_PX.0, SIGMA_PX.1);
    }
    let bundle = Bundle::new(points, shots, &motions, cameras, free, sigma_px);
    let off_px = off_px(&bundle, shots, &estimate)?;
    let covariance = block_covariance(&bundle, &estimate);
    Some(Adjusted { covariance, off_px, estimate, sigma_px })
}

impl Adjusted {
    /// Iterates over the reprojection errors, pixels.
    pub fn errors_px(&self) -> impl Iterator<Item = f64> {
        self.off_px.iter().flatten().flatten().map(|off| off.length())
    }
}

fn off_px(bundle: &Bundle<'_>, shots: &[BoardShot], at: &Estimate) -> Option<Vec<Vec<Vec<DVec2>>>> {
    let of_shot = |(index, shot): (usize, &BoardShot)| {
        let of_view = |view| {
            let shot: &crate::BoardView = view;
            shot.corners.iter().map(|corner| bundle.error_px(at, index, shot, corner)).collect()
        };
        shot.views.iter().map(of_view).collect()
    };
    shots.iter().enumerate().map(of_shot).collect()
}

/// Estimates the boards' velocities from the previous and the next shot. Accelerations were tried and followed the
/// noise.
fn board_motions(shots: &[BoardShot], boards: &[RigidMotion]) -> Vec<BoardMotion> {
    let between = |a: usize, b: usize| {
        let secs = seconds(shots[b].nanos, shots[a].nanos);
        let near = secs > 0.0 && secs < LONGEST_GAP_S;
        near.then(|| {
            let turn = log_rotation(boards[b].rotation * boards[a].rotation.inverse()) / secs;
            (BoardMotion { turn, shift: (boards[b].translation - boards[a].translation) / secs }, secs)
        })
    };
    (0..shots.len())
        .map(|i| {
            let before = i.checked_sub(1).and_then(|before| between(before, i));
            let after = (i + 1 < shots.len()).then(|| between(i, i + 1)).flatten();
            match (before, after) {
                (Some((a, sa)), Some((b, sb))) => {
                    // The nearer shot says more about this moment.
                    let (wa, wb) = (sb / (sa + sb), sa / (sa + sb));
                    BoardMotion { turn: a.turn * wa + b.turn * wb, shift: a.shift * wa + b.shift * wb }
                }
                (Some((one, _)), None) | (None, Some((one, _))) => one,
                (None, None) => BoardMotion::default(),
            }
        })
        .collect()
}

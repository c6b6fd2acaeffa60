//! Bundle adjustment of cameras, lenses, time offsets and boards: a least squares problem with analytic derivatives,
//! from which the boards are eliminated.

use flyrig_solve::{BlockProblem, Kernel, Residual, RigidMotion};
use flyrig_types::Intrinsics;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};

use crate::detect::SeenCorner;
use crate::projection::{LensModel, project, project_with_derivatives};

/// Robust kernel, which reduces the weight of corners beyond 3 standard deviations.
const KERNEL: Kernel = Kernel::Cauchy(3.0);

/// Board in the image of one camera.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardView {
    /// Slot of the camera.
    pub camera: usize,
    /// Timestamp of the image, nanoseconds.
    pub nanos: i64,
    /// Detected corners.
    pub corners: Vec<SeenCorner>,
}

/// Board that several cameras saw at about the same time.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardShot {
    /// Time of the shot, nanoseconds.
    pub nanos: i64,
    /// Views, at most one per camera.
    pub views: Vec<BoardView>,
}

/// Camera of an estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SolvedCamera {
    pub camera_from_rig: RigidMotion,
    pub intrinsics: Intrinsics,
    /// Time offset, subtracted from the camera's timestamps, seconds.
    pub lag_s: f64,
}

/// All unknowns. The rig's axes are those of its first camera.
#[derive(Debug, Clone)]
pub(crate) struct Estimate {
    pub cameras: Vec<SolvedCamera>,
    /// `rig_from_board` per shot.
    pub boards: Vec<RigidMotion>,
    /// Coefficients of the bend: times [`bend_shares`] they give the depth of the surface behind the board's plane,
    /// metres.
    pub bend_m: [f64; 3],
}

/// Returns u², u v and v² of each corner, where (u, v) is its position from the centre of all, relative to half their
/// diagonal.
pub(crate) fn bend_shares(points: &[DVec3]) -> Vec<[f64; 3]> {
    let (least, most) = points.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(a, b), p| (a.min(*p), b.max(*p)));
    let (middle, reach) = (0.5 * (least + most), 0.5 * least.distance(most));
    let share = |point: &DVec3| {
        let from = (*point - middle) / reach;
        [from.x * from.x, from.x * from.y, from.y * from.y]
    };
    points.iter().map(share).collect()
}

/// Velocity of a board during a shot.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct BoardMotion {
    /// Rotation vector per second.
    pub turn: DVec3,
    /// Metres per second.
    pub shift: DVec3,
}

/// Selection of the unknowns that are free besides the poses of cameras and boards.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Free {
    pub lens: Option<LensModel>,
    pub lags: bool,
    pub bend: bool,
}

/// The least squares problem.
pub(crate) struct Bundle<'a> {
    points: &'a [DVec3],
    bend_shares: Vec<[f64; 3]>,
    shots: &'a [BoardShot],
    motions: &'a [BoardMotion],
    free: Free,
    /// Standard deviation of a corner, pixels.
    sigma_px: f64,
    /// Shot, view and corner of each residual.
    seen: Vec<(usize, usize, usize)>,
    cameras: usize,
    sizes: Vec<usize>,
    first_eliminated: usize,
}

impl<'a> Bundle<'a> {
    /// Creates the problem from the board's corners and one velocity per shot.
    pub fn new(
        points: &'a [DVec3],
        shots: &'a [BoardShot],
        motions: &'a [BoardMotion],
        cameras: usize,
        free: Free,
        sigma_px: f64,
    ) -> Self {
        let of_view =
            |shot: usize, view: usize| (0..shots[shot].views[view].corners.len()).map(move |k| (shot, view, k));
        let of_shot = |shot: usize| (0..shots[shot].views.len()).flat_map(move |view| of_view(shot, view));
        let seen = (0..shots.len()).flat_map(of_shot).collect();
        // Poses of all cameras but the first, whose axes are the rig's; lenses; offsets of all but the first; the bend; boards.
        let others = cameras.saturating_sub(1);
        let mut sizes = vec![6; others];
        if let Some(model) = free.lens {
            sizes.extend(vec![model.parameters(); cameras]);
        }
        if free.lags {
            sizes.extend(vec![1; others]);
        }
        if free.bend {
            sizes.push(3);
        }
        let first_eliminated = sizes.len();
        sizes.extend(vec![6; shots.len()]);
        Self {
            points,
            bend_shares: bend_shares(points),
            shots,
            motions,
            free,
            sigma_px,
            seen,
            cameras,
            sizes,
            first_eliminated,
        }
    }

    fn lens_block(&self, camera: usize) -> Option<usize> {
        self.free.lens.map(|_| self.cameras - 1 + camera)
    }

    fn lag_block(&self, camera: usize) -> Option<usize> {
        let lenses = if self.free.lens.is_some() { self.cameras } else { 0 };
        (self.free.lags && camera > 0).then(|| self.cameras - 1 + lenses + camera - 1)
    }

    /// Returns a corner on the bent board in board axes, metres.
    fn bent(&self, at: &Estimate, corner: &SeenCorner) -> Option<DVec3> {
        let (point, shares) = (self.points.get(corner.index)?, self.bend_shares.get(corner.index)?);
        Some(*point + DVec3::Z * at.bend_m.iter().zip(shares).map(|(bend, share)| bend * share).sum::<f64>())
    }

    /// Returns the pose of a shot's board at the time of a view.
    fn board_at(&self, at: &Estimate, shot: usize, view: &BoardView) -> RigidMotion {
        let motion = &self.motions[shot];
        let secs = seconds(view.nanos, self.shots[shot].nanos) - at.cameras[view.camera].lag_s;
        at.boards[shot].moved(motion.turn * secs, motion.shift * secs)
    }

    /// Returns the reprojection error of a corner (projected minus observed), pixels; `None` where it cannot be
    /// projected.
    pub fn error_px(&self, at: &Estimate, shot: usize, view: &BoardView, corner: &SeenCorner) -> Option<DVec2> {
        let camera = &at.cameras[view.camera];
        let place = self.board_at(at, shot, view).apply(self.bent(at, corner)?);
        Some(project(&camera.intrinsics, camera.camera_from_rig.apply(place))? - corner.pixel)
    }
}

/// Returns the seconds from one time to another.
pub(crate) fn seconds(nanos: i64, from: i64) -> f64 {
    nanos.saturating_sub(from) as f64 * 1e-9
}

impl BlockProblem for Bundle<'_> {
    type Unknowns = Estimate;

    fn block_sizes(&self) -> &[usize] {
        &self.sizes
    }

    fn first_eliminated(&self) -> usize {
        self.first_eliminated
    }

    fn residual_count(&self) -> usize {
        self.seen.len()
    }

    fn residual(&self, at: &Estimate, index: usize, with_jacobians: bool) -> Option<Residual> {
        let (shot, view, corner) = self.seen[index];
        let view = &self.shots[shot].views[view];
        let corner = &view.corners[corner];
        let inverse = 1.0 / self.sigma_px;
        let residual = |error: DVec2, jacobians| Residual {
            error: DVector::from_column_slice(&(error * inverse).to_array()),
            jacobians,
            kernel: KERNEL,
            weight: 1.0,
        };
        if !with_jacobians {
            return Some(residual(self.error_px(at, shot, view, corner)?, Vec::new()));
        }
        let camera = &at.cameras[view.camera];
        let board = self.board_at(at, shot, view);
        let point = self.bent(at, corner)?;
        let place = board.apply(point);
        let model = self.free.lens.unwrap_or(LensModel::Radial1);
        let local = camera.camera_from_rig.apply(place);
        let projected = project_with_derivatives(&camera.intrinsics, model, local)?;
        let by_local = DMatrix::from_fn(2, 3, |row, column| inverse * projected.by_point[column][row]);
        let [by_turn, by_shift, by_place] = camera.camera_from_rig.apply_jacobian(place);
        let by_place = &by_local * matrix(by_place);
        let mut jacobians = Vec::with_capacity(5);
        if view.camera > 0 {
            jacobians.push((view.camera - 1, beside(&(&by_local * matrix(by_turn)), &(&by_local * matrix(by_shift)))));
        }
        if let Some(block) = self.lens_block(view.camera) {
            let by_lens = &projected.by_lens;
            jacobians.push((block, DMatrix::from_fn(2, by_lens.len(), |row, column| inverse * by_lens[column][row])));
        }
        if let Some(block) = self.lag_block(view.camera) {
            let motion = &self.motions[shot];
            let velocity = motion.turn.cross(board.rotation * point) + motion.shift;
            jacobians.push((block, -(&by_place * DMatrix::from_column_slice(3, 1, &velocity.to_array()))));
        }
        if self.free.bend {
            let by_depth = &by_place * DMatrix::from_column_slice(3, 1, &(board.rotation * DVec3::Z).to_array());
            let shares = DMatrix::from_row_slice(1, 3, &self.bend_shares[corner.index]);
            jacobians.push((self.first_eliminated - 1, by_depth * shares));
        }
        // The board's step comes before its movement during the shot, which is small: the same to first order.
        let [by_turn, by_shift, _] = board.apply_jacobian(point);
        let by_board = beside(&(&by_place * matrix(by_turn)), &(&by_place * matrix(by_shift)));
        jacobians.push((self.first_eliminated + shot, by_board));
        Some(residual(projected.pixel - corner.pixel, jacobians))
    }

    fn moved(&self, at: &Estimate, step: &[f64]) -> Estimate {
        let mut at = at.clone();
        let mut rest = step;
        let mut take = |count: usize| {
            let (now, later) = rest.split_at(count);
            rest = later;
            now
        };
        for camera in at.cameras.iter_mut().skip(1) {
            camera.camera_from_rig = moved(&camera.camera_from_rig, take(6));
        }
        if let Some(model) = self.free.lens {
            for camera in &mut at.cameras {
                camera.intrinsics = LensModel::moved(&camera.intrinsics, take(model.parameters()));
            }
        }
        if self.free.lags {
            for camera in at.cameras.iter_mut().skip(1) {
                camera.lag_s += take(1)[0];
            }
        }
        if self.free.bend {
            for (bend, step) in at.bend_m.iter_mut().zip(take(3)) {
                *bend += step;
            }
        }
        for board in &mut at.boards {
            *board = moved(board, take(6));
        }
        at
    }
}

fn moved(motion: &RigidMotion, step: &[f64]) -> RigidMotion {
    motion.moved(DVec3::new(step[0], step[1], step[2]), DVec3::new(step[3], step[4], step[5]))
}

fn matrix(m: DMat3) -> DMatrix<f64> {
    DMatrix::from_column_slice(3, 3, &m.to_cols_array())
}

fn beside(left: &DMatrix<f64>, right: &DMatrix<f64>) -> DMatrix<f64> {
    let mut both = DMatrix::zeros(left.nrows(), left.ncols() + right.ncols());
    both.columns_mut(0, left.ncols()).copy_from(left);
    both.columns_mut(left.ncols(), right.ncols()).copy_from(right);
    both
}

#[cfg(test)]
mod tests {
    use flyrig_solve::jacobian_error;

    use super::*;
    use crate::board::Board;
    use crate::testing::{Random, bent_shots, ring};

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let (mut random, board) = (Random(4), Board::default());
        let cameras = ring(&mut random, 3);
        let points: Vec<DVec3> = (0..board.corner_count()).map(|index| board.corner(index)).collect();
        let mut shots = bent_shots(&mut random, (&board, 0.003), &cameras, 3, 0.5);
        for (i, view) in shots.iter_mut().flat_map(|shot| &mut shot.views).enumerate() {
            view.nanos += 1_000_000 * i as i64;
        }
        // Without a turn: with one, the board's step is taken before its movement during the shot, to first order alone.
        let motions: Vec<BoardMotion> =
            shots.iter().map(|_| BoardMotion { turn: DVec3::ZERO, shift: random.vector() * 0.2 }).collect();
        // Somewhere before all cameras.
        let of = |camera: &flyrig_types::Camera| SolvedCamera {
            camera_from_rig: RigidMotion {
                rotation: camera.camera_from_world.rotation,
                translation: camera.camera_from_world.translation,
            },
            intrinsics: camera.intrinsics,
            lag_s: 0.003,
        };
        let middle = RigidMotion { rotation: Default::default(), translation: DVec3::Z * 0.8 };
        let at = Estimate {
            cameras: cameras.iter().map(of).collect(),
            boards: vec![middle; shots.len()],
            bend_m: [0.002, -0.001, 0.003],
        };
        for lens in [None, Some(LensModel::RadialTangential)] {
            let free = Free { lens, lags: true, bend: true };
            let bundle = Bundle::new(&points, &shots, &motions, cameras.len(), free, 0.7);
            for index in 0..bundle.residual_count() {
                let error = jacobian_error(&bundle, &at, index, 1e-6).unwrap();
                assert!(error < 1e-5, "residual {index}: {error}");
            }
        }
    }
}

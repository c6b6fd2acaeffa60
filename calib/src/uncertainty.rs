//! Propagation of the covariance of a camera's pose to pixels across its image, and to millimetres in the centre of the
//! boards.

use flyrig_solve::RigidMotion;
use flyrig_types::Intrinsics;
use glam::{DVec2, DVec3};
use nalgebra::SMatrix;

use crate::projection::{LensModel, project_with_derivatives};

/// Grid of positions along the width and the height of an image.
const GRID: [usize; 2] = [9, 7];

/// Standard deviations of a camera's projections from the covariance of its pose relative to the first camera.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Uncertainty {
    /// Pixels across the image, with the standard deviation there of points at the boards' distance; pixels.
    pub image_px: Vec<(DVec2, f64)>,
    /// Standard deviation of the position of a point in the centre of the boards, camera axes; millimetres.
    pub middle_mm: f64,
}

impl Uncertainty {
    /// Propagates the covariance of a step (rotation vector, then shift) that is applied to a camera's pose on the left
    /// ([`RigidMotion::moved`]); `middle` is a point in the axes that the pose maps from.
    pub(crate) fn new(
        covariance: &SMatrix<f64, 6, 6>,
        camera_from_rig: &RigidMotion,
        intrinsics: &Intrinsics,
        middle: DVec3,
    ) -> Self {
        let seen = camera_from_rig.apply(middle);
        let [width, height] = [intrinsics.width, intrinsics.height].map(f64::from);
        let places = (0..GRID[0] * GRID[1]).map(|at| {
            let share = |k: usize, of: usize| k as f64 / (of - 1) as f64;
            let (x, y) = (share(at % GRID[0], GRID[0]), share(at / GRID[0], GRID[1]));
            DVec2::new(x * (width - 1.0), y * (height - 1.0))
        });
        let image_px = places.filter_map(|pixel| {
            let ideal = intrinsics.lens.undistort((pixel - intrinsics.center_px) / intrinsics.focal_px)?;
            let point = ideal.extend(1.0) * seen.z.abs();
            let by_point = project_with_derivatives(intrinsics, LensModel::Radial1, point)?.by_point;
            let by_step = by_point_of_step(camera_from_rig, point);
            let by_point = SMatrix::<f64, 2, 3>::from_fn(|row, column| by_point[column][row]);
            Some((pixel, deviation(&(by_point * by_step), covariance)))
        });
        Self {
            image_px: image_px.collect(),
            middle_mm: 1e3 * deviation(&by_point_of_step(camera_from_rig, seen), covariance),
        }
    }

    /// Returns the largest deviation in the image, pixels; 0 without any.
    #[must_use]
    pub fn worst_px(&self) -> f64 {
        self.image_px.iter().map(|(_, px)| *px).fold(0.0, f64::max)
    }
}

/// Returns the derivative of a point in camera axes by the step: `exp(turn) (point - t) + t + shift`.
fn by_point_of_step(camera_from_rig: &RigidMotion, point: DVec3) -> SMatrix<f64, 3, 6> {
    let by_turn = -flyrig_solve::skew(point - camera_from_rig.translation);
    let by_turn = by_turn.to_cols_array();
    SMatrix::from_fn(|row, column| match column {
        0..3 => by_turn[3 * column + row],
        _ => f64::from(u8::from(column - 3 == row)),
    })
}

/// Returns the standard deviations of a camera's orientation, degrees, and position, millimetres, from the covariance
/// of a step that is applied to its pose on the left.
pub(crate) fn pose_deviation(block: &SMatrix<f64, 6, 6>, pose: &RigidMotion) -> (f64, f64) {
    let turn = (block[(0, 0)] + block[(1, 1)] + block[(2, 2)]).max(0.0).sqrt().to_degrees();
    // place = -Rᵀ t; lengths do not change with Rᵀ. After exp(δ) R and t + s: t + s + t × δ.
    let mut by_step = SMatrix::<f64, 3, 6>::zeros();
    let cross = flyrig_solve::skew(pose.translation).to_cols_array();
    by_step.view_mut((0, 0), (3, 3)).copy_from_slice(&cross);
    by_step.view_mut((0, 3), (3, 3)).copy_from(&SMatrix::<f64, 3, 3>::identity());
    let place = by_step * block * by_step.transpose();
    (turn, 1e3 * place.trace().max(0.0).sqrt())
}

/// Returns the root of the trace of `J C Jᵀ`.
fn deviation<const N: usize>(by_step: &SMatrix<f64, N, 6>, covariance: &SMatrix<f64, 6, 6>) -> f64 {
    (by_step * covariance * by_step.transpose()).trace().max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use flyrig_types::Lens;
    use glam::DQuat;

    use super::*;
    use crate::projection::project;

    /// Returns the squared motion of `f`, summed over the columns of a root of the covariance, by finite differences.
    fn reference(root: &SMatrix<f64, 6, 6>, f: impl Fn(DVec3, DVec3) -> DVec3) -> f64 {
        let column = |k: usize| {
            let step = |sign: f64| {
                let c = root.column(k) * (sign * 1e-5);
                f(DVec3::new(c[0], c[1], c[2]), DVec3::new(c[3], c[4], c[5]))
            };
            ((step(1.0) - step(-1.0)) / 2e-5).length_squared()
        };
        (0..6).map(column).sum::<f64>().sqrt()
    }

    #[test]
    fn deviations_are_those_of_finite_differences() {
        let mut state = 5u64;
        let mut number = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1u32 << 30) - 1.0
        };
        for lens in [Lens::PINHOLE, Lens::Fisheye { coefficients: [0.02, -0.01, 0.004, -0.001] }] {
            let intrinsics = Intrinsics {
                width: 640,
                height: 480,
                focal_px: DVec2::new(410.0, 405.0),
                center_px: DVec2::new(322.0, 236.0),
                lens,
            };
            let root = SMatrix::<f64, 6, 6>::from_fn(|_, _| 0.01 * number());
            let rotation = DQuat::from_euler(glam::EulerRot::XYZ, number(), number(), number());
            let pose = RigidMotion { rotation, translation: DVec3::new(0.3, -0.2, 3.0) };
            let middle = DVec3::new(0.1, 0.2, -0.1);
            let found = Uncertainty::new(&(root * root.transpose()), &pose, &intrinsics, middle);
            let moved = |turn, shift| pose.moved(turn, shift).apply(middle);
            assert!((found.middle_mm - 1e3 * reference(&root, moved)).abs() < 1e-3 * found.middle_mm);
            assert!(found.image_px.len() > 40, "{}", found.image_px.len());
            for (pixel, px) in &found.image_px {
                let ideal = lens.undistort((*pixel - intrinsics.center_px) / intrinsics.focal_px).unwrap();
                let seen = ideal.extend(1.0) * pose.apply(middle).z;
                let point = pose.inverse().apply(seen);
                let drawn =
                    |turn, shift| project(&intrinsics, pose.moved(turn, shift).apply(point)).unwrap().extend(0.0);
                let reference = reference(&root, drawn);
                assert!((px - reference).abs() < 1e-3 * reference, "{lens:?} {pixel}: {px} {reference}");
            }
            assert!(found.worst_px() >= found.image_px[0].1);
        }
    }
}

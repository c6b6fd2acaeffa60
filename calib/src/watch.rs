//! Detection of bumped cameras: tracks corners of one camera's background against a reference image.
//!
//! Corners of the static background are tracked by gradient descent on normalised brightness (Lucas and Kanade 1981, with the
//! brightness of each patch brought to mean 0 and length 1, so that lights and exposure change nothing), and one rotation of the
//! camera must explain most of them. People and moved furniture agree on no rotation.

mod image;
mod patches;
#[cfg(test)]
mod tests;

use flyrig_solve::exp_rotation;
use flyrig_types::{Camera, Intrinsics, Isometry};
use glam::{DMat3, DVec2, DVec3};

pub use self::image::WatchedImage;
use self::patches::{Patch, Pyramid, choose, coarse_shift, track};
use crate::projection::{LensModel, project, project_with_derivatives};

/// Largest width of the reduced image, pixels.
const WIDTH: usize = 640;
/// Distance within which a patch agrees with a rotation, pixels of the reduced image.
const AGREE_PX: f64 = 0.75;
/// Fewest agreeing patches, and least fraction of the tracked ones.
const LEAST_PATCHES: usize = 12;
const LEAST_SHARE: f64 = 0.4;
/// Fraction of tracked patches below which a large shift is searched for.
const FEW_FOUND: f64 = 0.3;
/// Least mean motion of the image that is reported, pixels of the reduced image.
const LEAST_MOTION_PX: f64 = 0.5;
/// Consecutive images that must agree on a motion, and their relative tolerance.
const CONFIRMATIONS: usize = 3;
const SAME_SHARE: f64 = 0.3;
/// Steps of the robust fit.
const STEPS: usize = 10;

/// Motion of a camera against its reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraMotion {
    /// Rotation vector of the camera in its own axes, radians. A small translation appears as rotation too.
    pub rotation: DVec3,
    /// Mean motion of the image, pixels.
    pub pixels: f64,
    /// Agreeing patches, and all patches of the reference.
    pub agreeing: (usize, usize),
}

impl CameraMotion {
    /// Returns the camera after this motion.
    #[must_use]
    pub fn applied_to(&self, camera: &Camera) -> Camera {
        // What stands still turns the other way in the camera's axes.
        let turned = Isometry::new(exp_rotation(-self.rotation), DVec3::ZERO);
        Camera { camera_from_world: turned * camera.camera_from_world, ..camera.clone() }
    }
}

/// State of a watched camera.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum WatchState {
    /// Too little of the background is visible, or nothing was compared yet.
    #[default]
    Unknown,
    /// The camera stands as in the reference.
    Steady,
    /// The camera was moved.
    Moved(CameraMotion),
}

/// Comparison of one camera's images with a reference.
#[derive(Debug, Clone)]
pub struct CameraWatch {
    intrinsics: Intrinsics,
    /// Reduction factor of the image.
    factor: f64,
    patches: Vec<Patch>,
    rotation: DVec3,
    /// Motions in recent images, newest last.
    recent: Vec<CameraMotion>,
    state: WatchState,
}

impl CameraWatch {
    /// Creates a watch from a reference image; `None` if it is not of the calibrated size, or shows too few corners.
    #[must_use]
    pub fn new(intrinsics: &Intrinsics, reference: &WatchedImage<'_>) -> Option<Self> {
        if [reference.width, reference.height] != [intrinsics.width as usize, intrinsics.height as usize] {
            return None;
        }
        let factor = reference.width.div_ceil(WIDTH);
        let pyramid = Pyramid::new(reference, factor)?;
        let ray = |at: DVec2| {
            let pixel = at * factor as f64;
            let ideal = intrinsics.lens.undistort((pixel - intrinsics.center_px) / intrinsics.focal_px)?;
            Some(ideal.extend(1.0).normalize())
        };
        let patches = choose(&pyramid, &ray);
        (patches.len() >= LEAST_PATCHES).then(|| Self {
            intrinsics: *intrinsics,
            factor: factor as f64,
            patches,
            rotation: DVec3::ZERO,
            recent: Vec::new(),
            state: WatchState::Unknown,
        })
    }

    /// Returns the state after the last image.
    #[must_use]
    pub fn state(&self) -> WatchState {
        self.state
    }

    /// Returns the motion in the last image in which enough of the background was tracked, whether it is reported or
    /// not.
    #[must_use]
    pub fn last_motion(&self) -> Option<CameraMotion> {
        self.recent.last().copied()
    }

    /// Compares an image, about once per second, and returns the new state. A motion is reported once three images
    /// agree on it; an image in which too little of the background is tracked changes nothing.
    pub fn compare(&mut self, image: &WatchedImage<'_>) -> WatchState {
        let is_of_size =
            [image.width, image.height] == [self.intrinsics.width as usize, self.intrinsics.height as usize];
        let pyramid = Some(image).filter(|_| is_of_size).and_then(|image| Pyramid::new(image, self.factor as usize));
        let Some(motion) = pyramid.and_then(|pyramid| self.motion(&pyramid)) else { return self.state };
        self.rotation = motion.rotation;
        self.recent.push(motion);
        if self.recent.len() > CONFIRMATIONS {
            self.recent.remove(0);
        }
        let least = LEAST_MOTION_PX * self.factor;
        let focal = self.intrinsics.focal_px.max_element();
        let apart = |a: &CameraMotion, b: &CameraMotion| focal * a.rotation.distance(b.rotation);
        if self.recent.len() == CONFIRMATIONS {
            if self.recent.iter().all(|motion| motion.pixels < least) {
                self.state = WatchState::Steady;
            } else if self
                .recent
                .iter()
                .all(|other| other.pixels >= least && apart(other, &motion) < (SAME_SHARE * motion.pixels).max(least))
            {
                self.state = WatchState::Moved(motion);
            }
        }
        self.state
    }

    /// Estimates the rotation that most patches agree on; `None` without one.
    fn motion(&self, pyramid: &Pyramid) -> Option<CameraMotion> {
        let predicted = |rotation: DVec3| {
            let shift = |patch: &Patch| {
                let at = self.pixel(patch, rotation)?;
                Some((at - patch.at * self.factor) / self.factor)
            };
            self.patches.iter().map(shift).map(Option::unwrap_or_default).collect::<Vec<DVec2>>()
        };
        let mut found = track(pyramid, &self.patches, &predicted(self.rotation));
        let count = |found: &[Option<DVec2>]| found.iter().flatten().count();
        if (count(&found) as f64) < FEW_FOUND * self.patches.len() as f64 {
            let shift = coarse_shift(pyramid, &self.patches)?;
            let again = track(pyramid, &self.patches, &vec![shift; self.patches.len()]);
            if count(&again) > count(&found) {
                found = again;
            }
        }
        let pairs: Vec<(&Patch, DVec2)> =
            self.patches.iter().zip(found).filter_map(|(patch, at)| Some((patch, at? * self.factor))).collect();
        let (rotation, agreeing) = self.consensus(&pairs)?;
        if agreeing < LEAST_PATCHES || (agreeing as f64) < LEAST_SHARE * pairs.len() as f64 {
            return None;
        }
        let moved =
            self.patches.iter().filter_map(|patch| Some(self.pixel(patch, rotation)?.distance(patch.at * self.factor)));
        let moved: Vec<f64> = moved.collect();
        let pixels = moved.iter().sum::<f64>() / moved.len().max(1) as f64;
        Some(CameraMotion { rotation, pixels, agreeing: (agreeing, self.patches.len()) })
    }

    /// Returns the pixel of a patch after the camera turned. In the camera's axes the static world turns the other way.
    fn pixel(&self, patch: &Patch, rotation: DVec3) -> Option<DVec2> {
        project(&self.intrinsics, exp_rotation(-rotation) * patch.ray)
    }

    /// Returns the derivative of the pixel by the rotation vector, as columns.
    fn by_rotation(&self, patch: &Patch, rotation: DVec3) -> Option<(DVec2, [DVec2; 3])> {
        let ray = exp_rotation(-rotation) * patch.ray;
        let projected = project_with_derivatives(&self.intrinsics, LensModel::Radial1, ray)?;
        let column = |axis: DVec3| {
            let by = ray.cross(axis);
            projected.by_point[0] * by.x + projected.by_point[1] * by.y + projected.by_point[2] * by.z
        };
        Some((projected.pixel, [column(DVec3::X), column(DVec3::Y), column(DVec3::Z)]))
    }

    /// Finds the rotation that most pairs of a patch and its pixel agree on, and their number.
    fn consensus(&self, pairs: &[(&Patch, DVec2)]) -> Option<(DVec3, usize)> {
        let tolerance = AGREE_PX * self.factor;
        let agreeing = |rotation: DVec3| {
            let near = |(patch, at): &&(&Patch, DVec2)| {
                self.pixel(patch, rotation).is_some_and(|pixel| pixel.distance(*at) < tolerance)
            };
            pairs.iter().filter(near).count()
        };
        // Each patch by itself fixes two of the three angles; roll stays as it was.
        let of_patch = |(patch, at): &(&Patch, DVec2)| {
            let (pixel, by) = self.by_rotation(patch, self.rotation)?;
            let (a, b, off) = (by[0], by[1], *at - pixel);
            let det = a.perp_dot(b);
            (det.abs() > 1e-9).then(|| self.rotation + DVec3::new(off.perp_dot(b) / det, a.perp_dot(off) / det, 0.0))
        };
        let candidates = pairs.iter().filter_map(of_patch).chain([self.rotation, DVec3::ZERO]);
        let (_, mut rotation) = candidates.map(|r| (agreeing(r), r)).max_by_key(|(count, _)| *count)?;
        for step in 0..STEPS {
            // The first steps also count patches that a missing roll puts off.
            let scale = tolerance * if step < STEPS / 2 { 4.0 } else { 1.0 };
            let (mut normal, mut right) = (DMat3::from_diagonal(DVec3::splat(1e-9)), DVec3::ZERO);
            for (patch, at) in pairs {
                let Some((pixel, by)) = self.by_rotation(patch, rotation) else { continue };
                let off = *at - pixel;
                let share = off.length() / scale;
                let weight = if share < 1.0 { (1.0 - share * share).powi(2) } else { continue };
                for row in 0..2 {
                    let j = DVec3::new(by[0][row], by[1][row], by[2][row]);
                    normal += DMat3::from_cols(j * j.x, j * j.y, j * j.z) * weight;
                    right += j * (weight * off[row]);
                }
            }
            let change = normal.inverse() * right;
            if !change.is_finite() {
                return None;
            }
            rotation += change;
        }
        Some((rotation, agreeing(rotation)))
    }
}

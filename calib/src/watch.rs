//! Watches whether a camera still stands as it stood when its reference image was taken.
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
use crate::{
    LensModel,
    projection::{project, project_with_derivatives},
};

/// Images are reduced until their width is at most this, pixels.
const WIDTH: usize = 640;
/// Patches agree with a rotation within this distance, pixels of the reduced image.
const AGREE_PX: f64 = 0.75;
/// Fewest patches, and least share of those that were found again, that must agree.
const LEAST_PATCHES: usize = 12;
const LEAST_SHARE: f64 = 0.4;
/// Share of the patches that must be found again before a large shift is looked for.
const FEW_FOUND: f64 = 0.3;
/// Mean motion of the image that counts, pixels of the reduced image.
const LEAST_MOTION_PX: f64 = 0.5;
/// Consecutive looks that must agree on a motion, within this share of it.
const LOOKS: usize = 3;
const SAME_SHARE: f64 = 0.3;
/// Steps of the robust fit.
const STEPS: usize = 10;

/// Motion of a camera against its reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraMotion {
    /// Rotation vector of the camera in its own axes, radians. A small translation shows as rotation too.
    pub rotation: DVec3,
    /// Mean motion of the image, pixels.
    pub pixels: f64,
    /// Patches that agree, of those of the reference.
    pub agreeing: (usize, usize),
}

impl CameraMotion {
    /// The camera after this motion.
    #[must_use]
    pub fn applied_to(&self, camera: &Camera) -> Camera {
        // What stands still turns the other way in the camera's axes.
        let turned = Isometry::new(exp_rotation(-self.rotation), DVec3::ZERO);
        Camera { camera_from_world: turned * camera.camera_from_world, ..camera.clone() }
    }
}

/// State of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum WatchState {
    /// Too little of the background is seen, or nothing was compared yet.
    #[default]
    Unknown,
    /// It stands as in the reference.
    Steady,
    /// It was moved.
    Moved(CameraMotion),
}

/// Compares the images of one camera with a reference.
#[derive(Debug, Clone)]
pub struct CameraWatch {
    intrinsics: Intrinsics,
    /// Pixels of the image in one of the reduced image.
    factor: f64,
    patches: Vec<Patch>,
    rotation: DVec3,
    /// Motions of the last looks, newest last.
    recent: Vec<CameraMotion>,
    state: WatchState,
}

impl CameraWatch {
    /// Takes a reference image; `None` where it is not of the calibrated size, or shows too few corners.
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

    /// State after the last look.
    #[must_use]
    pub fn state(&self) -> WatchState {
        self.state
    }

    /// Motion in the last image in which enough of the background was found again, whether it counts or not.
    #[must_use]
    pub fn last_motion(&self) -> Option<CameraMotion> {
        self.recent.last().copied()
    }

    /// Compares an image, about once a second, and returns the new state. A motion is reported once three looks agree on it; an image in
    /// which too little of the background is found again changes nothing.
    pub fn look(&mut self, image: &WatchedImage<'_>) -> WatchState {
        let is_of_size =
            [image.width, image.height] == [self.intrinsics.width as usize, self.intrinsics.height as usize];
        let pyramid = Some(image).filter(|_| is_of_size).and_then(|image| Pyramid::new(image, self.factor as usize));
        let Some(motion) = pyramid.and_then(|pyramid| self.motion(&pyramid)) else { return self.state };
        self.rotation = motion.rotation;
        self.recent.push(motion);
        if self.recent.len() > LOOKS {
            self.recent.remove(0);
        }
        let least = LEAST_MOTION_PX * self.factor;
        let focal = self.intrinsics.focal_px.max_element();
        let apart = |a: &CameraMotion, b: &CameraMotion| focal * a.rotation.distance(b.rotation);
        if self.recent.len() == LOOKS {
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

    /// Rotation that most patches agree on; `None` without one.
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

    /// Pixel of a patch after the camera turned. What stands still turns the other way in the camera's axes.
    fn pixel(&self, patch: &Patch, rotation: DVec3) -> Option<DVec2> {
        project(&self.intrinsics, exp_rotation(-rotation) * patch.ray)
    }

    /// Derivative of the pixel by the rotation vector, columns.
    fn by_rotation(&self, patch: &Patch, rotation: DVec3) -> Option<(DVec2, [DVec2; 3])> {
        let ray = exp_rotation(-rotation) * patch.ray;
        let projected = project_with_derivatives(&self.intrinsics, LensModel::Radial1, ray)?;
        let column = |axis: DVec3| {
            let by = ray.cross(axis);
            projected.by_point[0] * by.x + projected.by_point[1] * by.y + projected.by_point[2] * by.z
        };
        Some((projected.pixel, [column(DVec3::X), column(DVec3::Y), column(DVec3::Z)]))
    }

    /// Rotation that most pairs of a patch and its pixel agree on, and how many do.
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

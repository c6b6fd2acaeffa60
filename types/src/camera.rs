//! Camera models: pinhole with lens distortion, pose in the world, rigs.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::{CameraId, Isometry};

/// Largest image side that anything in flyrig accepts, pixels.
pub const MAX_IMAGE_SIDE: u32 = 16_384;

/// Distortion from the ideal image plane `(x/z, y/z)`, OpenCV's coefficients.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Lens {
    /// `x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)`, y alike (Brown-Conrady).
    RadialTangential {
        /// k1, k2, k3.
        radial: [f64; 3],
        /// p1, p2.
        tangential: [f64; 2],
    },
    /// Equidistant: `θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)` (Kannala-Brandt).
    Fisheye {
        /// k1 to k4.
        coefficients: [f64; 4],
    },
}

impl Lens {
    /// No distortion at all.
    pub const PINHOLE: Self = Self::RadialTangential { radial: [0.0; 3], tangential: [0.0; 2] };

    /// Maps a point of the ideal plane to the distorted plane.
    #[must_use]
    pub fn distort(&self, ideal: DVec2) -> DVec2 {
        match *self {
            Self::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] } => {
                let (x, y) = (ideal.x, ideal.y);
                let r2 = ideal.length_squared();
                let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                DVec2::new(
                    x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                )
            }
            Self::Fisheye { coefficients: [k1, k2, k3, k4] } => {
                let r = ideal.length();
                if r < 1e-9 {
                    return ideal;
                }
                let theta = r.atan();
                let t2 = theta * theta;
                let distorted = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
                ideal * (distorted / r)
            }
        }
    }

    /// Radius on the ideal plane up to which the radial part grows, so that no two directions share
    /// a pixel; points beyond it must not be projected. At most `1e3`.
    #[must_use]
    pub fn valid_radius(&self) -> f64 {
        const LIMIT: f64 = 1e3;
        let grows = |r: f64| match *self {
            Self::RadialTangential { radial: [k1, k2, k3], .. } => {
                let r2 = r * r;
                1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3)) > 0.0
            }
            Self::Fisheye { coefficients: [k1, k2, k3, k4] } => {
                let t2 = r.atan().powi(2);
                1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4))) > 0.0
            }
        };
        if self.surely_grows(LIMIT) {
            return LIMIT;
        }
        // The derivative may dip below zero and rise again: walk outwards, then bisect the first dip.
        let (mut low, mut r) = (0.0, 0.01);
        while r < LIMIT {
            if !grows(r) {
                let mut high = r;
                for _ in 0..60 {
                    let middle = 0.5 * (low + high);
                    if grows(middle) { low = middle } else { high = middle }
                }
                return low;
            }
            low = r;
            r *= 1.02;
        }
        LIMIT
    }

    /// Whether a point of the ideal plane may be projected: not beyond [`Self::valid_radius`].
    #[must_use]
    pub fn is_valid(&self, ideal: DVec2) -> bool {
        let radius = ideal.length();
        self.surely_grows(radius) || radius <= self.valid_radius()
    }

    /// Quick and on the safe side: counting the negative coefficients alone, the radial part's derivative shrinks
    /// with the radius, so where it is positive it is so all the way there.
    fn surely_grows(&self, radius: f64) -> bool {
        let negative = |c: f64| c.min(0.0);
        let least = match *self {
            Self::RadialTangential { radial: [k1, k2, k3], .. } => {
                let r2 = radius * radius;
                1.0 + r2 * (3.0 * negative(k1) + r2 * (5.0 * negative(k2) + r2 * 7.0 * negative(k3)))
            }
            Self::Fisheye { coefficients: [k1, k2, k3, k4] } => {
                let t2 = radius.atan().powi(2);
                1.0 + t2
                    * (3.0 * negative(k1)
                        + t2 * (5.0 * negative(k2) + t2 * (7.0 * negative(k3) + t2 * 9.0 * negative(k4))))
            }
        };
        least > 0.0
    }

    /// Inverse of [`Self::distort`] by damped fixed-point and Newton steps; `None` when nothing on
    /// the valid part of the plane maps there.
    #[must_use]
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        let valid = self.valid_radius();
        let mut ideal = distorted.clamp_length_max(valid * 0.99);
        for _ in 0..100 {
            let error = self.distort(ideal) - distorted;
            if error.length() < 1e-13 * (1.0 + distorted.length()) {
                break;
            }
            const STEP: f64 = 1e-6;
            let dx = (self.distort(ideal + DVec2::X * STEP) - self.distort(ideal - DVec2::X * STEP)) / (2.0 * STEP);
            let dy = (self.distort(ideal + DVec2::Y * STEP) - self.distort(ideal - DVec2::Y * STEP)) / (2.0 * STEP);
            let jacobian = glam::DMat2::from_cols(dx, dy);
            if jacobian.determinant().abs() < 1e-12 {
                return None;
            }
            let mut step = jacobian.inverse() * error;
            // Never jump over the fold of the polynomial.
            let limit = 0.5 * (1.0 + ideal.length());
            step = step.clamp_length_max(limit);
            ideal = (ideal - step).clamp_length_max(valid);
        }
        let good = (self.distort(ideal) - distorted).length() < 1e-8 * (1.0 + distorted.length());
        (good && ideal.is_finite()).then_some(ideal)
    }
}

/// What a camera does to a point in front of it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Focal lengths fx, fy in pixels.
    pub focal_px: DVec2,
    /// Principal point in pixels; pixel centres at integers.
    pub center_px: DVec2,
    /// Distortion.
    pub lens: Lens,
}

/// Why a camera model is refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A number is NaN or infinite.
    #[error("camera {camera}: {field} is not a finite number; re-export or redo its calibration")]
    NotFinite {
        /// Which camera.
        camera: CameraId,
        /// What was wrong.
        field: &'static str,
    },
    /// A number is out of its range.
    #[error("camera {camera}: {field} is {value}, expected {expected}")]
    OutOfRange {
        /// Which camera.
        camera: CameraId,
        /// What was wrong.
        field: &'static str,
        /// What was found.
        value: f64,
        /// What would be right.
        expected: &'static str,
    },
    /// Two cameras share a name.
    #[error("camera {0} appears twice in the rig")]
    Duplicate(CameraId),
}

/// A calibrated camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Name.
    pub id: CameraId,
    /// Lens and sensor.
    pub intrinsics: Intrinsics,
    /// World to camera axes.
    pub camera_from_world: Isometry,
}

impl Camera {
    /// Width and height of its pictures, pixels.
    #[must_use]
    pub fn size(&self) -> [u32; 2] {
        [self.intrinsics.width, self.intrinsics.height]
    }

    /// Pixel of a world point; `None` behind the camera, closer than 1 mm to its plane, or beyond
    /// the lens model's valid radius.
    #[must_use]
    pub fn project(&self, world: DVec3) -> Option<DVec2> {
        let point = self.camera_from_world.transform_point(world);
        if !point.is_finite() || point.z < 1e-3 {
            return None;
        }
        let ideal = point.truncate() / point.z;
        if !self.intrinsics.lens.is_valid(ideal) {
            return None;
        }
        Some(self.intrinsics.lens.distort(ideal) * self.intrinsics.focal_px + self.intrinsics.center_px)
    }

    /// Unit direction in world axes of the ray through a pixel; `None` where the lens has none.
    #[must_use]
    pub fn ray(&self, pixel: DVec2) -> Option<DVec3> {
        let distorted = (pixel - self.intrinsics.center_px) / self.intrinsics.focal_px;
        let ideal = self.intrinsics.lens.undistort(distorted)?;
        Some((self.camera_from_world.rotation.inverse() * ideal.extend(1.0)).normalize())
    }

    /// Camera centre in the world, metres.
    #[must_use]
    pub fn position(&self) -> DVec3 {
        self.camera_from_world.inverse().translation
    }

    /// Checks every number.
    ///
    /// # Errors
    /// [`CameraError`] names the field.
    pub fn validate(&self) -> Result<(), CameraError> {
        let camera = || self.id.clone();
        let i = &self.intrinsics;
        let not_finite = |field| CameraError::NotFinite { camera: camera(), field };
        let coefficients: Vec<f64> = match i.lens {
            Lens::RadialTangential { radial, tangential } => radial.into_iter().chain(tangential).collect(),
            Lens::Fisheye { coefficients } => coefficients.to_vec(),
        };
        if !i.focal_px.is_finite() || !i.center_px.is_finite() {
            return Err(not_finite("the camera matrix K"));
        }
        if !coefficients.iter().all(|c| c.is_finite()) {
            return Err(not_finite("the lens distortion"));
        }
        if !self.camera_from_world.rotation.is_finite() {
            return Err(not_finite("the rotation R"));
        }
        if !self.camera_from_world.translation.is_finite() {
            return Err(not_finite("the translation T"));
        }
        let range = |field, value: f64, ok: bool, expected| {
            if ok { Ok(()) } else { Err(CameraError::OutOfRange { camera: camera(), field, value, expected }) }
        };
        let side = 1..=MAX_IMAGE_SIDE;
        range("image width", f64::from(i.width), side.contains(&i.width), "1 to 16384 pixels")?;
        range("image height", f64::from(i.height), side.contains(&i.height), "1 to 16384 pixels")?;
        range("focal length fx", i.focal_px.x, i.focal_px.x > 0.0, "a positive number of pixels")?;
        range("focal length fy", i.focal_px.y, i.focal_px.y > 0.0, "a positive number of pixels")?;
        let norm = self.camera_from_world.rotation.length();
        range("rotation quaternion length", norm, (norm - 1.0).abs() < 1e-6, "1")
    }
}

/// The cameras of a capture, in a fixed order that frame sets follow.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rig {
    /// In rig order.
    pub cameras: Vec<Camera>,
    /// Unit vector against gravity, world axes.
    pub world_up: DVec3,
}

impl Rig {
    /// Returns the point that the cameras look at: closest to all optical axes, in the least-squares sense; world metres.
    #[must_use]
    pub fn center_of_attention(&self) -> DVec3 {
        let mut normal = DMat3::from_diagonal(DVec3::splat(1e-6));
        let mut right = DVec3::ZERO;
        for camera in &self.cameras {
            let axis = camera.camera_from_world.rotation.inverse() * DVec3::Z;
            let projector = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
            normal += projector;
            right += projector * camera.position();
        }
        let center = normal.inverse() * right;
        // A single camera, or parallel ones, fix no point: take one 3 m in front.
        let Some(first) = self.cameras.first() else { return DVec3::ZERO };
        if self.cameras.len() < 2 || !center.is_finite() || center.distance(first.position()) > 1e3 {
            return first.position() + first.camera_from_world.rotation.inverse() * DVec3::Z * 3.0;
        }
        center
    }

    /// Checks every camera and that names are unique.
    ///
    /// # Errors
    /// [`CameraError`] names camera and field.
    pub fn validate(&self) -> Result<(), CameraError> {
        for (i, camera) in self.cameras.iter().enumerate() {
            camera.validate()?;
            if self.cameras[..i].iter().any(|other| other.id == camera.id) {
                return Err(CameraError::Duplicate(camera.id.clone()));
            }
        }
        Ok(())
    }

    /// Slot of a camera.
    #[must_use]
    pub fn slot(&self, id: &CameraId) -> Option<usize> {
        self.cameras.iter().position(|camera| camera.id == *id)
    }

    /// World axis closest to "up" in the cameras' pictures: what a data set that does not say means.
    #[must_use]
    pub fn guess_world_up(cameras: &[Camera]) -> DVec3 {
        let up: DVec3 = cameras.iter().map(|c| c.camera_from_world.rotation.inverse() * DVec3::NEG_Y).sum();
        [DVec3::Z, DVec3::Y, DVec3::X, DVec3::NEG_Z, DVec3::NEG_Y, DVec3::NEG_X]
            .into_iter()
            .max_by(|a, b| up.dot(*a).total_cmp(&up.dot(*b)))
            .unwrap_or(DVec3::Z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(lens: Lens) -> Camera {
        Camera {
            id: "a".into(),
            intrinsics: Intrinsics {
                width: 640,
                height: 480,
                focal_px: DVec2::new(500.0, 510.0),
                center_px: DVec2::new(320.0, 240.0),
                lens,
            },
            camera_from_world: Isometry::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::new(0.0, 0.0, 1.0), DVec3::Z),
        }
    }

    #[test]
    fn a_hand_made_point_lands_where_it_should() {
        // 3 m in front, 0.3 m right, 0.6 m up: u = 320 + 500 * 0.1, v = 240 - 510 * 0.2.
        let pixel = camera(Lens::PINHOLE).project(DVec3::new(0.3, 0.0, 1.6)).unwrap();
        assert!((pixel - DVec2::new(370.0, 138.0)).length() < 1e-9);
        assert_eq!(camera(Lens::PINHOLE).project(DVec3::new(0.0, -4.0, 1.0)), None, "behind");
        assert_eq!(camera(Lens::PINHOLE).project(DVec3::new(f64::NAN, 0.0, 0.0)), None);
    }

    #[test]
    fn ray_and_project_are_inverse_for_every_lens() {
        let lenses = [
            Lens::PINHOLE,
            Lens::RadialTangential { radial: [-0.3, 0.1, -0.02], tangential: [0.001, -0.002] },
            Lens::RadialTangential { radial: [0.12, -0.03, 0.0], tangential: [0.0, 0.0] },
            Lens::Fisheye { coefficients: [0.05, -0.01, 0.002, -0.0005] },
        ];
        for lens in lenses {
            let camera = camera(lens);
            for (u, v) in [(320.0, 240.0), (10.0, 10.0), (600.0, 50.0), (333.3, 470.0)] {
                let pixel = DVec2::new(u, v);
                let ray = camera.ray(pixel).unwrap();
                let back = camera.project(camera.position() + ray * 2.5).unwrap();
                assert!((back - pixel).length() < 1e-6, "{lens:?} {pixel} {back}");
            }
        }
    }

    #[test]
    fn a_folding_polynomial_is_cut_before_the_fold() {
        let lens = Lens::RadialTangential { radial: [-0.3, 0.0, 0.0], tangential: [0.0; 2] };
        // d/dr (r - 0.3 r³) = 0 at r = 1/sqrt(0.9).
        assert!((lens.valid_radius() - 1.0 / 0.9f64.sqrt()).abs() < 1e-9);
        let wide = camera(lens);
        let sideways = wide.position() + wide.camera_from_world.rotation.inverse() * DVec3::new(1.2, 0.0, 1.0);
        assert_eq!(wide.project(sideways), None);
    }

    #[test]
    fn the_quick_check_never_lets_a_point_beyond_the_valid_radius_through() {
        let coefficients = [-0.9, -0.3, -0.01, 0.0, 0.02, 0.4];
        for (i, k1) in coefficients.into_iter().enumerate() {
            for (j, k2) in coefficients.into_iter().enumerate() {
                let k3 = coefficients[(i + 2 * j) % 6];
                for lens in [
                    Lens::RadialTangential { radial: [k1, k2, k3], tangential: [0.0; 2] },
                    Lens::Fisheye { coefficients: [k1, k2, k3, k1] },
                ] {
                    let valid = lens.valid_radius();
                    for share in [0.1, 0.5, 0.9, 0.999, 1.001, 1.1, 2.0, 10.0] {
                        let radius = share * valid;
                        let expected = radius <= valid || (valid >= 1e3 && lens.is_valid(DVec2::X * radius));
                        assert_eq!(lens.is_valid(DVec2::X * radius), expected, "{lens:?} {share}");
                    }
                }
            }
        }
        assert!(!Lens::PINHOLE.is_valid(DVec2::new(f64::NAN, 0.0)));
    }

    #[test]
    fn bad_numbers_are_named() {
        let mut bad = camera(Lens::PINHOLE);
        bad.intrinsics.focal_px.x = f64::NAN;
        assert!(
            bad.validate().unwrap_err().to_string().contains("camera a: the camera matrix K is not a finite number")
        );
        bad.intrinsics.focal_px.x = -1.0;
        assert!(bad.validate().unwrap_err().to_string().contains("focal length fx is -1"));
        let good = camera(Lens::PINHOLE);
        let rig = Rig { cameras: vec![good.clone(), good], world_up: DVec3::Z };
        assert_eq!(rig.validate().unwrap_err(), CameraError::Duplicate("a".into()));
    }

    #[test]
    fn up_is_guessed_from_level_cameras() {
        assert_eq!(Rig::guess_world_up(&[camera(Lens::PINHOLE)]), DVec3::Z);
    }
}

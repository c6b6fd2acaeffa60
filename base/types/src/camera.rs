//! Camera models: pinhole with lens distortion, pose in the world; rigs of cameras.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::{CameraId, CameraNameError, ColorMatch, Isometry};

/// Largest side of an image, pixels.
pub const MAX_IMAGE_SIDE: u32 = 16_384;

/// Largest time offset between cameras, milliseconds.
const MAX_TIME_OFFSET_MS: f64 = 1000.0;

/// Lens distortion: from the ideal image plane `(x/z, y/z)` to the distorted one, with OpenCV's coefficients.
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
    /// As [`Self::RadialTangential`], with the radial factor `(1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)`.
    Rational {
        /// k1 to k6.
        radial: [f64; 6],
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
    /// Lens without distortion.
    pub const PINHOLE: Self = Self::RadialTangential { radial: [0.0; 3], tangential: [0.0; 2] };

    /// Returns k1 to k6, p1 and p2; k4 to k6 are 0 for [`Self::RadialTangential`]. `None` for a fisheye.
    #[must_use]
    pub fn rational(&self) -> Option<([f64; 6], [f64; 2])> {
        match *self {
            Self::RadialTangential { radial: [k1, k2, k3], tangential } => {
                Some(([k1, k2, k3, 0.0, 0.0, 0.0], tangential))
            }
            Self::Rational { radial, tangential } => Some((radial, tangential)),
            Self::Fisheye { .. } => None,
        }
    }

    /// Returns all coefficients, in the order of the variant's fields.
    #[must_use]
    pub fn coefficients(&self) -> Vec<f64> {
        match *self {
            Self::RadialTangential { radial, tangential } => radial.into_iter().chain(tangential).collect(),
            Self::Rational { radial, tangential } => radial.into_iter().chain(tangential).collect(),
            Self::Fisheye { coefficients } => coefficients.to_vec(),
        }
    }

    /// Maps a point of the ideal plane to the distorted plane.
    #[must_use]
    pub fn distort(&self, ideal: DVec2) -> DVec2 {
        if let Self::Fisheye { coefficients } = self {
            let r = ideal.length();
            if r < 1e-9 {
                return ideal;
            }
            let theta = r.atan();
            return ideal * (theta * polynomial(&series(coefficients), theta * theta) / r);
        }
        let (x, y) = (ideal.x, ideal.y);
        let r2 = ideal.length_squared();
        let (k, [p1, p2]) = self.rational().unwrap_or_default();
        let radial = match self {
            Self::Rational { .. } => polynomial(&series(&k[..3]), r2) / polynomial(&series(&k[3..]), r2),
            Self::RadialTangential { .. } | Self::Fisheye { .. } => 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2])),
        };
        DVec2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// Returns the radius on the ideal plane up to which the radial part grows, so that no two directions share a pixel, at most
    /// `1e3`. Points beyond it must not be projected.
    #[must_use]
    pub fn valid_radius(&self) -> f64 {
        const LIMIT: f64 = 1e3;
        if self.surely_grows(LIMIT) {
            return LIMIT;
        }
        let conditions = self.conditions();
        let grows = |r: f64| {
            let s = self.squared_argument(r);
            conditions.iter().all(|condition| polynomial(condition, s) > 0.0)
        };
        // A condition may dip below zero and rise again: walk outwards, then bisect the first dip.
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

    /// Returns whether a point of the ideal plane may be projected: not beyond [`Self::valid_radius`].
    #[must_use]
    pub fn is_valid(&self, ideal: DVec2) -> bool {
        let radius = ideal.length();
        self.surely_grows(radius) || radius <= self.valid_radius()
    }

    /// Returns true only where the radial part grows up to `radius`: a quick, conservative test. With its negative coefficients
    /// alone each condition falls with the radius; where it is positive, it is positive at all smaller radii.
    fn surely_grows(&self, radius: f64) -> bool {
        let s = self.squared_argument(radius);
        // The common lens without the polynomials in full: this runs for each projected point.
        if let Self::RadialTangential { radial: [k1, k2, k3], .. } = *self {
            return 1.0 + s * ((3.0 * k1).min(0.0) + s * ((5.0 * k2).min(0.0) + s * (7.0 * k3).min(0.0))) > 0.0;
        }
        self.conditions().iter().all(|condition| {
            let negative: [f64; 7] = std::array::from_fn(|i| if i == 0 { condition[0] } else { condition[i].min(0.0) });
            polynomial(&negative, s) > 0.0
        })
    }

    /// Returns the variable of [`Self::conditions`] at a radius of the ideal plane: its square, or the squared angle for a fisheye.
    fn squared_argument(&self, radius: f64) -> f64 {
        match self {
            Self::Fisheye { .. } => radius.atan().powi(2),
            Self::RadialTangential { .. } | Self::Rational { .. } => radius * radius,
        }
    }

    /// Returns two polynomials that are positive where the radial part grows: the numerator of its derivative, and its denominator.
    fn conditions(&self) -> [[f64; 7]; 2] {
        let mut slope = [0.0; 7];
        let mut denominator = [0.0; 7];
        denominator[0] = 1.0;
        let Some((k, _)) = self.rational() else {
            let Self::Fisheye { coefficients } = self else { return [slope, denominator] };
            for (i, c) in series(coefficients).into_iter().enumerate() {
                slope[i] = (2 * i + 1) as f64 * c;
            }
            return [slope, denominator];
        };
        // With N(s), D(s), s = r²: d/dr (r N/D) D² = (N + 2 s N') D - 2 s N D'.
        let (above, below) = (series(&k[..3]), series(&k[3..]));
        for (i, n) in above.into_iter().take(4).enumerate() {
            for (j, d) in below.into_iter().take(4).enumerate() {
                slope[i + j] += n * d * (1.0 + 2.0 * i as f64 - 2.0 * j as f64);
            }
        }
        denominator[..4].copy_from_slice(&below[..4]);
        [slope, denominator]
    }

    /// Inverts [`Self::distort`] by damped Newton steps; `None` when no point of the valid part of the plane maps there.
    #[must_use]
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        // The valid radius takes a search; mostly it suffices to know that it exceeds the required one.
        let near = 2.0 * distorted.length() + 0.1;
        let quick = self.surely_grows(near).then(|| self.undistort_within(distorted, near)).flatten();
        quick.or_else(|| self.undistort_within(distorted, self.valid_radius()))
    }

    /// Inverts [`Self::distort`] among points of at most the radius `valid`.
    fn undistort_within(&self, distorted: DVec2, valid: f64) -> Option<DVec2> {
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

/// Returns 1 followed by the coefficients, at most four.
fn series(coefficients: &[f64]) -> [f64; 5] {
    std::array::from_fn(|i| if i == 0 { 1.0 } else { coefficients.get(i - 1).copied().unwrap_or_default() })
}

/// Evaluates a polynomial, lowest power first.
fn polynomial(coefficients: &[f64], at: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, c| sum * at + c)
}

/// Projection of a camera, from camera axes to pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Width of the images, pixels.
    pub width: u32,
    /// Height of the images, pixels.
    pub height: u32,
    /// Focal lengths fx, fy, pixels.
    pub focal_px: DVec2,
    /// Principal point, pixels; pixel centres lie at integers.
    pub center_px: DVec2,
    /// Distortion.
    pub lens: Lens,
}

impl Intrinsics {
    /// Creates a pinhole with square pixels and the principal point in the middle.
    #[must_use]
    pub fn pinhole(width: u32, height: u32, focal_px: f64) -> Self {
        Self {
            width,
            height,
            focal_px: DVec2::splat(focal_px),
            center_px: (DVec2::new(f64::from(width), f64::from(height)) - 1.0) / 2.0,
            lens: Lens::PINHOLE,
        }
    }
}

/// Error of a camera model or rig.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A number is NaN or infinite.
    #[error("camera {camera}: {field} is not a finite number; re-export or redo its calibration")]
    NotFinite {
        /// Camera.
        camera: CameraId,
        /// Faulty quantity.
        field: &'static str,
    },
    /// A number is out of its range.
    #[error("camera {camera}: {field} is {value}, expected {expected}")]
    OutOfRange {
        /// Camera.
        camera: CameraId,
        /// Faulty quantity.
        field: &'static str,
        /// Its value.
        value: f64,
        /// Permitted range.
        expected: &'static str,
    },
    /// No camera may have this name.
    #[error(transparent)]
    Name(#[from] CameraNameError),
    /// Two cameras have one name.
    #[error("camera {0} appears twice in the rig")]
    Duplicate(CameraId),
}

/// A calibrated camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Name, unique in a rig.
    pub id: CameraId,
    /// Sensor and lens.
    pub intrinsics: Intrinsics,
    /// Pose: camera axes from world axes.
    pub camera_from_world: Isometry,
    /// Offset of the camera's timestamps against those of the other cameras, nanoseconds; subtracted before frames are joined.
    /// 0 for cameras that are only rendered.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub time_offset_nanos: i64,
    /// Correction of the camera's colours towards those of the other cameras.
    #[serde(default, skip_serializing_if = "is_unmatched")]
    pub color: ColorMatch,
}

fn is_zero(nanos: &i64) -> bool {
    *nanos == 0
}

fn is_unmatched(color: &ColorMatch) -> bool {
    *color == ColorMatch::NONE
}

impl Camera {
    /// Creates a camera without time offset or colour correction.
    ///
    /// ```
    /// use flyrig_types::{Camera, Intrinsics, Isometry};
    /// use glam::{DVec2, DVec3};
    ///
    /// let pose = Isometry::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::Z, DVec3::Z);
    /// let camera = Camera::new("front", Intrinsics::pinhole(640, 480, 500.0), pose);
    /// let pixel = camera.project(DVec3::new(0.3, 0.0, 1.0)).unwrap();
    /// assert!(pixel.distance(DVec2::new(369.5, 239.5)) < 1e-9);
    /// assert!(camera.project(DVec3::new(0.0, -4.0, 1.0)).is_none(), "behind the camera");
    /// ```
    #[must_use]
    pub fn new(id: impl Into<CameraId>, intrinsics: Intrinsics, camera_from_world: Isometry) -> Self {
        Self { id: id.into(), intrinsics, camera_from_world, time_offset_nanos: 0, color: ColorMatch::NONE }
    }

    /// Returns the width and height of the images, pixels.
    #[must_use]
    pub fn size(&self) -> [u32; 2] {
        [self.intrinsics.width, self.intrinsics.height]
    }

    /// Projects a world point, metres, to a pixel; `None` behind the camera, less than 1 mm in front of it, or beyond the lens's
    /// valid radius.
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

    /// Returns the unit direction, world axes, of the ray through a pixel; `None` where the lens has none.
    #[must_use]
    pub fn ray(&self, pixel: DVec2) -> Option<DVec3> {
        let distorted = (pixel - self.intrinsics.center_px) / self.intrinsics.focal_px;
        let ideal = self.intrinsics.lens.undistort(distorted)?;
        Some((self.camera_from_world.rotation.inverse() * ideal.extend(1.0)).normalize())
    }

    /// Returns the camera's centre in the world, metres.
    #[must_use]
    pub fn position(&self) -> DVec3 {
        self.camera_from_world.inverse().translation
    }

    /// Returns the camera of images that are halved `level` times, each pixel the mean of four. Pixel centres lie at integers; an odd
    /// last row or column is dropped.
    ///
    /// ```
    /// use flyrig_types::{Camera, Intrinsics, Isometry};
    /// use glam::DVec2;
    ///
    /// let half = Camera::new("front", Intrinsics::pinhole(1280, 720, 900.0), Isometry::IDENTITY).halved(1);
    /// assert_eq!(half.size(), [640, 360]);
    /// assert_eq!(half.intrinsics.center_px, DVec2::new(319.5, 179.5));
    /// ```
    #[must_use]
    pub fn halved(&self, level: u32) -> Self {
        let mut camera = self.clone();
        let share = 0.5f64.powi(level as i32);
        let intrinsics = &mut camera.intrinsics;
        intrinsics.focal_px *= share;
        intrinsics.center_px = (intrinsics.center_px + 0.5) * share - 0.5;
        intrinsics.width >>= level;
        intrinsics.height >>= level;
        camera
    }

    /// Checks the name ([`CameraId::check`]) and all numbers.
    ///
    /// # Errors
    /// [`CameraError`] names camera and field.
    pub fn validate(&self) -> Result<(), CameraError> {
        self.id.check()?;
        let camera = || self.id.clone();
        let i = &self.intrinsics;
        let not_finite = |field| CameraError::NotFinite { camera: camera(), field };
        if !i.focal_px.is_finite() || !i.center_px.is_finite() {
            return Err(not_finite("the camera matrix K"));
        }
        if !i.lens.coefficients().iter().all(|c| c.is_finite()) {
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
        range("rotation quaternion length", norm, (norm - 1.0).abs() < 1e-6, "1")?;
        let offset_ms = self.time_offset_nanos as f64 * 1e-6;
        range("time offset", offset_ms, offset_ms.abs() <= MAX_TIME_OFFSET_MS, "-1000 to 1000 ms")?;
        self.color.fault().map_or(Ok(()), |(field, value, expected)| range(field, value, false, expected))
    }
}

/// Cameras of a capture, in a fixed order that frame sets follow.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rig {
    /// Cameras in rig order.
    pub cameras: Vec<Camera>,
    /// Unit vector against gravity, in world axes.
    pub world_up: DVec3,
}

impl Rig {
    /// Returns the point closest to all optical axes in the least-squares sense, world metres.
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

    /// Checks all cameras, and that their names are unique.
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

    /// Returns the slot of a camera, `None` if the rig has none of this name.
    #[must_use]
    pub fn slot(&self, id: &CameraId) -> Option<usize> {
        self.cameras.iter().position(|camera| camera.id == *id)
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
            time_offset_nanos: 0,
            color: Default::default(),
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

    /// The quick test of a radial lens is a closed form of the one for rational lenses.
    #[test]
    fn a_radial_lens_is_valid_where_the_same_rational_one_is() {
        for k1 in [-0.6, -0.25, 0.0, 0.3] {
            for (k2, k3) in [(0.0, 0.0), (0.08, -0.02), (-0.1, 0.03), (0.4, 0.1)] {
                let radial = Lens::RadialTangential { radial: [k1, k2, k3], tangential: [0.0; 2] };
                let rational = Lens::Rational { radial: [k1, k2, k3, 0.0, 0.0, 0.0], tangential: [0.0; 2] };
                for step in 0..60 {
                    let radius = 0.05 * f64::from(step);
                    assert_eq!(radial.surely_grows(radius), rational.surely_grows(radius), "{k1} {k2} {k3} {radius}");
                }
                assert!((radial.valid_radius() - rational.valid_radius()).abs() < 1e-9, "{k1} {k2} {k3}");
            }
        }
    }

    #[test]
    fn ray_and_project_are_inverse_for_every_lens() {
        let lenses = [
            Lens::PINHOLE,
            Lens::RadialTangential { radial: [-0.3, 0.1, -0.02], tangential: [0.001, -0.002] },
            Lens::RadialTangential { radial: [0.12, -0.03, 0.0], tangential: [0.0, 0.0] },
            Lens::Fisheye { coefficients: [0.05, -0.01, 0.002, -0.0005] },
            Lens::Rational { radial: [0.4, 0.05, 0.001, 0.7, 0.1, 0.004], tangential: [0.001, -0.002] },
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
    fn a_rational_lens_is_cut_where_it_turns_and_at_its_pole() {
        let lens = |radial| Lens::Rational { radial, tangential: [0.0; 2] };
        // d/dr (r / (1 + r²)) = 0 at r = 1; 1 - 0.25 r² = 0 at r = 2.
        assert!((lens([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]).valid_radius() - 1.0).abs() < 1e-9);
        assert!((lens([0.0, 0.0, 0.0, -0.25, 0.0, 0.0]).valid_radius() - 2.0).abs() < 1e-9);
        let plain = Lens::RadialTangential { radial: [-0.2, 0.03, 0.01], tangential: [0.003, -0.001] };
        let same = Lens::Rational { radial: [-0.2, 0.03, 0.01, 0.0, 0.0, 0.0], tangential: [0.003, -0.001] };
        let point = DVec2::new(0.4, -0.7);
        assert_eq!((plain.distort(point), plain.valid_radius()), (same.distort(point), same.valid_radius()));
    }

    #[test]
    fn the_quick_check_never_lets_a_point_beyond_the_valid_radius_through() {
        let coefficients = [-0.9, -0.3, -0.01, 0.0, 0.02, 0.4];
        for (i, k1) in coefficients.into_iter().enumerate() {
            for (j, k2) in coefficients.into_iter().enumerate() {
                let k3 = coefficients[(i + 2 * j) % 6];
                for lens in [
                    Lens::RadialTangential { radial: [k1, k2, k3], tangential: [0.0; 2] },
                    Lens::Rational { radial: [k1, k2, k3, k3, k1, k2], tangential: [0.0; 2] },
                    Lens::Fisheye { coefficients: [k1, k2, k3, k1] },
                ] {
                    let valid = lens.valid_radius();
                    for share in [0.1, 0.5, 0.9, 0.999, 1.001, 1.1, 2.0, 10.0] {
                        let radius = share * valid;
                        let expected = radius <= valid || (valid >= 1e3 && lens.is_valid(DVec2::X * radius));
                        assert_eq!(lens.is_valid(DVec2::X * radius), expected, "{lens:?} {share}");
                        if radius < valid.min(100.0) {
                            let seen = lens.distort(DVec2::new(0.6, -0.8) * radius);
                            let (quick, slow) = (lens.undistort(seen), lens.undistort_within(seen, valid));
                            // On some of these lenses neither converges.
                            let same = match (quick, slow) {
                                (Some(quick), Some(slow)) => quick.distance(slow) < 1e-9 * (1.0 + slow.length()),
                                (quick, slow) => quick.is_none() && slow.is_none(),
                            };
                            assert!(same, "{lens:?} {share}: {quick:?} {slow:?}");
                        }
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
}

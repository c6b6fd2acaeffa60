//! Lenses of ROS `CameraInfo` and foxglove `CameraCalibration`.

use flyrig_types::{Camera, Intrinsics, Isometry, Lens, shortened};
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::recording::schemas::LensMessage;

/// Largest entry of a matrix where 0 is expected, and deviation from 1 of its last entry.
const ZERO: f64 = 1e-6;
/// Largest skew that has no measurable effect, pixels.
const MOST_SKEW: f64 = 0.01;

/// Projection of a camera's images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Projection {
    pub intrinsics: Intrinsics,
    /// Rotation from the camera's coordinate frame to the axes of its images.
    pub image_from_frame: DQuat,
}

/// Returns the projection of images of `size`; rectified images have the matrix P and no distortion.
///
/// # Errors
/// Explains what flyrig cannot model.
pub(super) fn projection(message: &LensMessage, size: (u32, u32), is_rectified: bool) -> Result<Projection, String> {
    let (width, height) = (message.width, message.height);
    if message.binning.iter().any(|&binning| binning > 1) {
        return Err(format!("its binning of {}x{} is not read", message.binning[0], message.binning[1]));
    }
    let [x, y, region_height, region_width] = message.region;
    if [x, y] != [0, 0] || ![[0, 0], [height, width]].contains(&[region_height, region_width]) {
        return Err(format!("its region of interest {region_width}x{region_height} at {x},{y} is not read"));
    }
    if (width, height) != size {
        return Err(format!("it is for images of {width}x{height}, but they are {}x{}", size.0, size.1));
    }
    let has_p = message.p.iter().any(|value| *value != 0.0);
    let mut image_from_frame = DQuat::IDENTITY;
    let (matrix, lens) = if is_rectified && has_p {
        let &[fx, skew, cx, tx, a, fy, cy, ty, b, c, one, d] = message.p.as_slice() else {
            return Err(format!("P has {} numbers, expected 12", message.p.len()));
        };
        if [tx, ty, d].iter().any(|value| value.is_nan() || value.abs() > ZERO) {
            return Err("P is that of the second camera of a stereo pair; record the unrectified images".to_owned());
        }
        image_from_frame = rectification(&message.r)?;
        ([fx, skew, cx, a, fy, cy, b, c, one], Lens::PINHOLE)
    } else {
        let matrix = <[f64; 9]>::try_from(message.k.as_slice());
        let matrix = matrix.map_err(|_| format!("K has {} numbers, expected 9", message.k.len()))?;
        (matrix, lens(message)?)
    };
    let [fx, skew, cx, a, fy, cy, b, c, one] = matrix;
    if fx.abs() < ZERO && fy.abs() < ZERO {
        return Err("the camera is not calibrated (its K is zero)".to_owned());
    }
    let is_zero = |value: &f64| value.is_finite() && value.abs() <= ZERO;
    if skew.is_nan() || skew.abs() > MOST_SKEW || ![a, b, c, one - 1.0].iter().all(is_zero) {
        return Err("its camera matrix has skew or an unusual shape, expected [fx 0 cx; 0 fy cy; 0 0 1]".to_owned());
    }
    let (focal_px, center_px) = (DVec2::new(fx, fy), DVec2::new(cx, cy));
    let intrinsics = Intrinsics { width, height, focal_px, center_px, lens };
    let checked = Camera::new("camera", intrinsics, Isometry::IDENTITY).validate();
    checked.map_err(|error| error.to_string().trim_start_matches("camera camera: ").to_owned())?;
    Ok(Projection { intrinsics, image_from_frame })
}

/// Returns the rotation of rectified images; zeros and no numbers are none.
fn rectification(r: &[f64]) -> Result<DQuat, String> {
    if r.iter().all(|value| *value == 0.0) {
        return Ok(DQuat::IDENTITY);
    }
    let rows = <[f64; 9]>::try_from(r).map_err(|_| format!("R has {} numbers, expected 9", r.len()))?;
    let matrix = DMat3::from_cols_array(&rows).transpose();
    let excess = matrix * matrix.transpose() - DMat3::IDENTITY;
    let is_rotation = matrix.is_finite() && matrix.determinant() > 0.0;
    if !is_rotation || excess.to_cols_array().iter().any(|value| value.abs() > 1e-4) {
        return Err("R is no rotation".to_owned());
    }
    Ok(DQuat::from_mat3(&matrix).normalize())
}

/// Returns the distortion of unrectified images.
fn lens(message: &LensMessage) -> Result<Lens, String> {
    let d = &message.d;
    if d.iter().any(|value| !value.is_finite()) {
        return Err("its distortion holds what is no number".to_owned());
    }
    let is_zero = d.iter().all(|value| *value == 0.0);
    // The models of OpenCV's pinhole: coefficients that are left out are 0.
    let opencv = |most: usize| {
        let at = |i: usize| d.get(i).copied().unwrap_or(0.0);
        let rest_is_zero = d.iter().skip(most).all(|value| *value == 0.0);
        let (radial, tangential) = ([at(0), at(1), at(4), at(5), at(6), at(7)], [at(2), at(3)]);
        match d.len() {
            0 | 4 | 5 | 8 | 12 | 14 if rest_is_zero => Some(if radial[3..].iter().any(|value| *value != 0.0) {
                Lens::Rational { radial, tangential }
            } else {
                Lens::RadialTangential { radial: [radial[0], radial[1], radial[2]], tangential }
            }),
            _ => None,
        }
    };
    let model = message.model.trim().to_lowercase();
    let found = match model.as_str() {
        "plumb_bob" | "radtan" => opencv(5),
        "rational_polynomial" => opencv(8),
        "equidistant" | "fisheye" | "kannala_brandt" => match *d.as_slice() {
            // Without coefficients the angle itself is the radius.
            [] => Some(Lens::Fisheye { coefficients: [0.0; 4] }),
            [k1, k2, k3, k4] => Some(Lens::Fisheye { coefficients: [k1, k2, k3, k4] }),
            _ => None,
        },
        "" | "none" | "pinhole" | "perspective" if is_zero => Some(Lens::PINHOLE),
        "" | "none" | "pinhole" | "perspective" => None,
        _ => {
            return Err(format!(
                "its distortion model '{}' is not known; known: plumb_bob, rational_polynomial, equidistant, fisheye, \
                 kannala_brandt",
                shortened(&message.model)
            ));
        }
    };
    found.ok_or_else(|| {
        format!("its distortion model '{}' with {} coefficients is not read", shortened(&message.model), d.len())
    })
}

impl Projection {
    /// Returns the pose of the images' axes from that of the camera's coordinate frame.
    pub fn pose(&self, frame_from_world: Isometry) -> Isometry {
        Isometry::new(self.image_from_frame, DVec3::ZERO) * frame_from_world
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(model: &str, d: &[f64]) -> LensMessage {
        LensMessage {
            width: 640,
            height: 480,
            model: model.to_owned(),
            d: d.to_vec(),
            k: vec![500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0],
            ..LensMessage::default()
        }
    }

    fn lens_of(model: &str, d: &[f64]) -> Result<Lens, String> {
        projection(&message(model, d), (640, 480), false).map(|found| found.intrinsics.lens)
    }

    #[test]
    fn every_model_keeps_its_coefficients_or_is_refused_by_name() {
        let radial = Lens::RadialTangential { radial: [0.1, 0.2, 0.5], tangential: [0.3, 0.4] };
        let rational = Lens::Rational { radial: [0.1, 0.2, 0.5, 0.6, 0.7, 0.8], tangential: [0.3, 0.4] };
        let eight = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8];
        let fisheye = Lens::Fisheye { coefficients: [0.1, 0.2, 0.3, 0.4] };
        for (model, d, lens) in [
            ("plumb_bob", &eight[..5], radial),
            ("plumb_bob", &[], Lens::PINHOLE),
            ("rational_polynomial", &eight, rational),
            ("rational_polynomial", &[&eight[..], &[0.0; 6]].concat(), rational),
            ("equidistant", &eight[..4], fisheye),
            ("fisheye", &eight[..4], fisheye),
            ("kannala_brandt", &eight[..4], fisheye),
            ("equidistant", &[0.0; 4], Lens::Fisheye { coefficients: [0.0; 4] }),
            ("", &[0.0; 5], Lens::PINHOLE),
        ] {
            assert_eq!(lens_of(model, d).unwrap(), lens, "{model} {d:?}");
        }
        for (model, d, text) in [
            ("fisheye62", &eight[..], "'fisheye62' is not known; known: plumb_bob"),
            ("double_sphere", &[], "'double_sphere' is not known"),
            ("plumb_bob", &eight, "'plumb_bob' with 8 coefficients"),
            ("equidistant", &eight[..5], "'equidistant' with 5 coefficients"),
            ("", &eight[..5], "'' with 5 coefficients"),
            ("plumb_bob", &[f64::NAN; 5], "no number"),
            ("rational_polynomial", &[0.1; 12], "with 12 coefficients"),
        ] {
            let error = lens_of(model, d).unwrap_err();
            assert!(error.contains(text), "{model} {d:?}: {error}");
        }
    }

    #[test]
    fn what_changes_the_projection_is_read_or_refused() {
        let refused = |change: &dyn Fn(&mut LensMessage), is_rectified| {
            let mut message = message("plumb_bob", &[0.1, 0.0, 0.0, 0.0, 0.0]);
            change(&mut message);
            projection(&message, (640, 480), is_rectified).unwrap_err()
        };
        assert!(refused(&|m| m.binning = [2, 2], false).contains("binning of 2x2"));
        assert!(refused(&|m| m.region = [8, 0, 480, 632], false).contains("region of interest 632x480 at 8,0"));
        assert!(refused(&|m| m.width = 1280, false).contains("for images of 1280x480, but they are 640x480"));
        assert!(refused(&|m| m.k = vec![0.0; 9], false).contains("not calibrated"));
        assert!(refused(&|m| m.k = vec![0.0; 4], false).contains("K has 4 numbers"));
        assert!(refused(&|m| m.k[1] = 3.0, false).contains("skew"));
        assert!(refused(&|m| m.k[4] = -1.0, false).contains("focal length fy is -1"));
        let p = [400.0, 0.0, 300.0, 0.0, 0.0, 400.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        assert!(refused(&|m| (m.p, m.p[3]) = (p.to_vec(), -40.0), true).contains("stereo pair"));
        // Rectified images have P, no distortion, and the axes of R.
        let turn = DQuat::from_rotation_y(0.1);
        let mut rectified = message("plumb_bob", &[0.1, 0.0, 0.0, 0.0, 0.0]);
        (rectified.p, rectified.r) = (p.to_vec(), DMat3::from_quat(turn).transpose().to_cols_array().to_vec());
        let found = projection(&rectified, (640, 480), true).unwrap();
        assert_eq!((found.intrinsics.focal_px, found.intrinsics.lens), (DVec2::splat(400.0), Lens::PINHOLE));
        let pose = found.pose(Isometry::new(DQuat::IDENTITY, DVec3::X));
        assert!(pose.translation.distance(turn * DVec3::X) < 1e-12 && pose.rotation.angle_between(turn) < 1e-6);
        assert_eq!(projection(&rectified, (640, 480), false).unwrap().intrinsics.focal_px, DVec2::new(500.0, 510.0));
    }
}

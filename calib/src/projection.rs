//! Projection with derivatives by the point and by the lens.

use flyrig_types::{Intrinsics, Lens};
use glam::{DMat2, DVec2, DVec3};

/// Smallest depth of a point that is projected, metres.
const LEAST_DEPTH_M: f64 = 1e-3;

/// Which coefficients of a lens are sought, from few to many.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum LensModel {
    /// k1.
    Radial1,
    /// k1, k2.
    Radial2,
    /// k1, k2, p1, p2.
    RadialTangential,
    /// k1, k2, p1, p2, k3.
    RadialTangential3,
}

/// Parameters that every model has: fx, fy, cx, cy.
const COMMON: usize = 4;

impl LensModel {
    /// All models.
    pub const ALL: [Self; 4] = [Self::Radial1, Self::Radial2, Self::RadialTangential, Self::RadialTangential3];

    /// Name for reports.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Radial1 => "k1",
            Self::Radial2 => "k1 k2",
            Self::RadialTangential => "k1 k2 p1 p2",
            Self::RadialTangential3 => "k1 k2 p1 p2 k3",
        }
    }

    /// Number of parameters, focal lengths and centre included.
    #[must_use]
    pub fn parameters(self) -> usize {
        COMMON
            + match self {
                Self::Radial1 => 1,
                Self::Radial2 => 2,
                Self::RadialTangential => 4,
                Self::RadialTangential3 => 5,
            }
    }

    /// Returns the intrinsics after a step of the parameters: fx, fy, cx, cy, then the coefficients.
    pub(crate) fn moved(self, from: &Intrinsics, step: &[f64]) -> Intrinsics {
        let at = |k: usize| step.get(COMMON + k).copied().unwrap_or(0.0);
        let lens = match from.lens {
            Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] } => {
                let (tangential, third) = match self {
                    Self::RadialTangential | Self::RadialTangential3 => ([p1 + at(2), p2 + at(3)], k3 + at(4)),
                    _ => ([p1, p2], k3),
                };
                let second = if self == Self::Radial1 { k2 } else { k2 + at(1) };
                Lens::RadialTangential { radial: [k1 + at(0), second, third], tangential }
            }
            // Its coefficients are not sought: calibration files cannot hold them.
            lens @ Lens::Fisheye { .. } => lens,
        };
        Intrinsics {
            focal_px: from.focal_px + DVec2::new(step[0], step[1]),
            center_px: from.center_px + DVec2::new(step[2], step[3]),
            lens,
            ..*from
        }
    }
}

/// Pixel of a point and its derivatives.
pub(crate) struct Projected {
    pub pixel: DVec2,
    /// By x, y, z of the point.
    pub by_point: [DVec2; 3],
    /// By the parameters of the lens model.
    pub by_lens: Vec<DVec2>,
}

/// Projects a point in camera axes; `None` behind the camera and beyond the lens's valid radius.
pub(crate) fn project(intrinsics: &Intrinsics, point: DVec3) -> Option<DVec2> {
    let ideal = ideal(intrinsics, point)?;
    Some(intrinsics.lens.distort(ideal) * intrinsics.focal_px + intrinsics.center_px)
}

fn ideal(intrinsics: &Intrinsics, point: DVec3) -> Option<DVec2> {
    let ideal = point.truncate() / point.z;
    let usable = point.is_finite()
        && point.z >= LEAST_DEPTH_M
        && intrinsics.focal_px.min_element() > 0.0
        && intrinsics.lens.is_valid(ideal);
    usable.then_some(ideal)
}

/// The same with derivatives.
pub(crate) fn project_with_derivatives(intrinsics: &Intrinsics, model: LensModel, point: DVec3) -> Option<Projected> {
    let ideal = ideal(intrinsics, point)?;
    let focal = intrinsics.focal_px;
    let distorted = intrinsics.lens.distort(ideal);
    let (by_ideal, coefficients) = derivatives(&intrinsics.lens, ideal);
    let (by_x, by_y) = (by_ideal.x_axis * focal, by_ideal.y_axis * focal);
    let by_point = [by_x / point.z, by_y / point.z, -(by_x * ideal.x + by_y * ideal.y) / point.z];
    let mut by_lens = vec![DVec2::new(distorted.x, 0.0), DVec2::new(0.0, distorted.y), DVec2::X, DVec2::Y];
    by_lens.extend(coefficients.into_iter().map(|by| by * focal).take(model.parameters() - COMMON));
    Some(Projected { pixel: distorted * focal + intrinsics.center_px, by_point, by_lens })
}

/// Derivatives of the distorted point by the ideal one, and by the coefficients in the order of the models.
fn derivatives(lens: &Lens, ideal: DVec2) -> (DMat2, [DVec2; 5]) {
    let (x, y) = (ideal.x, ideal.y);
    let r2 = ideal.length_squared();
    match *lens {
        Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] } => {
            let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
            let slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
            let mixed = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
            let by_ideal = DMat2::from_cols(
                DVec2::new(radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, mixed),
                DVec2::new(mixed, radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x),
            );
            let by_p1 = DVec2::new(2.0 * x * y, r2 + 2.0 * y * y);
            let by_p2 = DVec2::new(r2 + 2.0 * x * x, 2.0 * x * y);
            (by_ideal, [ideal * r2, ideal * r2 * r2, by_p1, by_p2, ideal * r2 * r2 * r2])
        }
        Lens::Fisheye { coefficients: [k1, k2, k3, k4] } => {
            let r = r2.sqrt();
            if r < 1e-9 {
                return (DMat2::IDENTITY, [DVec2::ZERO; 5]);
            }
            let theta = r.atan();
            let t2 = theta * theta;
            let distorted = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
            let by_theta = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
            let scale = distorted / r;
            let by_r = (by_theta / (1.0 + r2) - scale) / r;
            let outer = DMat2::from_cols(ideal * x, ideal * y);
            (DMat2::from_diagonal(DVec2::splat(scale)) + outer * (by_r / r), [DVec2::ZERO; 5])
        }
    }
}

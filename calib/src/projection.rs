//! Projection with derivatives by the point and by the lens.

use flyrig_types::{Intrinsics, Lens};
use glam::{DMat2, DVec2, DVec3};

/// Smallest depth of a projected point, metres.
const LEAST_DEPTH_M: f64 = 1e-3;

/// Coefficients of a lens that are estimated, from few to many. Fisheyes are a family of their own; applied to a
/// fisheye lens, any other model means its first coefficients.
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
    /// k1 to k4 of the angle.
    Fisheye,
    /// k1, k2, p1, p2, k3 to k6.
    Rational,
}

/// Common parameters of all models: fx, fy, cx, cy.
const COMMON: usize = 4;
/// Most coefficients of a model.
const COEFFICIENTS: usize = 8;

impl LensModel {
    /// All models.
    pub const ALL: [Self; 6] =
        [Self::Radial1, Self::Radial2, Self::RadialTangential, Self::RadialTangential3, Self::Fisheye, Self::Rational];

    /// Returns the name for reports.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Radial1 => "k1",
            Self::Radial2 => "k1 k2",
            Self::RadialTangential => "k1 k2 p1 p2",
            Self::RadialTangential3 => "k1 k2 p1 p2 k3",
            Self::Fisheye => "fisheye",
            Self::Rational => "rational",
        }
    }

    /// Returns the number of parameters, including focal lengths and centre.
    #[must_use]
    pub fn parameters(self) -> usize {
        COMMON
            + match self {
                Self::Radial1 => 1,
                Self::Radial2 => 2,
                Self::RadialTangential | Self::Fisheye => 4,
                Self::RadialTangential3 => 5,
                Self::Rational => COEFFICIENTS,
            }
    }

    /// Returns the lens in a form whose coefficients this model can change. A fisheye stays a fisheye.
    pub(crate) fn start(self, lens: Lens) -> Lens {
        match (self, lens.rational()) {
            (Self::Rational, Some((radial, tangential))) => Lens::Rational { radial, tangential },
            (Self::Fisheye, Some(_)) => Lens::Fisheye { coefficients: [0.0; 4] },
            _ => lens,
        }
    }

    /// Returns the intrinsics after a step of the parameters: fx, fy, cx, cy, then as many coefficients as the step has.
    pub(crate) fn moved(from: &Intrinsics, step: &[f64]) -> Intrinsics {
        let at = |k: usize| step.get(COMMON + k).copied().unwrap_or(0.0);
        let lens = match from.lens {
            Lens::Fisheye { coefficients: [k1, k2, k3, k4] } => {
                Lens::Fisheye { coefficients: [k1 + at(0), k2 + at(1), k3 + at(2), k4 + at(3)] }
            }
            lens @ (Lens::RadialTangential { .. } | Lens::Rational { .. }) => {
                let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = lens.rational().unwrap_or_default();
                let tangential = [p1 + at(2), p2 + at(3)];
                let above = [k1 + at(0), k2 + at(1), k3 + at(4)];
                match lens {
                    Lens::Rational { .. } => {
                        let [k1, k2, k3] = above;
                        Lens::Rational { radial: [k1, k2, k3, k4 + at(5), k5 + at(6), k6 + at(7)], tangential }
                    }
                    _ => Lens::RadialTangential { radial: above, tangential },
                }
            }
        };
        Intrinsics {
            focal_px: from.focal_px + DVec2::new(step[0], step[1]),
            center_px: from.center_px + DVec2::new(step[2], step[3]),
            lens,
            ..*from
        }
    }
}

/// Pixel of a point with its derivatives.
pub(crate) struct Projected {
    pub pixel: DVec2,
    /// Derivatives by x, y, z of the point.
    pub by_point: [DVec2; 3],
    /// Derivatives by the parameters of the lens model.
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

/// Projects as [`project`], with derivatives.
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

/// Returns the derivatives of the distorted point by the ideal one, and by the coefficients in the order of the models.
fn derivatives(lens: &Lens, ideal: DVec2) -> (DMat2, [DVec2; COEFFICIENTS]) {
    let (x, y) = (ideal.x, ideal.y);
    let r2 = ideal.length_squared();
    if let Lens::Fisheye { coefficients: [k1, k2, k3, k4] } = *lens {
        let r = r2.sqrt();
        if r < 1e-9 {
            return (DMat2::IDENTITY, [DVec2::ZERO; COEFFICIENTS]);
        }
        let theta = r.atan();
        let t2 = theta * theta;
        let distorted = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
        let by_theta = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
        let scale = distorted / r;
        let by_r = (by_theta / (1.0 + r2) - scale) / r;
        let outer = DMat2::from_cols(ideal * x, ideal * y);
        let by_ideal = DMat2::from_diagonal(DVec2::splat(scale)) + outer * (by_r / r);
        let mut power = theta / r;
        let by_coefficient = std::array::from_fn(|i| {
            power *= t2;
            if i < 4 { ideal * power } else { DVec2::ZERO }
        });
        return (by_ideal, by_coefficient);
    }
    let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = lens.rational().unwrap_or_default();
    let below = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    let radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * below;
    let above_slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let below_slope = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
    let slope = (above_slope - radial * below_slope) * below;
    let mixed = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
    let by_ideal = DMat2::from_cols(
        DVec2::new(radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, mixed),
        DVec2::new(mixed, radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x),
    );
    let by_p1 = DVec2::new(2.0 * x * y, r2 + 2.0 * y * y);
    let by_p2 = DVec2::new(r2 + 2.0 * x * x, 2.0 * x * y);
    let by_k = [r2, r2 * r2, r2 * r2 * r2].map(|power| ideal * (power * below));
    let by_d = by_k.map(|by| by * -radial);
    (by_ideal, [by_k[0], by_k[1], by_p1, by_p2, by_k[2], by_d[0], by_d[1], by_d[2]])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_agree_with_differences_for_every_lens_and_model() {
        let lenses = [
            Lens::RadialTangential { radial: [-0.2, 0.05, 0.01], tangential: [0.003, -0.002] },
            Lens::Rational { radial: [0.5, 0.1, 0.02, 0.8, 0.2, 0.03], tangential: [0.003, -0.002] },
            Lens::Fisheye { coefficients: [0.05, -0.01, 0.004, -0.001] },
        ];
        let point = DVec3::new(0.7, -0.5, 1.3);
        for lens in lenses {
            let at = |lens| Intrinsics {
                width: 640,
                height: 480,
                focal_px: DVec2::new(510.0, 500.0),
                center_px: DVec2::new(322.0, 238.0),
                lens,
            };
            for model in LensModel::ALL {
                // Of a fisheye, other models mean its first coefficients; a fisheye starts without any.
                let intrinsics = at(model.start(lens));
                let found = project_with_derivatives(&intrinsics, model, point).unwrap();
                assert!(found.pixel.distance(project(&intrinsics, point).unwrap()) < 1e-12);
                for (axis, by) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().zip(found.by_point) {
                    let moved = |by: f64| project(&intrinsics, point + axis * by).unwrap();
                    let numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                    assert!(numeric.distance(by) < 1e-5 * (1.0 + by.length()), "{lens:?} {axis}: {numeric} {by}");
                }
                assert_eq!(found.by_lens.len(), model.parameters());
                for (k, by) in found.by_lens.iter().enumerate() {
                    let moved = |by: f64| {
                        let mut step = vec![0.0; model.parameters()];
                        step[k] = by;
                        project(&LensModel::moved(&intrinsics, &step), point).unwrap()
                    };
                    let numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                    assert!(
                        numeric.distance(*by) < 1e-5 * (1.0 + by.length()),
                        "{lens:?} {model:?} {k}: {numeric} {by}"
                    );
                }
            }
        }
    }
}

//! Normalisation of Gaussians for processing at unit size.

use glam::{DMat3, DVec3, Vec3};

/// Similarity transform that moves the centres of Gaussians to zero mean and about unit spread.
///
/// HGM (Eq. 1) divides centres by their standard deviation but covariances by their largest eigenvalue. That stretches the
/// Gaussians relative to the distances between them, and the shape cannot be restored. Here one centre and one scale apply
/// to both: `(p - centre) / scale` and `covariance / scale²`. The scale is the power of two nearest to the standard
/// deviation, so that [`Self::restored`] returns the very same `f32` coordinates.
///
/// ```
/// use flyrig_mesh::Normalization;
/// use glam::Vec3;
///
/// let centers = [Vec3::new(0.1, 1.7, 0.3), Vec3::new(0.2, 0.1, -0.3)];
/// let unit = Normalization::from_centers(&centers);
/// assert_eq!(unit.restored(unit.normalized(centers[0])), centers[0]);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Normalization {
    center: DVec3,
    scale: f64,
}

impl Normalization {
    /// Measures mean and spread of the finite ones of `centers`, metres; the identity without any.
    #[must_use]
    pub fn from_centers(centers: &[Vec3]) -> Self {
        let finite = || centers.iter().filter(|center| center.is_finite()).map(|center| center.as_dvec3());
        let count = finite().count().max(1) as f64;
        // An f32 centre keeps the differences short enough for f64.
        let center = (finite().sum::<DVec3>() / count).as_vec3().as_dvec3();
        let variance = finite().map(|point| point.distance_squared(center)).sum::<f64>() / count;
        let exponent = (0.5 * f64::log2(variance)).round();
        let scale = if exponent.is_finite() { exponent.clamp(-100.0, 120.0).exp2() } else { 1.0 };
        Self { center, scale }
    }

    /// Returns the centre, metres.
    #[must_use]
    pub fn center(&self) -> DVec3 {
        self.center
    }

    /// Returns the length that becomes 1, metres.
    #[must_use]
    pub fn scale_m(&self) -> f64 {
        self.scale
    }

    /// Returns the normalised position of a point in metres.
    #[must_use]
    pub fn normalized(&self, point: Vec3) -> DVec3 {
        (point.as_dvec3() - self.center) / self.scale
    }

    /// Returns the position in metres of a normalised point; inverts [`Self::normalized`].
    #[must_use]
    pub fn restored(&self, point: DVec3) -> Vec3 {
        (point * self.scale + self.center).as_vec3()
    }

    /// Returns the normalised covariance of one in square metres.
    #[must_use]
    pub fn normalized_covariance(&self, covariance: DMat3) -> DMat3 {
        covariance * (self.scale * self.scale).recip()
    }

    /// Returns the covariance in square metres of a normalised one; inverts [`Self::normalized_covariance`].
    #[must_use]
    pub fn restored_covariance(&self, covariance: DMat3) -> DMat3 {
        covariance * (self.scale * self.scale)
    }

    /// Returns the normalised standard deviations of those in metres.
    #[must_use]
    pub fn normalized_scales(&self, scales: Vec3) -> DVec3 {
        scales.as_dvec3() / self.scale
    }

    /// Returns the standard deviations in metres of normalised ones; inverts [`Self::normalized_scales`].
    #[must_use]
    pub fn restored_scales(&self, scales: DVec3) -> Vec3 {
        (scales * self.scale).as_vec3()
    }
}

/// Clamps the standard deviations of a Gaussian (roots of the eigenvalues of its covariance), which leaves its axes as they
/// are; values that are not finite become `low`. Both bounds have the unit of `scales`; `low` wins over a smaller `high`.
#[must_use]
pub fn clamped_scales(scales: Vec3, low: f32, high: f32) -> Vec3 {
    let finite = |value: f32| if value.is_finite() { value } else { low };
    Vec3::new(finite(scales.x), finite(scales.y), finite(scales.z)).min(Vec3::splat(high)).max(Vec3::splat(low))
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn normalisation_is_undone_exactly() {
        let mut random = StdRng::seed_from_u64(3);
        for size in [1e-3, 1.0, 40.0] {
            let mut place = || (Vec3::from_array(random.random::<[f32; 3]>()) - 0.3) * size;
            let centers: Vec<Vec3> = (0..500).map(|_| place()).collect();
            let unit = Normalization::from_centers(&centers);
            let normalized: Vec<DVec3> = centers.iter().map(|center| unit.normalized(*center)).collect();
            let spread = (normalized.iter().map(|point| point.length_squared()).sum::<f64>() / 500.0).sqrt();
            let mean = normalized.iter().sum::<DVec3>() / 500.0;
            assert!((0.7..1.45).contains(&spread) && mean.length() < 1e-6, "{spread} {mean}");
            for (center, point) in centers.iter().zip(&normalized) {
                assert_eq!(unit.restored(*point), *center);
                assert_eq!(unit.restored_scales(unit.normalized_scales(*center)), *center);
            }
            let covariance = DMat3::from_cols_array(&[3.0, 0.2, 0.1, 0.2, 0.7, 0.3, 0.1, 0.3, 0.9]);
            assert_eq!(unit.restored_covariance(unit.normalized_covariance(covariance)), covariance);
        }
    }

    #[test]
    fn one_scale_applies_to_centers_and_covariances() {
        let unit = Normalization::from_centers(&[Vec3::ZERO, Vec3::X * 8.0]);
        let step = unit.normalized(Vec3::X) - unit.normalized(Vec3::ZERO);
        let covariance = unit.normalized_covariance(DMat3::IDENTITY);
        assert!((covariance.x_axis.x.sqrt() - step.length()).abs() < 1e-12);
        assert!((unit.normalized_scales(Vec3::ONE).x - step.length()).abs() < 1e-12);
    }

    #[test]
    fn poisoned_centers_and_scales_stay_harmless() {
        let none = Normalization::from_centers(&[Vec3::NAN]);
        assert_eq!(none, Normalization::from_centers(&[]));
        assert_eq!(none.normalized(Vec3::ONE), DVec3::ONE);
        let one = Normalization::from_centers(&[Vec3::ONE, Vec3::ONE]);
        assert_eq!(one.restored(one.normalized(Vec3::X)), Vec3::X);
        assert_eq!(clamped_scales(Vec3::new(f32::NAN, 0.0, 9.0), 0.5, 2.0), Vec3::new(0.5, 0.5, 2.0));
    }
}

//! Weighted sums of squared distances to planes and places, as one quadratic function.

use std::ops::{Add, AddAssign};

use glam::{DMat3, DVec3};

/// Quadratic function `x·A x + 2 b·x + c` of a place in metres: a sum of weighted squared distances, in weight times square metres.
#[derive(Debug, Clone, Copy, Default)]
pub struct Quadric {
    a: DMat3,
    b: DVec3,
    c: f64,
}

impl Quadric {
    /// The function that is zero everywhere.
    pub const ZERO: Self = Self { a: DMat3::ZERO, b: DVec3::ZERO, c: 0.0 };

    /// Returns the weighted squared distance to the plane through `place` with the unit `normal`.
    pub fn of_plane(normal: DVec3, place: DVec3, weight: f64) -> Self {
        let along = normal.dot(place);
        Self {
            a: DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z) * weight,
            b: normal * (-along * weight),
            c: along * along * weight,
        }
    }

    /// Returns the weighted squared distance to `place`.
    pub fn of_place(place: DVec3, weight: f64) -> Self {
        Self { a: DMat3::IDENTITY * weight, b: place * -weight, c: place.length_squared() * weight }
    }

    /// Returns the value at a place; rounding makes none negative.
    pub fn at(&self, place: DVec3) -> f64 {
        (place.dot(self.a * place) + 2.0 * self.b.dot(place) + self.c).max(0.0)
    }
}

impl Add for Quadric {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { a: self.a + other.a, b: self.b + other.b, c: self.c + other.c }
    }
}

impl AddAssign for Quadric {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quadrics_are_sums_of_squared_distances() {
        let at = |i: usize| DVec3::new((1.3 * i as f64).sin(), (2.1 * i as f64).cos(), (0.7 * i as f64).sin());
        let (mut sum, mut plain) = (Quadric::ZERO, 0.0);
        let place = DVec3::new(0.3, -1.2, 0.8);
        for i in 0..20 {
            let (normal, point, weight) = (at(3 * i + 1).normalize(), at(3 * i), 0.1 + i as f64);
            sum += Quadric::of_plane(normal, point, weight);
            plain += weight * (place - point).dot(normal).powi(2);
            sum += Quadric::of_place(point, 0.5 * weight);
            plain += 0.5 * weight * (place - point).length_squared();
        }
        assert!((sum.at(place) / plain - 1.0).abs() < 1e-12, "{} {plain}", sum.at(place));
        assert!(Quadric::of_plane(DVec3::Z, DVec3::splat(7.0), 1.0).at(DVec3::new(3.0, 1.0, 7.0)) < 1e-12);
        assert!(
            Quadric::of_plane(DVec3::NAN, DVec3::ZERO, 1.0).at(DVec3::ONE).abs() <= 0.0,
            "a poisoned quadric costs nothing"
        );
    }
}

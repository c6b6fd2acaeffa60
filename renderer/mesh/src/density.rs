//! Spacing of surface points, and the surface area that each of them stands for.

use std::f32::consts::PI;

use flyrig_body::PointGrid;
use glam::Vec3;
use rayon::prelude::*;

use crate::error::MeshError;
use crate::points::OrientedPoints;

/// Points whose neighbours are searched among all others for a first estimate of the spacing.
const SAMPLES: usize = 64;
/// Neighbour whose distance measures the density.
const NEIGHBOR: usize = 12;
/// Neighbours with an agreeing normal that an area is based on; with fewer the radius is doubled.
const ENOUGH: usize = 8;
/// Cosine between the normals of two points that may lie on one patch of surface: 60 degrees.
const SAME_PATCH: f32 = 0.5;

/// Local density of surface points.
#[derive(Debug, Clone)]
pub struct Density {
    spacing_m: f32,
    areas: Vec<f32>,
}

impl Density {
    /// Measures the density from the numbers of neighbours with agreeing normals.
    ///
    /// # Errors
    /// [`MeshError::Coincident`] if the spacing is zero, and for no points.
    pub fn measure(points: &OrientedPoints) -> Result<Self, MeshError> {
        let coincident = MeshError::Coincident { count: points.len() };
        let first = first_spacing(points.positions());
        if !first.is_finite() || first <= 0.0 {
            return Err(coincident);
        }
        let radius = 3.0 * first;
        let grid = PointGrid::new(points.positions(), radius);
        let areas: Vec<f32> =
            (0..points.len()).into_par_iter().with_min_len(256).map(|i| area(points, &grid, i, radius)).collect();
        let spacing_m = median(areas.clone()).sqrt();
        if spacing_m.is_finite() && spacing_m > 0.0 { Ok(Self { spacing_m, areas }) } else { Err(coincident) }
    }

    /// Returns the median spacing: the side of the square of surface per point, metres.
    #[must_use]
    pub fn spacing_m(&self) -> f32 {
        self.spacing_m
    }

    /// Returns the surface per point, square metres.
    #[must_use]
    pub fn areas(&self) -> &[f32] {
        &self.areas
    }
}

/// Returns the median of finite values; 0 without any.
pub fn median(mut values: Vec<f32>) -> f32 {
    let at = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(at, f32::total_cmp).1 }
}

/// Returns a first estimate of the spacing from a sample of the positions; 0 without any.
pub(crate) fn first_spacing(positions: &[Vec3]) -> f32 {
    let step = positions.len().div_ceil(SAMPLES).max(1);
    let spacing = |at: usize| {
        let own = positions[at];
        let mut squared: Vec<f32> = positions.iter().map(|other| own.distance_squared(*other)).collect();
        let neighbor = NEIGHBOR.min(squared.len() - 1);
        let radius_squared = *squared.select_nth_unstable_by(neighbor, f32::total_cmp).1;
        (PI * radius_squared / neighbor.max(1) as f32).sqrt()
    };
    median((0..positions.len()).into_par_iter().step_by(step).map(spacing).collect())
}

fn area(points: &OrientedPoints, grid: &PointGrid, at: usize, first_radius: f32) -> f32 {
    let (own, normal) = (points.positions()[at], points.normals()[at]);
    let mut radius = first_radius;
    for round in 0..3 {
        let mut count = 0;
        grid.near_box(own - radius, own + radius, |other, position| {
            let near = own.distance_squared(position) <= radius * radius;
            count += usize::from(near && normal.dot(points.normals()[other]) > SAME_PATCH);
        });
        if count > ENOUGH || round == 2 {
            return PI * radius * radius / count.max(1) as f32;
        }
        radius *= 2.0;
    }
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::OrientedPoint;

    #[test]
    fn two_plates_have_the_spacing_of_one() {
        let plate = |side: f32| {
            (0..60 * 60).map(move |i| OrientedPoint {
                position: Vec3::new((i % 60) as f32 * 0.004, (i / 60) as f32 * 0.004, side * 0.003),
                normal: Vec3::Z * side,
                weight: 1.0,
                uncertainty_m: 0.001,
            })
        };
        let density = Density::measure(&OrientedPoints::from_rows(plate(-1.0).chain(plate(1.0)))).unwrap();
        assert!((density.spacing_m() - 0.004).abs() < 0.0005, "{}", density.spacing_m());
        let inner = density.areas()[30 * 60 + 30];
        assert!((inner - 1.6e-5).abs() < 3e-6, "{inner}");
    }

    #[test]
    fn coincident_points_are_an_error() {
        let row = OrientedPoint { position: Vec3::ONE, normal: Vec3::Z, weight: 1.0, uncertainty_m: 0.0 };
        for count in [0, 1, 40] {
            let points = OrientedPoints::from_rows(vec![row; count]);
            assert_eq!(Density::measure(&points).err(), Some(MeshError::Coincident { count }));
        }
    }
}

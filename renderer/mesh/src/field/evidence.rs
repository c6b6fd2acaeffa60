//! Signed distance at one voxel from the points around it.

use glam::Vec3;

use crate::points::OrientedPoints;
use crate::settings::{Fusion, FusionSettings};

/// Largest distance along the surface to an accepted point, in standard deviations of the decay: tangent planes are not
/// extrapolated into holes.
const REACH: f32 = 2.0;

/// Points around a few voxels, as columns.
#[derive(Debug, Default)]
pub struct Nearby {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    weights: Vec<f32>,
    /// Squared distances to the voxel in turn.
    squared: Vec<f32>,
    /// Decay by distance to the voxel in turn, 1 for the nearest point.
    decay: Vec<f32>,
}

impl Nearby {
    /// Removes all points.
    pub fn clear(&mut self) {
        self.positions.clear();
        self.normals.clear();
        self.weights.clear();
    }

    /// Adds point `at` of `points`.
    pub fn push(&mut self, points: &OrientedPoints, at: usize) {
        self.positions.push(points.positions()[at]);
        self.normals.push(points.normals()[at]);
        self.weights.push(points.weights()[at]);
    }

    /// Takes over those points of `other` that lie within `radius` of the box.
    pub fn select(&mut self, other: &Self, low: Vec3, high: Vec3, radius: f32) {
        self.clear();
        for (i, position) in other.positions.iter().enumerate() {
            if position.distance_squared(position.clamp(low, high)) <= radius * radius {
                self.positions.push(*position);
                self.normals.push(other.normals[i]);
                self.weights.push(other.weights[i]);
            }
        }
    }

    /// Returns the signed distance at `center`, metres; `None` without accepted points.
    pub fn distance(&mut self, center: Vec3, settings: &FusionSettings, fusion: Fusion) -> Option<f32> {
        self.squared.clear();
        self.squared.extend(self.positions.iter().map(|position| position.distance_squared(center)));
        match fusion {
            Fusion::Hgm => self.hgm(center, settings),
            Fusion::Naive => self.naive(center, settings),
        }
    }

    /// Computes HGM Eq. 18. All decays are relative to the nearest point's, which cancels in the mean and cannot vanish.
    fn hgm(&mut self, center: Vec3, settings: &FusionSettings) -> Option<f32> {
        let limit = settings.truncation_m * settings.truncation_m;
        let least = self.squared.iter().copied().reduce(f32::min).filter(|least| *least <= limit)?;
        let nearest = self.nearest(center, limit)?;
        let rate = 0.5 / (settings.decay_m * settings.decay_m);
        self.decay.clear();
        self.decay.extend(self.squared.iter().map(|squared| match *squared <= limit {
            true => ((least - squared) * rate).exp(),
            false => 0.0,
        }));
        let cosine = settings.angle_rad.cos();
        // Half the standard deviation lets the nearest point dominate: the fourth power of the decay.
        let first = self.mean_normal(self.normals[nearest], cosine, |decay| (decay * decay) * (decay * decay));
        let normal = self.mean_normal(first, cosine, |decay| decay);
        let (mut sum, mut total, mut reach) = (0.0, 0.0, f32::INFINITY);
        for (i, own) in self.normals.iter().enumerate() {
            if self.decay[i] > 0.0 && own.dot(normal) > cosine {
                let distance = (center - self.positions[i]).dot(*own);
                let weight = f64::from(self.weights[i]) * f64::from(self.decay[i]);
                sum += weight * f64::from(distance.clamp(-settings.truncation_m, settings.truncation_m));
                total += weight;
                reach = reach.min(self.squared[i] - distance * distance);
            }
        }
        let known = total > 0.0 && reach <= (REACH * settings.decay_m).powi(2);
        known.then(|| (sum / total) as f32)
    }

    /// Returns the nearest point within the limit. Distance along the surface counts twice: beside a sharp edge, the side that
    /// faces the voxel wins over the one whose plane passes through it.
    fn nearest(&self, center: Vec3, limit: f32) -> Option<usize> {
        let score = |i: usize| {
            let along = (center - self.positions[i]).dot(self.normals[i]);
            2.0 * self.squared[i] - along * along
        };
        let near = (0..self.squared.len()).filter(|i| self.squared[*i] <= limit);
        near.map(|i| (score(i), i)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, i)| i)
    }

    /// Returns the unit mean of the normals within the angle of `around`, or `around` if they cancel out.
    fn mean_normal(&self, around: Vec3, cosine: f32, emphasis: impl Fn(f32) -> f32) -> Vec3 {
        let accepted = self.normals.iter().enumerate().filter(|(_, normal)| normal.dot(around) > cosine);
        // f64 keeps weights of any size apart from zero.
        let sum = accepted.fold(glam::DVec3::ZERO, |sum, (i, normal)| {
            sum + normal.as_dvec3() * (f64::from(self.weights[i]) * f64::from(emphasis(self.decay[i])))
        });
        sum.try_normalize().map_or(around, glam::DVec3::as_vec3)
    }

    fn naive(&self, center: Vec3, settings: &FusionSettings) -> Option<f32> {
        let limit = settings.truncation_m * settings.truncation_m;
        let (mut sum, mut count) = (0.0, 0.0);
        for (i, own) in self.normals.iter().enumerate().filter(|(i, _)| self.squared[*i] <= limit) {
            let distance = (center - self.positions[i]).dot(*own);
            sum += f64::from(distance.clamp(-settings.truncation_m, settings.truncation_m));
            count += 1.0;
        }
        (count > 0.0).then(|| (sum / count) as f32)
    }
}

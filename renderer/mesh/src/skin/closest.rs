//! Closest points on a template's triangles, by a grid of the triangles' bounds.

use std::collections::HashMap;

use flyrig_body::{SkinWeights, Template};
use glam::{IVec3, Vec3};

use crate::triangle::closest_on_triangle;

/// Side of a cell, metres: about the longest edge of the built-in body.
const CELL_M: f32 = 0.02;
/// Most cells that one triangle is entered into; larger ones are tested for every point.
const MOST_CELLS: i32 = 4096;
/// Distance up to which [`ClosestPoints::nearest`] searches cell by cell before it tests all triangles, metres.
const SEARCHED_M: f32 = 0.16;

/// Point on a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Found {
    pub triangle: u32,
    /// Weights of the corners, sum 1.
    pub barycentric: [f32; 3],
    pub distance_squared: f32,
}

impl Found {
    /// Blends the skin weights of the triangle's corners.
    pub fn weights(&self, template: &Template) -> Option<SkinWeights> {
        let corners = template.triangles.get(self.triangle as usize)?;
        let mut influences = Vec::with_capacity(12);
        for (corner, share) in corners.iter().zip(self.barycentric) {
            let skin = template.skin.get(*corner as usize)?;
            influences.extend(skin.joints.iter().zip(skin.weights).map(|(joint, weight)| (*joint, share * weight)));
        }
        SkinWeights::strongest(&influences)
    }
}

/// Triangles of a template, by the cells that they touch.
#[derive(Debug)]
pub(super) struct ClosestPoints {
    /// Corners of each triangle; `None` for one that has no area or whose corners do not exist.
    corners: Vec<Option<[Vec3; 3]>>,
    cells: HashMap<IVec3, Vec<u32>>,
    /// Triangles that are too large for the grid.
    large: Vec<u32>,
}

impl ClosestPoints {
    /// Sorts the triangles into cells.
    pub fn new(template: &Template) -> Self {
        let corner = |i: &u32| template.positions.get(*i as usize).copied().filter(|p| p.is_finite());
        let of = |[a, b, c]: &[u32; 3]| {
            let corners = [corner(a)?, corner(b)?, corner(c)?];
            let area = (corners[1] - corners[0]).cross(corners[2] - corners[0]).length();
            Some(corners).filter(|_| area > 1e-12)
        };
        let corners: Vec<Option<[Vec3; 3]>> = template.triangles.iter().map(of).collect();
        let (mut cells, mut large) = (HashMap::<IVec3, Vec<u32>>::new(), Vec::new());
        for (i, corners) in (0u32..).zip(&corners) {
            let Some([a, b, c]) = corners else { continue };
            let (low, high) = (cell(a.min(*b).min(*c)), cell(a.max(*b).max(*c)));
            let size = (high - low).as_i64vec3() + 1;
            if size.element_product() > i64::from(MOST_CELLS) {
                large.push(i);
                continue;
            }
            for z in low.z..=high.z {
                for y in low.y..=high.y {
                    for x in low.x..=high.x {
                        cells.entry(IVec3::new(x, y, z)).or_default().push(i);
                    }
                }
            }
        }
        Self { corners, cells, large }
    }

    /// Returns the unit normal of a triangle; zero for one without area.
    pub fn normal(&self, triangle: u32) -> Vec3 {
        let corners = self.corners.get(triangle as usize).copied().flatten();
        corners.map_or(Vec3::ZERO, |[a, b, c]| (b - a).cross(c - a).normalize_or_zero())
    }

    /// Returns the closest point within a distance, metres, on the triangles that `accepts` takes. Of equally close ones, that of the
    /// lowest triangle.
    pub fn within(&self, from: Vec3, distance_m: f32, accepts: impl Fn(u32) -> bool) -> Option<Found> {
        if !from.is_finite() || self.corners.is_empty() {
            return None;
        }
        let reach = (distance_m.clamp(0.0, SEARCHED_M) / CELL_M).ceil() as i32;
        let home = cell(from);
        let mut best = Best { limit: distance_m * distance_m, found: None };
        let mut test = |triangle: u32| {
            if let Some(corners) = self.corners[triangle as usize]
                && accepts(triangle)
            {
                best.offer(triangle, from, corners);
            }
        };
        self.large.iter().for_each(|triangle| test(*triangle));
        for z in -reach..=reach {
            for y in -reach..=reach {
                for x in -reach..=reach {
                    let inside = self.cells.get(&(home + IVec3::new(x, y, z)));
                    inside.into_iter().flatten().for_each(|triangle| test(*triangle));
                }
            }
        }
        best.found
    }

    /// Returns the closest point at any distance and angle.
    pub fn nearest(&self, from: Vec3) -> Option<Found> {
        self.within(from, SEARCHED_M, |_| true).or_else(|| {
            let mut best = Best { limit: f32::INFINITY, found: None };
            for (triangle, corners) in (0u32..).zip(&self.corners) {
                if let Some(corners) = corners.filter(|_| from.is_finite()) {
                    best.offer(triangle, from, corners);
                }
            }
            best.found
        })
    }
}

struct Best {
    /// Squared distance beyond which points are not taken.
    limit: f32,
    found: Option<Found>,
}

impl Best {
    fn offer(&mut self, triangle: u32, from: Vec3, corners: [Vec3; 3]) {
        let barycentric = closest_on_triangle(from, corners);
        let place: Vec3 = corners.iter().zip(barycentric).map(|(corner, weight)| *corner * weight).sum();
        let distance_squared = place.distance_squared(from);
        let is_closer = match &self.found {
            Some(found) => (distance_squared, triangle) < (found.distance_squared, found.triangle),
            None => distance_squared <= self.limit,
        };
        if is_closer {
            self.found = Some(Found { triangle, barycentric, distance_squared });
        }
    }
}

fn cell(point: Vec3) -> IVec3 {
    (point / CELL_M).clamp(Vec3::splat(-1e6), Vec3::splat(1e6)).floor().as_ivec3()
}

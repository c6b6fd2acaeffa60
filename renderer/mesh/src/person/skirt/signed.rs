//! Signed distances to a triangle mesh and to oriented points.

use flyrig_body::{PointGrid, Template};
use glam::Vec3;

use crate::nearest::Surface;

/// Signed distance to a surface, and the way out of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Signed {
    /// Distance, metres; negative behind the surface.
    pub distance_m: f32,
    /// Unit normal of the nearest place.
    pub normal: Vec3,
}

impl Signed {
    fn of(point: Vec3, place: Vec3, normal: Vec3) -> Self {
        let away = point - place;
        Self { distance_m: away.length() * if away.dot(normal) < 0.0 { -1.0 } else { 1.0 }, normal }
    }
}

/// Triangles with normals of their vertices; an open surface goes on beyond its border as far as signs are concerned.
#[derive(Debug)]
pub(super) struct SignedSurface {
    surface: Surface,
    normals: Vec<[Vec3; 3]>,
}

impl SignedSurface {
    /// Takes the triangles of a template, which must be a valid one, that `is_part` accepts by their corners.
    pub fn new(template: &Template, is_part: impl Fn(&[u32; 3]) -> bool) -> Self {
        let triangles: Vec<[u32; 3]> = template.triangles.iter().filter(|t| is_part(t)).copied().collect();
        let normals = triangles.iter().map(|t| t.map(|i| template.normals[i as usize])).collect();
        Self { surface: Surface::of(&template.positions, &triangles), normals }
    }

    /// Takes all triangles, with indices in range.
    pub fn of_mesh(positions: &[Vec3], normals: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let normals = triangles.iter().map(|t| t.map(|i| normals[i as usize])).collect();
        Self { surface: Surface::of(positions, triangles), normals }
    }

    /// Returns the distance from the surface; `None` without triangles.
    pub fn at(&self, point: Vec3) -> Option<Signed> {
        let (place, normal) = self.nearest(point)?;
        Some(Signed::of(point, place, normal))
    }

    /// Returns the nearest place and its unit normal.
    pub fn nearest(&self, point: Vec3) -> Option<(Vec3, Vec3)> {
        let nearest = self.surface.search(point)?;
        let corners = self.normals.get(nearest.triangle as usize)?;
        let normal: Vec3 = corners.iter().zip(nearest.barycentric).map(|(normal, weight)| *normal * weight).sum();
        Some((nearest.place, normal.normalize_or_zero()))
    }
}

/// Oriented points within a reach.
#[derive(Debug)]
pub(super) struct SignedPoints {
    grid: PointGrid,
    rows: Vec<(Vec3, Vec3)>,
    reach_m: f32,
}

impl SignedPoints {
    /// Sorts points, given by finite position, metres, and unit normal.
    pub fn new(rows: Vec<(Vec3, Vec3)>, reach_m: f32) -> Self {
        let positions: Vec<Vec3> = rows.iter().map(|(position, _)| *position).collect();
        Self { grid: PointGrid::new(&positions, reach_m), rows, reach_m }
    }

    /// Returns the positions in their order.
    pub fn places(&self) -> impl Iterator<Item = Vec3> + '_ {
        self.rows.iter().map(|(place, _)| *place)
    }

    /// Returns the distance from the nearest point, the first of equally near ones; `None` beyond the reach.
    pub fn at(&self, point: Vec3) -> Option<Signed> {
        let mut best: Option<(f32, usize)> = None;
        if self.rows.is_empty() || !point.is_finite() {
            return None;
        }
        self.grid.within(point, self.reach_m, |i, squared| {
            if best.is_none_or(|best| (squared, i) < best) {
                best = Some((squared, i));
            }
        });
        let (place, normal) = self.rows[best?.1];
        Some(Signed::of(point, place, normal))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;
    use glam::DVec3;

    fn bumpy() -> (Vec<Vec3>, Vec<Vec3>, Vec<[u32; 3]>) {
        let mesh = shapes::bumpy_sphere(16);
        (mesh.positions.clone(), mesh.normals(), mesh.triangles)
    }

    #[test]
    fn distances_are_those_of_a_search_through_everything_in_f64() {
        let (positions, normals, triangles) = bumpy();
        let surface = SignedSurface::of_mesh(&positions, &normals, &triangles);
        let rows: Vec<(Vec3, Vec3)> = positions.iter().copied().zip(normals.iter().copied()).collect();
        let centre = positions.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / positions.len() as f64;
        let radius = positions.iter().map(|p| p.as_dvec3().distance(centre)).fold(0.0, f64::max);
        let reach = 0.3 * radius;
        let points = SignedPoints::new(rows, reach as f32);
        let (mut inside, mut beyond) = (0, 0);
        for i in 0..200 {
            let k = i as f64;
            let direction = DVec3::new(k.sin(), (1.7 * k).sin(), (2.3 * k).cos()).normalize();
            // Not on the surface, where rounding decides on the side.
            let point = centre + direction * (radius * (0.03 + 0.2 * (i % 10) as f64));
            let squared = |place: &Vec3| (place.as_dvec3() - point).length_squared();
            let nearest =
                (0..positions.len()).min_by(|a, b| squared(&positions[*a]).total_cmp(&squared(&positions[*b])));
            let nearest = nearest.unwrap();
            let away = point - positions[nearest].as_dvec3();
            let expected = away.length() * if away.dot(normals[nearest].as_dvec3()) < 0.0 { -1.0 } else { 1.0 };
            match points.at(point.as_vec3()) {
                Some(found) => assert!((f64::from(found.distance_m) - expected).abs() < 1e-5, "{found:?} {expected}"),
                None => {
                    beyond += 1;
                    assert!(expected.abs() > reach - 1e-5, "{expected}");
                }
            }
            // The winding of the closed mesh says on which side a point is.
            let solid: f64 = triangles
                .iter()
                .map(|t| {
                    let [a, b, c] = t.map(|i| positions[i as usize].as_dvec3() - point);
                    let (la, lb, lc) = (a.length(), b.length(), c.length());
                    let down = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
                    2.0 * a.dot(b.cross(c)).atan2(down)
                })
                .sum();
            let found = surface.at(point.as_vec3()).unwrap();
            assert_eq!(found.distance_m < 0.0, solid > std::f64::consts::TAU, "{found:?} at {point}");
            assert!(f64::from(found.distance_m.abs()) <= expected.abs() + 1e-5);
            inside += usize::from(found.distance_m < 0.0);
        }
        assert!(inside > 20 && inside < 180 && beyond > 20, "{inside} {beyond}");
    }

    #[test]
    fn nothing_and_points_that_are_no_numbers_have_no_distance() {
        let nothing = SignedSurface::of_mesh(&[], &[], &[]);
        assert!(nothing.at(Vec3::ZERO).is_none() && SignedPoints::new(Vec::new(), 0.1).at(Vec3::ZERO).is_none());
        let (positions, normals, triangles) = bumpy();
        let surface = SignedSurface::of_mesh(&positions, &normals, &triangles);
        let points = SignedPoints::new(positions.into_iter().zip(normals).collect(), 0.4);
        for point in [Vec3::NAN, Vec3::INFINITY, Vec3::new(0.0, f32::NAN, 0.0)] {
            assert!(surface.at(point).is_none() && points.at(point).is_none(), "{point}");
        }
    }
}

//! Thickness of a skirt's wall.

use std::time::Instant;

use glam::Vec3;
use rayon::prelude::*;

use super::signed::SignedSurface;
use super::{Hollow, SHEET_M, Side};
use crate::finish::untangle::untangle;
use crate::{ShellReport, TriMesh};

/// Thicknesses of the wall that are tried in turn, metres.
const SHEETS_M: [f32; 3] = [SHEET_M, 2.0 * SHEET_M, 4.0 * SHEET_M];
/// Farthest move of a vertex, in thicknesses of the cut wall.
const FARTHEST: f32 = 2.0;

impl Hollow {
    /// Returns the side of each vertex.
    fn sides(&self, mesh: &TriMesh) -> Vec<Side> {
        let normals = mesh.normals();
        let rows = mesh.positions.par_iter().zip(&normals).with_min_len(256);
        rows.map(|(position, normal)| self.side(*position, *normal)).collect()
    }

    /// Thins the skirt of a finished mesh. Returns the side of each vertex and the measures. `hollow_s` are the seconds before.
    pub fn shell(&self, mesh: &mut TriMesh, hollow_s: f64) -> (Vec<Side>, ShellReport) {
        let started = Instant::now();
        let sides = self.sides(mesh);
        let thick_vertices = self.thin(mesh, &sides);
        let areas: Vec<f64> = (0..mesh.triangles.len())
            .map(|i| {
                let [a, b, c] = mesh.corners(i);
                0.5 * (b - a).cross(c - a).length()
            })
            .collect();
        let whole = areas.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let share = |side: Side| {
            let own = |t: &[u32; 3]| t.iter().filter(|i| sides[**i as usize] == side).count() as f64 / 3.0;
            mesh.triangles.iter().zip(&areas).map(|(t, area)| own(t) * area).sum::<f64>() / whole
        };
        let report = ShellReport {
            wall_share: share(Side::Wall),
            hidden_share: share(Side::Hidden),
            thick_vertices,
            seconds: [hollow_s, started.elapsed().as_secs_f64()],
        };
        (sides, report)
    }

    /// Moves the inner side of the skirt to two millimetres behind its outer side, or a little deeper where it would intersect itself.
    /// Returns the number of vertices that stayed where they were.
    pub(super) fn thin(&self, mesh: &mut TriMesh, sides: &[Side]) -> usize {
        let normals = mesh.normals();
        let is_outer = |i: u32| {
            let (place, normal) = (mesh.positions[i as usize], normals[i as usize]);
            let outwards = self.depth(place).filter(|skirt| skirt.distance_m.abs() < 0.5 * self.wall_m);
            sides[i as usize] == Side::Seen && outwards.is_some_and(|skirt| skirt.normal.dot(normal) > 0.0)
        };
        let is_outer: Vec<bool> = (0..mesh.positions.len() as u32).into_par_iter().map(is_outer).collect();
        let outer = mesh.triangles.iter().filter(|t| t.iter().all(|i| is_outer[*i as usize]));
        let outer: Vec<[u32; 3]> = outer.copied().collect();
        let outer = SignedSurface::of_mesh(&mesh.positions, &normals, &outer);
        let before = mesh.positions.clone();
        let mut thick: Vec<usize> = (0..sides.len()).filter(|i| sides[*i] == Side::Wall).collect();
        for sheet_m in SHEETS_M {
            let moved = thick.par_iter().with_min_len(256).map(|i| self.behind(&outer, before[*i], sheet_m));
            let moved: Vec<Vec3> = moved.collect();
            thick.iter().zip(moved).for_each(|(i, place)| mesh.positions[*i] = place);
            untangle(mesh, &before);
            thick.retain(|i| mesh.positions[*i] == before[*i]);
        }
        thick.len()
    }

    /// Returns where a vertex of the inner side lies behind the outer one in a sheet of this thickness. Depths shrink in proportion, so that
    /// the lower edge does not fold; a vertex far from the outer side stays.
    fn behind(&self, outer: &SignedSurface, vertex: Vec3, sheet_m: f32) -> Vec3 {
        let Some((place, normal)) = outer.nearest(vertex) else { return vertex };
        let depth_m = (place - vertex).dot(normal);
        let is_near = place.distance(vertex) < FARTHEST * self.wall_m && depth_m > sheet_m;
        if is_near { place - normal * (sheet_m * (depth_m / self.wall_m).min(1.0)) } else { vertex }
    }
}

//! Neighbours of Gaussians along the surface.

use std::ops::Range;

use glam::Vec3;
use rayon::prelude::*;

use crate::{SurfaceGaussians, Template};

/// Nearest neighbours that each Gaussian links to; links go both ways.
const LINKS: usize = 8;

/// Longest link, in mean spacings. Evenly spaced points have several neighbours within it.
const REACH_SPACINGS: f32 = 2.5;

/// Marker of a missing neighbour.
const NONE: u32 = u32::MAX;

/// Undirected weighted links in compressed rows; those of `i` are `links[starts[i]..starts[i + 1]]`.
pub(crate) struct SurfaceLinks {
    starts: Vec<u32>,
    links: Vec<(u32, f32)>,
}

impl SurfaceLinks {
    /// Links each Gaussian to the nearest ones that the mesh reaches within their neighbourhood. Lips, toes or thighs that touch are
    /// not linked, because the path along the mesh is longer.
    pub fn new(template: &Template, gaussians: &SurfaceGaussians) -> Self {
        let mesh = MeshNeighborhoods::new(template);
        let reach = REACH_SPACINGS * (mesh.area / gaussians.len() as f32).sqrt();
        let by_triangle = ByTriangle::new(template.triangles.len(), gaussians);
        let scratch = || (vec![u32::MAX; template.triangles.len()], Vec::new(), Near::default());
        let nearest: Vec<[(u32, f32); LINKS]> = (0..template.triangles.len())
            .into_par_iter()
            .map_init(scratch, |(seen, around, near), triangle| {
                let own = by_triangle.of(triangle);
                if !own.is_empty() {
                    mesh.around(triangle, reach, seen, around);
                    near.gather(&by_triangle, around);
                }
                by_triangle.order[own].iter().map(|&i| near.nearest(gaussians, i, reach)).collect::<Vec<_>>()
            })
            .flatten_iter()
            .collect();
        let known = || {
            let pairs =
                by_triangle.order.iter().zip(&nearest).flat_map(|(&i, near)| near.iter().map(move |near| (i, near)));
            pairs.filter(|(_, (j, _))| *j != NONE)
        };
        // Both directions, by counting.
        let mut ends = vec![0u32; gaussians.len() + 1];
        known().flat_map(|(i, (j, _))| [i, *j]).for_each(|i| ends[i as usize + 1] += 1);
        (0..gaussians.len()).for_each(|i| ends[i + 1] += ends[i]);
        let mut all = vec![(NONE, 0.0); ends.last().map_or(0, |&end| end as usize)];
        for (i, &(j, distance)) in known() {
            for (from, to) in [(i, j), (j, i)] {
                let next = &mut ends[from as usize];
                all[*next as usize] = (to, distance);
                *next += 1;
            }
        }
        let mut links = Vec::with_capacity(all.len());
        let mut starts = vec![0];
        let mut first = 0;
        for &end in &ends[..gaussians.len()] {
            let row = &mut all[first..end as usize];
            first = end as usize;
            row.sort_unstable_by_key(|(j, _)| *j);
            links.extend(row.chunk_by(|a, b| a.0 == b.0).filter_map(|same| same.first()));
            starts.push(links.len() as u32);
        }
        Self { starts, links }
    }

    /// Returns the neighbours of one Gaussian with their distances, metres.
    pub fn of(&self, gaussian: usize) -> &[(u32, f32)] {
        &self.links[self.starts[gaussian] as usize..self.starts[gaussian + 1] as usize]
    }
}

/// Gaussians in the order of their triangles.
struct ByTriangle {
    /// End of each triangle's Gaussians in the lists.
    ends: Vec<u32>,
    order: Vec<u32>,
    /// Positions by axis.
    axes: [Vec<f32>; 3],
}

impl ByTriangle {
    fn new(triangles: usize, gaussians: &SurfaceGaussians) -> Self {
        let mut ends = vec![0u32; triangles + 1];
        gaussians.triangle.iter().for_each(|&triangle| ends[triangle as usize + 1] += 1);
        (0..triangles).for_each(|t| ends[t + 1] += ends[t]);
        let mut order = vec![0; gaussians.len()];
        for (i, &triangle) in (0u32..).zip(&gaussians.triangle) {
            let next = &mut ends[triangle as usize];
            order[*next as usize] = i;
            *next += 1;
        }
        let axes = [0, 1, 2].map(|axis| order.iter().map(|&i| gaussians.positions[i as usize][axis]).collect());
        Self { ends, order, axes }
    }

    /// Returns the places of a triangle's Gaussians.
    fn of(&self, triangle: usize) -> Range<usize> {
        let start = if triangle == 0 { 0 } else { self.ends[triangle - 1] };
        start as usize..self.ends[triangle] as usize
    }
}

/// Gaussians of some triangles, by axis, so that distances are computed side by side.
#[derive(Default)]
struct Near {
    indices: Vec<u32>,
    axes: [Vec<f32>; 3],
    squared: Vec<f32>,
}

impl Near {
    fn gather(&mut self, gaussians: &ByTriangle, triangles: &[u32]) {
        self.indices.clear();
        self.axes.iter_mut().for_each(Vec::clear);
        for places in triangles.iter().map(|&triangle| gaussians.of(triangle as usize)) {
            self.indices.extend_from_slice(&gaussians.order[places.clone()]);
            for (near, all) in self.axes.iter_mut().zip(&gaussians.axes) {
                near.extend_from_slice(&all[places.clone()]);
            }
        }
    }

    /// Returns the nearest of these to Gaussian `i` within `reach`, with their distances, nearest first, [`NONE`] where there are fewer.
    fn nearest(&mut self, gaussians: &SurfaceGaussians, i: u32, reach: f32) -> [(u32, f32); LINKS] {
        let (position, normal) = (gaussians.positions[i as usize], gaussians.normals[i as usize]);
        let [xs, ys, zs] = &self.axes;
        self.squared.clear();
        let squared = xs.iter().zip(ys).zip(zs).map(|((x, y), z)| Vec3::new(*x, *y, *z).distance_squared(position));
        self.squared.extend(squared);
        let mut nearest = [(NONE, f32::INFINITY); LINKS];
        for (&j, &squared) in self.indices.iter().zip(&self.squared) {
            let farthest = nearest[LINKS - 1];
            if squared > reach * reach || (squared, j) >= (farthest.1, farthest.0) || j == i {
                continue;
            }
            if gaussians.normals[j as usize].dot(normal) <= -0.5 {
                continue;
            }
            let mut at = LINKS - 1;
            while at > 0 && (squared, j) < (nearest[at - 1].1, nearest[at - 1].0) {
                nearest[at] = nearest[at - 1];
                at -= 1;
            }
            nearest[at] = (j, squared);
        }
        nearest.map(|(j, squared)| (j, squared.sqrt()))
    }
}

/// Triangles of a mesh and their neighbours over shared corners.
struct MeshNeighborhoods {
    /// Position class of each corner.
    corners: Vec<[u32; 3]>,
    /// Triangles around each position class, compressed rows.
    fan_starts: Vec<u32>,
    fans: Vec<u32>,
    centre: Vec<Vec3>,
    radius: Vec<f32>,
    area: f32,
}

impl MeshNeighborhoods {
    fn new(template: &Template) -> Self {
        let class = template.welded();
        let corners: Vec<[u32; 3]> = template.triangles.iter().map(|t| t.map(|i| class[i as usize])).collect();
        let classes = class.iter().max().map_or(0, |&last| last as usize + 1);
        let mut fan_starts = vec![0u32; classes + 1];
        for &corner in corners.iter().flatten() {
            fan_starts[corner as usize + 1] += 1;
        }
        for i in 1..fan_starts.len() {
            fan_starts[i] += fan_starts[i - 1];
        }
        let mut next = fan_starts.clone();
        let mut fans = vec![0; corners.len() * 3];
        for (triangle, corners) in corners.iter().enumerate() {
            for &corner in corners {
                fans[next[corner as usize] as usize] = triangle as u32;
                next[corner as usize] += 1;
            }
        }
        let mut area = 0.0;
        let (centre, radius) = template
            .triangles
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|i| template.positions[i as usize]);
                area += 0.5 * (b - a).cross(c - a).length();
                let centre = (a + b + c) / 3.0;
                (centre, [a, b, c].map(|p| p.distance(centre)).into_iter().fold(0.0, f32::max))
            })
            .unzip();
        Self { corners, fan_starts, fans, centre, radius, area }
    }

    /// Finds the triangles connected to one over shared corners within the ball of `reach` around it. `seen` holds, for each triangle,
    /// the last one around which it was looked at.
    fn around(&self, triangle: usize, reach: f32, seen: &mut [u32], found: &mut Vec<u32>) {
        found.clear();
        found.push(triangle as u32);
        seen[triangle] = triangle as u32;
        let mut next = 0;
        while let Some(&current) = found.get(next) {
            next += 1;
            for &corner in &self.corners[current as usize] {
                let fan = self.fan_starts[corner as usize] as usize..self.fan_starts[corner as usize + 1] as usize;
                for &other in &self.fans[fan] {
                    let i = other as usize;
                    if std::mem::replace(&mut seen[i], triangle as u32) == triangle as u32 {
                        continue;
                    }
                    let gap = self.centre[i].distance(self.centre[triangle]) - self.radius[i] - self.radius[triangle];
                    if gap <= reach {
                        found.push(other);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ShapeParams, default_template, sample_surface};

    #[test]
    fn links_are_those_of_a_plain_search_over_all_pairs_that_the_mesh_joins() {
        let template = default_template(&ShapeParams::default()).unwrap();
        let mut gaussians = sample_surface(&template, 1500, 3).unwrap();
        // In any order, and two in one place.
        gaussians.positions.swap(3, 900);
        gaussians.normals.swap(3, 900);
        gaussians.triangle.swap(3, 900);
        gaussians.positions[40] = gaussians.positions[41];
        let links = SurfaceLinks::new(&template, &gaussians);
        let mesh = MeshNeighborhoods::new(&template);
        let reach = REACH_SPACINGS * (mesh.area / 1500.0).sqrt();
        let mut around = Vec::new();
        let mut expected = vec![Vec::new(); 1500];
        for i in 0..1500 {
            let mut seen = vec![u32::MAX; template.triangles.len()];
            mesh.around(gaussians.triangle[i] as usize, reach, &mut seen, &mut around);
            let mut near: Vec<(f64, u32)> = (0..1500u32)
                .filter(|&j| j != i as u32 && around.contains(&gaussians.triangle[j as usize]))
                .filter(|&j| gaussians.normals[j as usize].dot(gaussians.normals[i]) > -0.5)
                .map(|j| {
                    let apart = gaussians.positions[j as usize].as_dvec3() - gaussians.positions[i].as_dvec3();
                    (apart.length(), j)
                })
                .filter(|(distance, _)| *distance <= f64::from(reach))
                .collect();
            near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            for &(distance, j) in near.iter().take(LINKS) {
                expected[i].push((j, distance));
                expected[j as usize].push((i as u32, distance));
            }
        }
        for (i, mut row) in expected.into_iter().enumerate() {
            row.sort_by_key(|(j, _)| *j);
            row.dedup_by_key(|(j, _)| *j);
            let found = links.of(i);
            assert!(found.iter().map(|(j, _)| j).eq(row.iter().map(|(j, _)| j)), "{i}: {found:?} {row:?}");
            assert!(found.iter().zip(&row).all(|(a, b)| (f64::from(a.1) - b.1).abs() < 1e-6));
        }
    }
}

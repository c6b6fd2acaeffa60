//! Neighbours of Gaussians along the surface.

use glam::Vec3;
use rayon::prelude::*;

use crate::{SurfaceGaussians, Template};

/// Nearest neighbours that each Gaussian links to; links go both ways.
const LINKS: usize = 8;

/// Longest link, in mean spacings. Evenly spaced points have several neighbours within it.
const REACH_SPACINGS: f32 = 2.5;

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
        let mut on_triangle = vec![Vec::new(); template.triangles.len()];
        for (i, &triangle) in gaussians.triangle.iter().enumerate() {
            on_triangle[triangle as usize].push(i as u32);
        }
        let unseen = || vec![u32::MAX; template.triangles.len()];
        let nearest: Vec<Vec<(u32, f32)>> = on_triangle
            .par_iter()
            .enumerate()
            .map_init(unseen, |seen, (triangle, own)| {
                let near: Vec<u32> = match own.is_empty() {
                    true => Vec::new(),
                    false => mesh
                        .around(triangle, reach, seen)
                        .iter()
                        .flat_map(|&t| &on_triangle[t as usize])
                        .copied()
                        .collect(),
                };
                own.iter().map(|&i| nearest_of(gaussians, i, &near, reach)).collect::<Vec<_>>()
            })
            .flatten_iter()
            .collect();
        // In the order of the triangles; `order[k]` is the Gaussian of `nearest[k]`.
        let order: Vec<u32> = on_triangle.into_iter().flatten().collect();
        let mut rows = vec![Vec::new(); gaussians.len()];
        for (&i, list) in order.iter().zip(&nearest) {
            for &(j, distance) in list {
                rows[i as usize].push((j, distance));
                rows[j as usize].push((i, distance));
            }
        }
        let mut links = Vec::new();
        let mut starts = vec![0];
        for mut row in rows {
            row.sort_by_key(|(j, _)| *j);
            row.dedup_by_key(|(j, _)| *j);
            links.extend(row);
            starts.push(links.len() as u32);
        }
        Self { starts, links }
    }

    /// Returns the neighbours of one Gaussian with their distances, metres.
    pub fn of(&self, gaussian: usize) -> &[(u32, f32)] {
        &self.links[self.starts[gaussian] as usize..self.starts[gaussian + 1] as usize]
    }
}

fn nearest_of(gaussians: &SurfaceGaussians, i: u32, near: &[u32], reach: f32) -> Vec<(u32, f32)> {
    let (position, normal) = (gaussians.positions[i as usize], gaussians.normals[i as usize]);
    let mut list: Vec<(u32, f32)> = near
        .iter()
        .filter(|&&j| j != i && gaussians.normals[j as usize].dot(normal) > -0.5)
        .map(|&j| (j, gaussians.positions[j as usize].distance(position)))
        .filter(|&(_, distance)| distance <= reach)
        .collect();
    if list.len() > LINKS {
        list.select_nth_unstable_by(LINKS - 1, |a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        list.truncate(LINKS);
    }
    list
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

    /// Returns the triangles connected to one over shared corners within the ball of `reach` around it. `seen` holds, for each triangle,
    /// the last one around which it was found.
    fn around(&self, triangle: usize, reach: f32, seen: &mut [u32]) -> Vec<u32> {
        let mut found = vec![triangle as u32];
        seen[triangle] = triangle as u32;
        let mut next = 0;
        while let Some(&current) = found.get(next) {
            next += 1;
            for &corner in &self.corners[current as usize] {
                let fan = self.fan_starts[corner as usize] as usize..self.fan_starts[corner as usize + 1] as usize;
                for &other in &self.fans[fan] {
                    let i = other as usize;
                    if seen[i] == triangle as u32 {
                        continue;
                    }
                    let gap = self.centre[i].distance(self.centre[triangle]) - self.radius[i] - self.radius[triangle];
                    if gap <= reach {
                        seen[i] = triangle as u32;
                        found.push(other);
                    }
                }
            }
        }
        found
    }
}

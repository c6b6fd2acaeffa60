//! Subset of larger Gaussians that represents the fine ones at a coarse image scale.

use glam::Vec3;
use rayon::prelude::*;

use crate::eliminate::eliminate;
use crate::point_grid::PointGrid;
use crate::surface::scales;
use crate::{BodyError, DeformationGraph, SurfaceGaussians, Template};

/// Evenly spaced, larger subset of the Gaussians of a surface, for images in which a pixel covers several of them.
#[derive(Debug, Clone, PartialEq)]
pub struct CoarseSurface {
    /// Chosen Gaussians, with scales that fit their spacing.
    pub gaussians: SurfaceGaussians,
    /// Mean spacing of the chosen Gaussians: square root of the surface area per Gaussian, metres.
    pub spacing_m: f64,
    /// Graph with unchanged nodes. [`DeformationGraph::gaussian_nodes`] and their weights are those of the chosen Gaussians;
    /// [`DeformationGraph::node_gaussian`] still refers to the fine ones.
    pub graph: DeformationGraph,
    /// Index in `children` of the first child of each chosen Gaussian; the last element is their number.
    pub first_child: Vec<u32>,
    /// Fine Gaussians, grouped by the nearest chosen one on the same side of the body.
    pub children: Vec<u32>,
}

/// Chooses `count` (at least 1, at most all) of the Gaussians; each fine one becomes a child of a chosen one.
///
/// # Errors
/// [`BodyError::Mesh`] when there are no Gaussians or the graph belongs to others.
pub fn coarsen(
    template: &Template,
    surface: &SurfaceGaussians,
    graph: &DeformationGraph,
    count: usize,
) -> Result<CoarseSurface, BodyError> {
    let all = surface.len();
    let lists = [graph.gaussian_nodes.len(), graph.gaussian_weights.len(), surface.skin.len(), surface.normals.len()];
    if all == 0 || lists.iter().any(|&len| len != all) {
        let message = format!("{all} Gaussians do not fit a graph for {}; build both together", lists[0]);
        return Err(BodyError::Mesh { name: template.name.clone(), message });
    }
    let area = template.area_m2();
    let kept = eliminate(surface.positions.clone(), surface.normals.clone(), count.clamp(1, all), area);
    let positions: Vec<Vec3> = kept.iter().map(|&i| surface.positions[i]).collect();
    let normals: Vec<Vec3> = kept.iter().map(|&i| surface.normals[i]).collect();
    let spacing_m = (area / kept.len() as f64).sqrt();
    let scale_m =
        if kept.len() == all { surface.scale_m.clone() } else { scales(&positions, &normals, spacing_m as f32) };
    let spacing = (spacing_m as f32).max(1e-6);
    let grid = PointGrid::new(&positions, 2.0 * spacing);
    let parents: Vec<u32> = (0..all)
        .into_par_iter()
        .map(|i| {
            let (point, normal) = (surface.positions[i], surface.normals[i]);
            let mut radius = 2.0 * spacing;
            // A Gaussian without a near neighbour on its side takes the nearest of all.
            for sides_count in [true, true, true, false] {
                let mut best = (f32::INFINITY, 0);
                grid.within(point, radius, |j, squared| {
                    if squared < best.0 && (!sides_count || normal.dot(normals[j]) > 0.0) {
                        best = (squared, j as u32);
                    }
                });
                if best.0.is_finite() {
                    return best.1;
                }
                radius *= 2.0;
            }
            let nearest = (0u32..)
                .zip(&positions)
                .min_by(|a, b| a.1.distance_squared(point).total_cmp(&b.1.distance_squared(point)));
            nearest.map_or(0, |(j, _)| j)
        })
        .collect();
    let mut first_child = vec![0u32; kept.len() + 1];
    for &parent in &parents {
        first_child[parent as usize + 1] += 1;
    }
    for k in 1..first_child.len() {
        first_child[k] += first_child[k - 1];
    }
    let mut next = first_child.clone();
    let mut children = vec![0; all];
    for (child, &parent) in (0u32..).zip(&parents) {
        let slot = &mut next[parent as usize];
        children[*slot as usize] = child;
        *slot += 1;
    }
    let gaussians = SurfaceGaussians {
        uvs: kept.iter().map(|&i| surface.uvs[i]).collect(),
        parts: kept.iter().map(|&i| surface.parts[i]).collect(),
        skin: kept.iter().map(|&i| surface.skin[i]).collect(),
        triangle: kept.iter().map(|&i| surface.triangle[i]).collect(),
        barycentric: kept.iter().map(|&i| surface.barycentric[i]).collect(),
        depth_m: kept.iter().map(|&i| surface.depth_m[i]).collect(),
        positions,
        normals,
        scale_m,
    };
    let graph = DeformationGraph {
        gaussian_nodes: kept.iter().map(|&i| graph.gaussian_nodes[i]).collect(),
        gaussian_weights: kept.iter().map(|&i| graph.gaussian_weights[i]).collect(),
        ..graph.clone()
    };
    Ok(CoarseSurface { gaussians, spacing_m, graph, first_child, children })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};

    #[test]
    fn every_fine_gaussian_has_a_near_parent_and_all_stay_when_all_are_asked_for() {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 8000, 1).unwrap();
        let graph = build_graph(&template, &surface, 200, DEFAULT_SIGMA2_M2).unwrap();
        let coarse = coarsen(&template, &surface, &graph, 2000).unwrap();
        assert_eq!((coarse.gaussians.len(), coarse.first_child.len()), (2000, 2001));
        let mut seen = vec![false; 8000];
        let mut farthest = 0.0f32;
        for (k, ends) in coarse.first_child.windows(2).enumerate() {
            assert!(ends[0] < ends[1], "a chosen one is its own child");
            for &child in &coarse.children[ends[0] as usize..ends[1] as usize] {
                assert!(!std::mem::replace(&mut seen[child as usize], true));
                let at = surface.positions[child as usize];
                farthest = farthest.max(at.distance(coarse.gaussians.positions[k]));
            }
        }
        assert!(seen.iter().all(|s| *s));
        // 1.7 square metres over 2000 are 3 cm apart.
        assert!(farthest < 0.06, "{farthest}");
        let mean = |list: &[f32]| list.iter().sum::<f32>() / list.len() as f32;
        let ratio = mean(&coarse.gaussians.scale_m) / mean(&surface.scale_m);
        assert!((1.7..2.3).contains(&ratio), "a quarter as many are twice as large: {ratio}");
        assert!((0.025..0.035).contains(&coarse.spacing_m), "{}", coarse.spacing_m);
        let same = coarsen(&template, &surface, &graph, 9000).unwrap();
        assert_eq!((same.gaussians, same.graph), (surface.clone(), graph.clone()));
        assert!(coarsen(&template, &surface, &DeformationGraph { gaussian_nodes: Vec::new(), ..graph }, 5).is_err());
    }
}

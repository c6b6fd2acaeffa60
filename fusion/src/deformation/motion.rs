//! From the nodes to all Gaussians, and to the template's vertices.

use flyrig_body::{DeformationGraph, SurfaceGaussians, Template};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::vertex_means::VertexMeans;

/// Eq. 2 for every Gaussian, whether the solver looks at it or not.
#[derive(Debug)]
pub struct MeshMotion {
    nodes: Vec<[u32; 4]>,
    weights: Vec<[f32; 4]>,
    displacement: Vec<[f32; 4]>,
    vertices: VertexMeans,
}

impl MeshMotion {
    pub fn new(template: &Template, surface: &SurfaceGaussians, graph: &DeformationGraph) -> Self {
        Self {
            nodes: graph.gaussian_nodes.clone(),
            weights: graph.gaussian_weights.clone(),
            displacement: vec![[0.0; 4]; surface.len()],
            vertices: VertexMeans::new(template, surface),
        }
    }

    /// Follows the nodes; canonical displacements t_x, metres, w 0.
    pub fn follow(&mut self, translations: &[DVec3]) -> &[[f32; 4]] {
        let one = |((out, nodes), weights): ((&mut [f32; 4], &[u32; 4]), &[f32; 4])| {
            let moved = |(&node, &weight): (&u32, &f32)| {
                translations.get(node as usize).map_or(DVec3::ZERO, |t| *t * f64::from(weight))
            };
            *out = nodes.iter().zip(weights).map(moved).sum::<DVec3>().as_vec3().extend(0.0).to_array();
        };
        self.displacement.par_iter_mut().zip(&self.nodes).zip(&self.weights).with_min_len(4096).for_each(one);
        &self.displacement
    }

    /// Displacement of every vertex of the template.
    pub fn of_vertices(&self) -> Vec<Vec3> {
        self.vertices.of(&self.displacement)
    }
}

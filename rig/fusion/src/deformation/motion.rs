//! Motion of all Gaussians and of the template's vertices with the nodes of the deformation graph.

use flyrig_body::{DeformationGraph, SurfaceGaussians, Template, VertexMeans, displacement};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Displacement of every Gaussian by FlyHuman, Eq. 2, whether the solver compares it or not.
#[derive(Debug)]
pub struct MeshMotion {
    rest: Vec<Vec3>,
    nodes: Vec<[u32; 4]>,
    weights: Vec<[f32; 4]>,
    displacement: Vec<[f32; 4]>,
    vertices: VertexMeans,
}

impl MeshMotion {
    pub fn new(template: &Template, surface: &SurfaceGaussians, graph: &DeformationGraph) -> Self {
        Self {
            rest: graph.nodes.clone(),
            nodes: graph.gaussian_nodes.clone(),
            weights: graph.gaussian_weights.clone(),
            displacement: vec![[0.0; 4]; surface.len()],
            vertices: VertexMeans::new(
                template,
                surface.triangle.iter().copied().zip(surface.barycentric.iter().copied()),
            ),
        }
    }

    /// Computes the Gaussians' canonical displacements t_x, metres, and their growth from the nodes' translations; see [`displacement`].
    pub fn follow(&mut self, translations: &[DVec3]) -> &[[f32; 4]] {
        let rest = &self.rest;
        let one = |((out, nodes), weights): ((&mut [f32; 4], &[u32; 4]), &[f32; 4])| {
            *out = displacement(rest, translations, *nodes, *weights);
        };
        self.displacement.par_iter_mut().zip(&self.nodes).zip(&self.weights).with_min_len(4096).for_each(one);
        &self.displacement
    }

    /// Returns the canonical displacement of every vertex of the template, metres.
    pub fn of_vertices(&self) -> Vec<Vec3> {
        self.vertices.of(&self.displacement)
    }
}

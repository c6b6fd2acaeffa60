//! Deformation graph.

use glam::Vec3;

use crate::{BodyError, SurfaceGaussians, Template};

/// Nodes of the paper's graph.
pub const DEFAULT_NODE_COUNT: usize = 1620;

/// sigma^2 of Eq. 2, square metres.
pub const DEFAULT_SIGMA2_M2: f64 = 0.001;

/// Nodes on the surface and what hangs on them.
#[derive(Debug, Clone)]
pub struct DeformationGraph {
    /// Canonical, metres.
    pub nodes: Vec<Vec3>,
    /// Which Gaussian each node is.
    pub node_gaussian: Vec<u32>,
    /// Neighbours of each node along the surface, nearest first; its own index where it has fewer than 4.
    pub neighbors: Vec<[u32; 4]>,
    /// Nodes of each Gaussian, nearest first.
    pub gaussian_nodes: Vec<[u32; 4]>,
    /// Eq. 2 weights, sum 1; 0 where a Gaussian has fewer than 4 nodes.
    pub gaussian_weights: Vec<[f32; 4]>,
}

/// Builds the graph.
///
/// # Errors
/// [`BodyError::Mesh`].
pub fn build_graph(
    _template: &Template,
    _gaussians: &SurfaceGaussians,
    _node_count: usize,
    _sigma2_m2: f64,
) -> Result<DeformationGraph, BodyError> {
    Err(BodyError::Asset("not yet".to_owned()))
}

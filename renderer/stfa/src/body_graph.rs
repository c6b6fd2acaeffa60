//! Description of a body for the networks, known before the first image.

use flyrig_body::{DeformationGraph, Part, SurfaceGaussians};
use glam::Vec3;

use crate::StfaError;

/// Number of Gaussians over which a node's image feature is averaged.
pub const POOLED: usize = 8;
/// Edges per node: four along the surface, and one to its mirror image.
pub const EDGES: usize = 5;
/// Length of a node's positional encoding: position with three octaves of sine and cosine, normal, part.
pub const PLACE: usize = 3 + 3 * 2 * OCTAVES + 3 + Part::ALL.len();

const OCTAVES: usize = 3;
/// Weight below which a Gaussian does not belong to a node.
const MIN_POOL_WEIGHT: f32 = 0.25;

/// Deformation graph in the form that the networks take.
///
/// # Examples
/// ```
/// use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
/// use flyrig_stfa::{BodyGraph, LearnedAppearance, Parameters};
///
/// let template = default_template(&ShapeParams::default())?;
/// let surface = sample_surface(&template, 2000, 1)?;
/// let graph = build_graph(&template, &surface, 100, DEFAULT_SIGMA2_M2)?;
/// let body = BodyGraph::new(&surface, &graph)?;
/// assert_eq!((body.gaussians(), body.nodes()), (surface.len(), graph.nodes.len()));
/// // The same weights serve every body.
/// let networks = LearnedAppearance::new(&Parameters::named("tiny".as_ref())?, body);
/// assert_eq!(networks.counts.views_encoded, 0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct BodyGraph {
    /// Nodes of each Gaussian.
    pub gaussian_nodes: Vec<[u32; 4]>,
    /// Weights of these nodes, which sum to 1.
    pub gaussian_weights: Vec<[f32; 4]>,
    /// Neighbours of each node; the last one is the node nearest to its mirror image across the body's middle plane.
    pub edges: Vec<[u32; EDGES]>,
    /// Gaussians over which a node's image feature is averaged.
    pub pooled: Vec<[u32; POOLED]>,
    /// Canonical positional encoding of each node, independent of the body's height.
    pub place: Vec<[f32; PLACE]>,
}

impl BodyGraph {
    /// Builds the graph of a body from its Gaussians and its deformation graph.
    ///
    /// # Errors
    /// [`StfaError::Body`] where Gaussians and graph do not fit each other.
    pub fn new(surface: &SurfaceGaussians, graph: &DeformationGraph) -> Result<Self, StfaError> {
        let (gaussians, nodes) = (surface.len(), graph.nodes.len());
        let refuse = |what: String| Err(StfaError::Body(what));
        if gaussians == 0 || nodes == 0 {
            return refuse(format!("{gaussians} Gaussians and {nodes} nodes"));
        }
        if graph.gaussian_nodes.len() != gaussians || graph.gaussian_weights.len() != gaussians {
            return refuse(format!("{gaussians} Gaussians, {} of them on the graph", graph.gaussian_nodes.len()));
        }
        if graph.neighbors.len() != nodes || graph.node_gaussian.len() != nodes {
            return refuse(format!("{nodes} nodes, {} with neighbours", graph.neighbors.len()));
        }
        let node_ids = graph.neighbors.iter().chain(&graph.gaussian_nodes).flatten();
        if let Some(node) = node_ids.copied().find(|&node| node as usize >= nodes) {
            return refuse(format!("node {node} of {nodes}"));
        }
        if let Some(gaussian) = graph.node_gaussian.iter().find(|&&gaussian| gaussian as usize >= gaussians) {
            return refuse(format!("Gaussian {gaussian} of {gaussians}"));
        }
        if !surface.positions.iter().chain(&graph.nodes).all(|p| p.is_finite()) {
            return refuse("positions that are not finite".to_owned());
        }
        let (low, high) = surface
            .positions
            .iter()
            .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)));
        let height = (high.y - low.y).max(1e-3);
        let origin = Vec3::new(0.5 * (low.x + high.x), low.y, 0.5 * (low.z + high.z));
        let mirror = mirrored(&graph.nodes, origin.x);
        let edges = graph.neighbors.iter().zip(&mirror).map(|(&[a, b, c, d], &m)| [a, b, c, d, m]).collect();
        let place = graph
            .nodes
            .iter()
            .zip(&graph.node_gaussian)
            .map(|(node, &gaussian)| {
                let gaussian = gaussian as usize;
                encode_place((*node - origin) / height, surface.normals[gaussian], surface.parts[gaussian])
            })
            .collect();
        Ok(Self {
            gaussian_nodes: graph.gaussian_nodes.clone(),
            gaussian_weights: graph.gaussian_weights.clone(),
            edges,
            pooled: pooled(graph),
            place,
        })
    }

    /// Returns the number of Gaussians.
    #[must_use]
    pub fn gaussians(&self) -> usize {
        self.gaussian_nodes.len()
    }

    /// Returns the number of graph nodes.
    #[must_use]
    pub fn nodes(&self) -> usize {
        self.edges.len()
    }

    /// Returns the mirrored node on the other side of the body.
    #[must_use]
    pub fn mirror(&self, node: usize) -> usize {
        self.edges[node][EDGES - 1] as usize
    }
}

/// Returns the node nearest to each node's mirror image across the plane x = `middle`.
fn mirrored(nodes: &[Vec3], middle: f32) -> Vec<u32> {
    let nearest = |node: &Vec3| {
        let image = Vec3::new(2.0 * middle - node.x, node.y, node.z);
        let best = nodes
            .iter()
            .enumerate()
            .min_by(|(_, a), (_, b)| a.distance_squared(image).total_cmp(&b.distance_squared(image)));
        best.map_or(0, |(index, _)| index as u32)
    };
    nodes.iter().map(nearest).collect()
}

fn encode_place(position: Vec3, normal: Vec3, part: Part) -> [f32; PLACE] {
    let mut out = [0.0; PLACE];
    out[..3].copy_from_slice(&position.to_array());
    for octave in 0..OCTAVES {
        let angles = position * (std::f32::consts::TAU * (1 << octave) as f32);
        for axis in 0..3 {
            let at = 3 + 6 * octave + 2 * axis;
            (out[at], out[at + 1]) = angles[axis].sin_cos();
        }
    }
    let rest = 3 + 6 * OCTAVES;
    let normal = if normal.is_finite() { normal.normalize_or_zero() } else { Vec3::ZERO };
    out[rest..rest + 3].copy_from_slice(&normal.to_array());
    if let Some(index) = Part::ALL.iter().position(|known| *known == part) {
        out[rest + 3 + index] = 1.0;
    }
    out
}

/// Selects Gaussians spread evenly over those of each node; the node's own one where it has none.
fn pooled(graph: &DeformationGraph) -> Vec<[u32; POOLED]> {
    let mut lists = vec![Vec::new(); graph.nodes.len()];
    for (gaussian, (nodes, weights)) in graph.gaussian_nodes.iter().zip(&graph.gaussian_weights).enumerate() {
        for (&node, &weight) in nodes.iter().zip(weights) {
            if weight >= MIN_POOL_WEIGHT {
                lists[node as usize].push(gaussian as u32);
            }
        }
    }
    lists
        .iter()
        .zip(&graph.node_gaussian)
        .map(|(list, &own)| std::array::from_fn(|i| list.get(i * list.len() / POOLED).copied().unwrap_or(own)))
        .collect()
}

#[cfg(test)]
mod tests {
    use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};

    use super::*;

    fn body() -> (SurfaceGaussians, DeformationGraph) {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 4000, 1).unwrap();
        let graph = build_graph(&template, &surface, 250, DEFAULT_SIGMA2_M2).unwrap();
        (surface, graph)
    }

    #[test]
    fn nodes_know_their_mirror_image_their_gaussians_and_their_place() {
        let (surface, graph) = body();
        let body = BodyGraph::new(&surface, &graph).unwrap();
        assert_eq!((body.gaussians(), body.nodes()), (4000, 250));
        for (node, position) in graph.nodes.iter().enumerate() {
            let image = Vec3::new(-position.x, position.y, position.z);
            let found = graph.nodes[body.mirror(node)];
            assert!(found.distance(image) < 0.15, "node {node} at {position}: {found}");
            for gaussian in body.pooled[node] {
                let distance = surface.positions[gaussian as usize].distance(*position);
                assert!(distance < 0.2, "node {node} pools a Gaussian {distance} m away");
            }
            let place = &body.place[node];
            assert!(place.iter().all(|v| v.is_finite() && v.abs() <= 1.01));
            assert!((place[PLACE - Part::ALL.len()..].iter().sum::<f32>() - 1.0).abs() < 1e-6, "one part");
        }
        // Height does not matter, only the place on the body.
        let twice = |p: &Vec3| *p * 2.0;
        let tall = SurfaceGaussians { positions: surface.positions.iter().map(twice).collect(), ..surface.clone() };
        let wide = DeformationGraph { nodes: graph.nodes.iter().map(twice).collect(), ..graph.clone() };
        for (a, b) in BodyGraph::new(&tall, &wide).unwrap().place.iter().zip(&body.place) {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3));
        }
    }

    #[test]
    fn bodies_that_do_not_fit_are_refused() {
        let (surface, graph) = body();
        let refused = |graph: &DeformationGraph| BodyGraph::new(&surface, graph).unwrap_err().to_string();
        let mut bad = graph.clone();
        bad.neighbors[3][1] = 250;
        assert!(refused(&bad).contains("node 250 of 250"));
        let mut bad = graph.clone();
        bad.node_gaussian[0] = 4000;
        assert!(refused(&bad).contains("Gaussian 4000 of 4000"));
        let mut bad = graph.clone();
        bad.gaussian_nodes.pop();
        assert!(refused(&bad).contains("3999 of them"));
        let mut bad = graph.clone();
        bad.nodes[7].x = f32::NAN;
        assert!(refused(&bad).contains("not finite"));
        let empty = DeformationGraph { nodes: vec![], neighbors: vec![], node_gaussian: vec![], ..graph };
        assert!(refused(&empty).contains("0 nodes"));
    }
}

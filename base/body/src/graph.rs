//! Deformation graph: nodes on the surface, their neighbours, and the Gaussians that they move.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use flyrig_model::stretch::growth;
use glam::{DVec3, Vec3};

use crate::monotone_queue::MonotoneQueue;
use crate::surface_links::SurfaceLinks;
use crate::{BodyError, SurfaceGaussians, Template};

/// Nodes of the graph in FlyHuman, section 4.1.
pub const DEFAULT_NODE_COUNT: usize = 1620;

/// sigma^2 of Eq. 2, square metres. The paper's sigma = 0.001 must be meant as this square: as a length in metres it would leave no
/// weight at the nodes' real spacing of about 3.4 cm.
pub const DEFAULT_SIGMA2_M2: f64 = 0.001;

/// Number of nodes that move a Gaussian, and of neighbours of a node.
const NEAREST: usize = 4;

/// Nodes on the surface with their neighbours, and the nodes that move each Gaussian.
///
/// ```
/// use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
///
/// let template = default_template(&ShapeParams::default())?;
/// let gaussians = sample_surface(&template, 400, 1)?;
/// let graph = build_graph(&template, &gaussians, 20, DEFAULT_SIGMA2_M2)?;
/// assert_eq!((graph.nodes.len(), graph.gaussian_nodes.len()), (20, 400));
/// # Ok::<(), flyrig_body::BodyError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct DeformationGraph {
    /// Canonical positions, metres.
    pub nodes: Vec<Vec3>,
    /// Gaussian at each node.
    pub node_gaussian: Vec<u32>,
    /// Neighbours of each node along the surface, nearest first; its own index where it has fewer than 4. Not always mutual.
    pub neighbors: Vec<[u32; 4]>,
    /// Nodes that move each Gaussian, nearest along the surface first; the first again where there are fewer than 4.
    pub gaussian_nodes: Vec<[u32; 4]>,
    /// Weights of FlyHuman Eq. 2, divided by their sum; 0 where a Gaussian has fewer than 4 nodes.
    pub gaussian_weights: Vec<[f32; 4]>,
}

/// Builds a graph of `node_count` nodes (at most one per Gaussian) by farthest-point sampling, and weights the nearest 4 nodes of each
/// Gaussian by FlyHuman Eq. 2 with `sigma2_m2` square metres. Distances are measured along the surface, so that parts which only
/// touch are not linked; Eq. 2 itself takes straight distances. Parts of the surface without a node use the node nearest in space.
///
/// # Errors
/// [`BodyError::Mesh`] when the template is not valid, there are no Gaussians or they are not finite or not the template's,
/// `node_count` is 0, or `sigma2_m2` is not positive.
pub fn build_graph(
    template: &Template,
    gaussians: &SurfaceGaussians,
    node_count: usize,
    sigma2_m2: f64,
) -> Result<DeformationGraph, BodyError> {
    template.check()?;
    let fail = |message: String| Err(BodyError::Mesh { name: template.name.clone(), message });
    let count = gaussians.len();
    if count == 0 || node_count == 0 {
        return fail(format!("a graph of {node_count} nodes on {count} Gaussians; both must be at least 1"));
    }
    if !(sigma2_m2.is_finite() && sigma2_m2 > 0.0) {
        return fail(format!("sigma^2 is {sigma2_m2} square metres; it must be positive (the usual is 0.001)"));
    }
    let known = gaussians.triangle.iter().all(|&triangle| (triangle as usize) < template.triangles.len());
    let finite = gaussians.positions.iter().chain(&gaussians.normals).all(|v| v.is_finite());
    if !known || !finite || gaussians.triangle.len() != count || gaussians.normals.len() != count {
        return fail("the Gaussians are not finite or not this template's; sample its surface again".to_owned());
    }

    let links = SurfaceLinks::new(template, gaussians);
    let node_gaussian = farthest_points(&links, count, node_count.min(count));
    let nodes: Vec<Vec3> = node_gaussian.iter().map(|&gaussian| gaussians.positions[gaussian as usize]).collect();
    // One more than needed: the nearest node of a node is itself.
    let nearest = nearest_nodes(&links, count, &node_gaussian);
    let neighbors = node_gaussian
        .iter()
        .zip(0u32..)
        .map(|(&gaussian, node)| {
            let mut others = nearest[gaussian as usize].iter().filter(|&&other| other != node && other != NONE);
            std::array::from_fn(|_| others.next().copied().unwrap_or(node))
        })
        .collect();
    let (gaussian_nodes, gaussian_weights) =
        (0..count).map(|i| hang(gaussians.positions[i], &nearest[i], &nodes, sigma2_m2)).unzip();
    Ok(DeformationGraph { nodes, node_gaussian, neighbors, gaussian_nodes, gaussian_weights })
}

/// Returns the canonical displacement of a Gaussian by the translations of its nodes (FlyHuman Eq. 2), metres, and in w its relative
/// growth ([`flyrig_model::stretch`]), which closes the holes of a stretched surface (skirts, coats). The stretch is the root mean
/// square distance between the Gaussian's nodes over that at rest, without nodes of negligible weight. `rest` holds the canonical
/// positions of all nodes, metres; nodes that are missing there or in `translations` count as at rest.
#[must_use]
pub fn displacement(rest: &[Vec3], translations: &[DVec3], nodes: [u32; 4], weights: [f32; 4]) -> [f32; 4] {
    let moved = nodes.map(|node| translations.get(node as usize).copied().unwrap_or(DVec3::ZERO));
    let by: DVec3 = moved.iter().zip(weights).map(|(t, weight)| *t * f64::from(weight)).sum();
    let (mut then, mut now) = (0.0, 0.0);
    for (a, b) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
        if weights[a].min(weights[b]) < LEAST_WEIGHT {
            continue;
        }
        if let (Some(first), Some(other)) = (rest.get(nodes[a] as usize), rest.get(nodes[b] as usize)) {
            let apart = (*other - *first).as_dvec3();
            then += apart.length_squared();
            now += (apart + moved[b] - moved[a]).length_squared();
        }
    }
    by.as_vec3().extend((growth(then, now, f64::sqrt) - 1.0) as f32).to_array()
}

/// Smallest weight that counts. Smaller ones are 0 in the person stream, which has 255 steps, so that its viewers do not know the
/// node.
const LEAST_WEIGHT: f32 = 0.5 / 255.0;

/// Width of a bucket of the searches, metres along the surface.
const BUCKET_M: f32 = 5e-4;

/// Distance from which on the farthest points share a bucket, metres.
const FARTHEST_M: f32 = 2.0;

/// Marker of a missing node.
const NONE: u32 = u32::MAX;

/// Returns the nodes and Eq. 2 weights of a point. The largest exponent is subtracted from all, which changes no normalised weight
/// and keeps the sum at 1 or more.
fn hang(point: Vec3, nearest: &[u32; NEAREST + 1], nodes: &[Vec3], sigma2_m2: f64) -> ([u32; 4], [f32; 4]) {
    let squared = |node: u32| nodes[node as usize].as_dvec3().distance_squared(point.as_dvec3());
    let mut found: Vec<u32> = nearest[..NEAREST].iter().copied().filter(|&node| node != NONE).collect();
    if found.is_empty() {
        found.extend((0..nodes.len() as u32).min_by(|&a, &b| squared(a).total_cmp(&squared(b))));
    }
    let exponents: Vec<f64> = found.iter().map(|&node| -squared(node) / sigma2_m2).collect();
    let largest = exponents.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = exponents.iter().map(|exponent| (exponent - largest).exp()).collect();
    let sum: f64 = weights.iter().sum();
    let first = found.first().copied().unwrap_or(0);
    (
        std::array::from_fn(|i| found.get(i).copied().unwrap_or(first)),
        std::array::from_fn(|i| weights.get(i).map_or(0.0, |weight| (weight / sum) as f32)),
    )
}

/// Selects points by farthest-point sampling along the surface. Each component gets its first node before any gets a second.
fn farthest_points(links: &SurfaceLinks, count: usize, nodes: usize) -> Vec<u32> {
    let mut distance = vec![f32::INFINITY; count];
    // Far ones first, of those as far the lower index. Distances only fall: an outdated entry sinks to its place.
    let entry = |distance: f32, gaussian: u32| (u32::MAX - distance.to_bits(), gaussian);
    let mut farthest = MonotoneQueue::new(|(far, _): &(u32, u32)| {
        ((FARTHEST_M - f32::from_bits(u32::MAX - far)) / BUCKET_M).max(0.0) as usize
    });
    (0..count as u32).for_each(|i| farthest.push(entry(f32::INFINITY, i)));
    let mut chosen = Vec::with_capacity(nodes);
    let mut front = BinaryHeap::new();
    while chosen.len() < nodes {
        let Some(first) = farthest.pop() else { break };
        let gaussian = first.1;
        let now = entry(distance[gaussian as usize], gaussian);
        if now > first {
            farthest.push(now);
            continue;
        }
        chosen.push(gaussian);
        distance[gaussian as usize] = 0.0;
        front.push(Reverse((0, gaussian)));
        while let Some(Reverse((so_far, gaussian))) = front.pop() {
            let so_far = f32::from_bits(so_far);
            if so_far > distance[gaussian as usize] {
                continue;
            }
            for &(next, step) in links.of(gaussian as usize) {
                let new = so_far + step;
                if new < distance[next as usize] {
                    distance[next as usize] = new;
                    front.push(Reverse((new.to_bits(), next)));
                }
            }
        }
    }
    chosen
}

/// Returns the five nearest nodes of each Gaussian along the surface, nearest first, [`NONE`] where there are fewer: one Dijkstra
/// search from all nodes at once, in which five of them may pass each point.
fn nearest_nodes(links: &SurfaceLinks, count: usize, node_gaussian: &[u32]) -> Vec<[u32; NEAREST + 1]> {
    // The shortest paths found so far, nearest first: they only become shorter, so a path longer than all five leads nowhere.
    let mut nearest = vec![[(f32::INFINITY, NONE); NEAREST + 1]; count];
    let mut front =
        MonotoneQueue::new(|(distance, ..): &(u32, u32, u32)| (f32::from_bits(*distance) / BUCKET_M) as usize);
    // Bits of distances have the order of the distances, which are not negative.
    let reached = |distance: f32, gaussian: u32, node: u32| (distance.to_bits(), gaussian, node);
    for (&gaussian, node) in node_gaussian.iter().zip(0..) {
        if shorten(&mut nearest[gaussian as usize], 0.0, node) {
            front.push(reached(0.0, gaussian, node));
        }
    }
    while let Some((distance, gaussian, node)) = front.pop() {
        let distance = f32::from_bits(distance);
        if !nearest[gaussian as usize].contains(&(distance, node)) {
            continue;
        }
        for &(next, step) in links.of(gaussian as usize) {
            if shorten(&mut nearest[next as usize], distance + step, node) {
                front.push(reached(distance + step, next, node));
            }
        }
    }
    nearest.into_iter().map(|ways| ways.map(|(_, node)| node)).collect()
}

/// Inserts a path to a node among the shortest ones; returns whether it is one of them.
fn shorten(ways: &mut [(f32, u32); NEAREST + 1], distance: f32, node: u32) -> bool {
    let place = ways.iter().position(|&(_, known)| known == node).unwrap_or(NEAREST);
    // Of two nodes as far away, the one of the lower index counts as nearer.
    if (distance, node) >= ways[place] {
        return false;
    }
    ways[place] = (distance, node);
    let mut at = place;
    while at > 0 && ways[at] < ways[at - 1] {
        ways.swap(at, at - 1);
        at -= 1;
    }
    true
}

//! Hierarchy of coarser versions of the deformation graph, so that colour crosses an unseen back in a few steps.

use std::collections::BTreeMap;

use flyrig_body::DeformationGraph;

use crate::appearance::settings::AppearanceError;

/// One level; level 0 has the graph's own nodes.
#[derive(Debug, Clone, PartialEq)]
pub struct DiffusionLevel {
    /// Neighbours of each node and the number of level-0 edges between the two; symmetric.
    pub edges: Vec<Vec<(u32, f32)>>,
    /// Node of the next level that each node belongs to; empty at the last level, which has one node.
    pub parent: Vec<u32>,
}

/// Levels of a deformation graph, finest first.
///
/// A coarse node stands for a seed and its neighbours; edge weights add up (Galerkin with piecewise constant
/// interpolation). The last level is one node that joins all parts, even unconnected ones.
#[derive(Debug, Clone, PartialEq)]
pub struct DiffusionHierarchy {
    /// Levels, finest first, at least one.
    pub levels: Vec<DiffusionLevel>,
}

impl DiffusionHierarchy {
    /// Damped Jacobi steps per level; even, so that the result ends in the first of the two copies.
    pub const RELAX_STEPS: u32 = 16;

    /// Damping of a Jacobi step; below 1, or two nodes that see only each other would oscillate.
    pub const DAMPING: f32 = 0.8;

    /// Builds the levels of a graph with at least one node. Edges are undirected and counted once.
    ///
    /// # Errors
    /// [`AppearanceError::Graph`] when there is no node or an edge leads out of the graph.
    pub fn new(graph: &DeformationGraph) -> Result<Self, AppearanceError> {
        let count = graph.nodes.len();
        if count == 0 || graph.neighbors.len() != count {
            let found = graph.neighbors.len();
            return Err(AppearanceError::Graph(format!("{count} nodes with {found} neighbour lists")));
        }
        let mut edges = vec![BTreeMap::new(); count];
        for (node, neighbors) in graph.neighbors.iter().enumerate() {
            for &other in neighbors {
                if other as usize >= count {
                    return Err(AppearanceError::Graph(format!("node {node} has neighbour {other} of {count}")));
                }
                if other as usize != node {
                    edges[node].insert(other, 1.0);
                    edges[other as usize].insert(node as u32, 1.0);
                }
            }
        }
        let mut levels = Vec::new();
        loop {
            let lists: Vec<Vec<(u32, f32)>> =
                edges.iter().map(|map| map.iter().map(|(&n, &w)| (n, w)).collect()).collect();
            if lists.len() == 1 {
                levels.push(DiffusionLevel { edges: lists, parent: Vec::new() });
                return Ok(Self { levels });
            }
            let connected = lists.iter().any(|list| !list.is_empty());
            let (parent, coarse_count) = if connected { cluster(&lists) } else { (vec![0; lists.len()], 1) };
            let mut coarse: Vec<BTreeMap<u32, f32>> = vec![BTreeMap::new(); coarse_count];
            for (list, &from) in lists.iter().zip(&parent) {
                for &(other, weight) in list {
                    let to = parent[other as usize];
                    if to != from {
                        *coarse[from as usize].entry(to).or_insert(0.0) += weight;
                    }
                }
            }
            levels.push(DiffusionLevel { edges: lists, parent });
            edges = coarse;
        }
    }
}

/// Returns the cluster of each node, and the number of clusters: seeds take their whole neighbourhood while it is free,
/// remaining nodes join the cluster with the strongest edge. A graph with an edge always shrinks.
fn cluster(edges: &[Vec<(u32, f32)>]) -> (Vec<u32>, usize) {
    const FREE: u32 = u32::MAX;
    let mut parent = vec![FREE; edges.len()];
    let mut count = 0;
    for (node, list) in edges.iter().enumerate() {
        let free = |n: usize| parent[n] == FREE;
        if free(node) && list.iter().all(|&(other, _)| free(other as usize)) {
            parent[node] = count;
            for &(other, _) in list {
                parent[other as usize] = count;
            }
            count += 1;
        }
    }
    // A node left over has a neighbour in a cluster, or it would have been a seed.
    let seeded = parent.clone();
    for (node, list) in edges.iter().enumerate().filter(|(node, _)| seeded[*node] == FREE) {
        let strongest = list
            .iter()
            .filter(|(other, _)| seeded[*other as usize] != FREE)
            .max_by(|(a, x), (b, y)| x.total_cmp(y).then(b.cmp(a)));
        parent[node] = strongest.map_or(0, |(other, _)| seeded[*other as usize]);
    }
    (parent, count as usize)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    fn graph(neighbors: Vec<[u32; 4]>) -> DeformationGraph {
        DeformationGraph {
            nodes: vec![Vec3::ZERO; neighbors.len()],
            node_gaussian: vec![0; neighbors.len()],
            neighbors,
            gaussian_nodes: Vec::new(),
            gaussian_weights: Vec::new(),
        }
    }

    #[test]
    fn two_chains_and_a_hermit_end_in_one_root() {
        // 0-1-2-...-19, 20-...-29, 30 alone.
        let neighbors = (0..31u32)
            .map(|n| match n {
                19 | 29 | 30 => [n; 4],
                _ => [n + 1; 4],
            })
            .collect();
        let hierarchy = DiffusionHierarchy::new(&graph(neighbors)).unwrap();
        let counts: Vec<_> = hierarchy.levels.iter().map(|level| level.edges.len()).collect();
        assert!(counts.windows(2).all(|w| w[1] < w[0]), "{counts:?}");
        assert_eq!(*counts.last().unwrap(), 1);
        assert!(counts.len() <= 6, "{counts:?}");
        for (level, next) in hierarchy.levels.iter().zip(&hierarchy.levels[1..]) {
            assert!(level.parent.iter().all(|&p| (p as usize) < next.edges.len()));
            for (node, list) in level.edges.iter().enumerate() {
                for &(other, weight) in list {
                    assert!(level.edges[other as usize].contains(&(node as u32, weight)), "symmetric");
                }
            }
        }
        // The first level's clusters never mix the three parts.
        let parent = &hierarchy.levels[0].parent;
        assert!(parent[..20].iter().all(|p| !parent[20..].contains(p)));
        assert!(parent[20..30].iter().all(|p| *p != parent[30]));
    }

    #[test]
    fn bad_graphs_are_refused() {
        let message = |neighbors| DiffusionHierarchy::new(&graph(neighbors)).unwrap_err().to_string();
        assert!(message(vec![]).contains("0 nodes"));
        assert!(message(vec![[0; 4], [7; 4]]).contains("node 1 has neighbour 7 of 2"));
    }
}

//! The deformation graph and its hierarchy on the GPU.

use flyrig_body::DeformationGraph;
use flyrig_gpu::{ComputeKernel, GpuContext, StorageBuffer};
use wgpu::{BindGroup, Buffer};

use crate::appearance::hierarchy::DiffusionHierarchy;
use crate::appearance::settings::AppearanceError;

/// Buffers of the graph; all but the last two are constant.
#[derive(Debug)]
pub(super) struct GraphBuffers {
    /// Number of nodes of the finest level.
    pub(super) node_count: u32,
    /// Nodes of each Gaussian and their weights.
    pub(super) gaussian_nodes: StorageBuffer<[u32; 4]>,
    pub(super) gaussian_weights: StorageBuffer<[f32; 4]>,
    /// Reverse map: first entry of each node, and Gaussian and weight of each entry.
    pub(super) entry_start: StorageBuffer<u32>,
    pub(super) entries: StorageBuffer<[u32; 2]>,
    /// First node and number of nodes of each level; nodes of all levels are numbered consecutively.
    pub(super) levels: StorageBuffer<[u32; 4]>,
    /// Ranges of each node in `edges` and in `children`.
    pub(super) links: StorageBuffer<[u32; 4]>,
    pub(super) parents: StorageBuffer<u32>,
    pub(super) edges: StorageBuffer<[u32; 2]>,
    pub(super) children: StorageBuffer<u32>,
    /// Mean linear RGB seen around each node, and mean visibility.
    pub(super) node_seen: StorageBuffer<[f32; 4]>,
    /// Two copies of the diffused colours; the first holds the result.
    pub(super) node_color: StorageBuffer<[f32; 4]>,
}

impl GraphBuffers {
    pub(super) fn new(gpu: &GpuContext, gaussians: usize, graph: &DeformationGraph) -> Result<Self, AppearanceError> {
        let hierarchy = DiffusionHierarchy::new(graph)?;
        check_attachment(gaussians, graph)?;
        let node_count = graph.nodes.len();
        let (entry_start, entries) = reverse(graph, node_count);
        let flat = flatten(&hierarchy);
        let all = flat.links.len();
        Ok(Self {
            node_count: node_count as u32,
            gaussian_nodes: StorageBuffer::from_slice(gpu, "nodes of Gaussians", &graph.gaussian_nodes)?,
            gaussian_weights: StorageBuffer::from_slice(gpu, "node weights of Gaussians", &graph.gaussian_weights)?,
            entry_start: StorageBuffer::from_slice(gpu, "Gaussian ranges of nodes", &entry_start)?,
            entries: StorageBuffer::from_slice(gpu, "Gaussians of nodes", &entries)?,
            levels: StorageBuffer::from_slice(gpu, "graph levels", &flat.levels)?,
            links: StorageBuffer::from_slice(gpu, "graph links", &flat.links)?,
            parents: StorageBuffer::from_slice(gpu, "graph parents", &flat.parents)?,
            edges: StorageBuffer::from_slice(gpu, "graph edges", &flat.edges)?,
            children: StorageBuffer::from_slice(gpu, "graph children", &flat.children)?,
            node_seen: StorageBuffer::zeroed(gpu, "observed node colours", all)?,
            node_color: StorageBuffer::zeroed(gpu, "diffused node colours", 2 * all)?,
        })
    }

    pub(super) fn bind_gather(
        &self,
        gpu: &GpuContext,
        kernel: &ComputeKernel,
        seen: &StorageBuffer<[f32; 4]>,
    ) -> BindGroup {
        let buffers = [seen.raw(), self.entry_start.raw(), self.entries.raw(), self.levels.raw(), self.node_seen.raw()];
        kernel.bind(gpu, &buffers.map(Buffer::as_entire_binding))
    }

    pub(super) fn bind_diffuse(&self, gpu: &GpuContext, kernel: &ComputeKernel, settings: &Buffer) -> BindGroup {
        let buffers = [
            settings,
            self.levels.raw(),
            self.links.raw(),
            self.parents.raw(),
            self.edges.raw(),
            self.children.raw(),
            self.node_seen.raw(),
            self.node_color.raw(),
        ];
        kernel.bind(gpu, &buffers.map(Buffer::as_entire_binding))
    }
}

/// Checks that every Gaussian refers to existing nodes with finite weights.
fn check_attachment(gaussians: usize, graph: &DeformationGraph) -> Result<(), AppearanceError> {
    let refuse = |message| Err(AppearanceError::Graph(message));
    let (nodes, weights) = (graph.gaussian_nodes.len(), graph.gaussian_weights.len());
    if gaussians == 0 || nodes != gaussians || weights != gaussians {
        return refuse(format!("{gaussians} Gaussians, {nodes} node lists, {weights} weight lists"));
    }
    for (gaussian, (nodes, weights)) in graph.gaussian_nodes.iter().zip(&graph.gaussian_weights).enumerate() {
        if let Some(node) = nodes.iter().find(|&&node| node as usize >= graph.nodes.len()) {
            return refuse(format!("Gaussian {gaussian} hangs on node {node} of {}", graph.nodes.len()));
        }
        if !weights.iter().all(|w| (0.0..=1.001).contains(w)) || !(0.999..=1.001).contains(&weights.iter().sum::<f32>())
        {
            return refuse(format!("Gaussian {gaussian} has node weights {weights:?} that do not add up to 1"));
        }
    }
    Ok(())
}

/// Returns the first entry of each node (and the end), and the entries in the order of the Gaussians.
fn reverse(graph: &DeformationGraph, node_count: usize) -> (Vec<u32>, Vec<[u32; 2]>) {
    let mut lists = vec![Vec::new(); node_count];
    for (gaussian, (nodes, weights)) in graph.gaussian_nodes.iter().zip(&graph.gaussian_weights).enumerate() {
        for (&node, &weight) in nodes.iter().zip(weights) {
            if weight > 0.0 {
                lists[node as usize].push([gaussian as u32, weight.to_bits()]);
            }
        }
    }
    let mut start = vec![0];
    start.extend(lists.iter().scan(0, |end, list| {
        *end += list.len() as u32;
        Some(*end)
    }));
    (start, lists.concat())
}

struct Flat {
    levels: Vec<[u32; 4]>,
    links: Vec<[u32; 4]>,
    parents: Vec<u32>,
    edges: Vec<[u32; 2]>,
    children: Vec<u32>,
}

/// Numbers the nodes of all levels consecutively.
fn flatten(hierarchy: &DiffusionHierarchy) -> Flat {
    let mut flat =
        Flat { levels: Vec::new(), links: Vec::new(), parents: Vec::new(), edges: Vec::new(), children: Vec::new() };
    let mut children: Vec<Vec<u32>> = Vec::new();
    for level in &hierarchy.levels {
        let first = flat.links.len() as u32;
        let count = level.edges.len();
        let next = first + count as u32;
        let mut parents_children = vec![Vec::new(); level.parent.iter().map(|&p| p as usize + 1).max().unwrap_or(0)];
        children.resize(count, Vec::new());
        for (node, edges) in level.edges.iter().enumerate() {
            let (edge_start, child_start) = (flat.edges.len() as u32, flat.children.len() as u32);
            flat.edges.extend(edges.iter().map(|&(other, weight)| [first + other, weight.to_bits()]));
            flat.children.extend(&children[node]);
            flat.links.push([edge_start, flat.edges.len() as u32, child_start, flat.children.len() as u32]);
            let parent = level.parent.get(node).copied();
            if let Some(parent) = parent {
                parents_children[parent as usize].push(first + node as u32);
            }
            // The root has no parent and never asks for it.
            flat.parents.push(parent.map_or(0, |parent| next + parent));
        }
        flat.levels.push([first, count as u32, 0, 0]);
        children = parents_children;
    }
    flat
}

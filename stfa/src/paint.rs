//! One frame through the networks.

use burn::tensor::{Device, Int, Tensor};
use flyrig_renderer::{AppearanceSettings, Observations, linear_from_srgb};
use rayon::prelude::*;

use crate::{
    BodyGraph, Parameters, StfaError,
    crops::{Crops, ViewPicture},
    inputs::{STATE, frame_inputs},
    memory::FeatureMemory,
    network::{Network, feature_maps},
    parameters::to_vec,
};

/// Gaussians that go through the colour network together.
const CHUNK: usize = 16_384;

/// Paints every Gaussian: direct appearance and what the networks add to it.
#[derive(Debug)]
pub struct LearnedAppearance {
    network: Network,
    body: BodyGraph,
    place: Tensor<2>,
    edges: Tensor<1, Int>,
    memory: FeatureMemory,
    /// Gaussians whose new colour was not finite, so far; they got the colour of direct appearance.
    pub poisoned: u64,
}

impl LearnedAppearance {
    /// For one body. The same weights serve every body.
    #[must_use]
    pub fn new(parameters: &Parameters, body: BodyGraph) -> Self {
        let device = Device::flex();
        let tensors = parameters.tensors(&device, false);
        let network = Network { device, size: parameters.size, tensors };
        let (place, edges) = network.body_tensors(&body);
        Self { network, body, place, edges, memory: FeatureMemory::default(), poisoned: 0 }
    }

    /// Forgets all earlier frames.
    pub fn reset(&mut self) {
        self.memory.clear();
    }

    /// Linear RGB of every Gaussian (opacity 1) from what direct appearance observed with these settings in these pictures,
    /// view by view. Without `settings.space` no graph network runs, without `settings.time` nothing is remembered.
    ///
    /// # Errors
    /// [`StfaError::Frame`] when observations and pictures do not fit.
    pub fn paint(
        &mut self,
        observed: &Observations,
        pictures: &[ViewPicture<'_>],
        settings: &AppearanceSettings,
    ) -> Result<Vec<[f32; 4]>, StfaError> {
        let crops = Crops::cut(pictures)?;
        let inputs = frame_inputs(&self.body, observed, &crops, settings, None)?;
        let size = self.network.size;
        let (feature, node) = (size.feature(), size.node);
        let network = &self.network;

        let levels = if crops.width > 0 && crops.height > 0 {
            let planes = network.pictures(crops.planes(settings), crops.views, crops.height, crops.width);
            feature_maps(&network.encode(planes))
        } else {
            Vec::new()
        };
        let sample = |taps: &crate::taps::Taps| {
            if levels.is_empty() { vec![0.0; taps.rows() * feature] } else { taps.sample(&levels) }
        };
        let visible = sample(&inputs.taps);
        let graph = if settings.space {
            let node_feature = network.table(sample(&inputs.node_taps), feature);
            let nodes = network.node_inputs(&inputs.nodes);
            to_vec(network.graph(node_feature, nodes, self.place.clone(), &self.edges))
        } else {
            vec![0.0; self.body.nodes() * node]
        };

        let row = size.row();
        let mut rows = vec![0.0; self.body.gaussians() * row];
        for (chunk, rows) in rows.chunks_mut(CHUNK * row).enumerate() {
            let first = chunk * CHUNK;
            let range = first..first + rows.len() / row;
            let part = &visible[range.start * feature..range.end * feature];
            let mut around = vec![0.0; range.len() * node];
            around.par_chunks_mut(node).zip(range.clone().into_par_iter()).for_each(|(out, gaussian)| {
                let nodes = self.body.gaussian_nodes[gaussian].iter().zip(&self.body.gaussian_weights[gaussian]);
                for (&index, &weight) in nodes {
                    for (out, value) in out.iter_mut().zip(&graph[index as usize * node..]) {
                        *out += weight * value;
                    }
                }
            });
            let weights = inputs.state[range.clone()].iter().map(|state| state[3]).collect();
            let filled = if settings.space {
                let around = network.table(around, node);
                to_vec(network.fill(network.table(part.to_vec(), feature), network.table(weights, 1), around))
            } else {
                part.to_vec()
            };
            rows.par_chunks_mut(row).zip(filled.par_chunks(feature)).zip(&inputs.state[range]).for_each(
                |((row, filled), state)| {
                    row[..STATE].copy_from_slice(state);
                    row[STATE..].copy_from_slice(filled);
                },
            );
        }
        if settings.time {
            let weights: Vec<f32> = inputs.state.iter().map(|state| state[3]).collect();
            self.memory.fuse(&mut rows, row, &weights, &inputs.seen, settings);
        }
        let mut out = Vec::with_capacity(self.body.gaussians());
        for rows in rows.chunks(CHUNK * row) {
            let colors = to_vec(network.color(network.table(rows.to_vec(), row)));
            for (color, row) in colors.chunks_exact(3).zip(rows.chunks_exact(row)) {
                if color.iter().all(|v| v.is_finite()) {
                    out.push([color[0], color[1], color[2], 1.0].map(linear_of));
                } else {
                    self.poisoned += 1;
                    out.push([row[0], row[1], row[2], 1.0].map(|v| if v.is_finite() { v } else { 0.2 }));
                }
            }
        }
        Ok(out)
    }
}

fn linear_of(value: f32) -> f32 {
    linear_from_srgb(value)
}

//! Inference of the networks on one frame.

use std::ops::Range;

use flyrig_learn::{
    burn_tensor::{Device, Int, Tensor},
    to_vec,
};
use flyrig_renderer::{AppearanceSettings, Observations, linear_from_srgb, srgb_from_linear};
use rayon::prelude::*;

use crate::{
    BodyGraph, Parameters, StfaError,
    crops::{Crops, ViewImage},
    inputs::{FrameInputs, STATE, frame_inputs},
    memory::FeatureMemory,
    network::{Network, feature_maps},
    taps::{FeatureMaps, Taps},
};

/// Gaussians per batch of the networks.
const CHUNK: usize = if cfg!(test) { 1000 } else { 16_384 };

/// Counts since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PaintCounts {
    /// Number of encoded images.
    pub views_encoded: u64,
    /// Number of Gaussians that went through the colour network.
    pub colors_computed: u64,
    /// Number of Gaussians with a non-finite correction; they got the colour of direct appearance.
    pub poisoned: u64,
}

/// Painter of every Gaussian: direct appearance with the networks' corrections.
#[derive(Debug)]
pub struct LearnedAppearance {
    network: Network,
    digest: u64,
    body: BodyGraph,
    place: Tensor<2>,
    edges: Tensor<1, Int>,
    memory: FeatureMemory,
    /// Counts so far.
    pub counts: PaintCounts,
}

impl LearnedAppearance {
    /// Prepares the networks for one body. The same weights serve every body.
    #[must_use]
    pub fn new(parameters: &Parameters, body: BodyGraph) -> Self {
        let device = Device::flex();
        let tensors = parameters.tensors(&device, false);
        let network = Network { device, size: parameters.size, tensors };
        let (place, edges) = network.body_tensors(&body);
        Self {
            network,
            digest: parameters.digest(),
            body,
            place,
            edges,
            memory: FeatureMemory::default(),
            counts: PaintCounts::default(),
        }
    }

    /// Returns the accumulated features.
    #[must_use]
    pub fn memory(&self) -> &FeatureMemory {
        &self.memory
    }

    /// Continues from accumulated features, of the same body and weights; a memory of another size is forgotten by the next
    /// [`Self::paint`].
    pub fn restore(&mut self, memory: FeatureMemory) {
        self.memory = memory;
    }

    /// Returns [`Parameters::digest`] of the weights.
    #[must_use]
    pub fn digest(&self) -> u64 {
        self.digest
    }

    /// Forgets all earlier frames.
    pub fn reset(&mut self) {
        self.memory.clear();
    }

    /// Infers linear RGB of every Gaussian (opacity 1) from the observations of direct appearance with these settings
    /// in these images, view by view. Without `settings.space` the graph network does not run, without `settings.time`
    /// nothing is remembered.
    ///
    /// # Errors
    /// [`StfaError::Frame`] where observations and images do not fit.
    pub fn paint(
        &mut self,
        observed: &Observations,
        pictures: &[ViewImage<'_>],
        settings: &AppearanceSettings,
    ) -> Result<Vec<[f32; 4]>, StfaError> {
        let crops = Crops::cut(pictures)?;
        let inputs = frame_inputs(&self.body, observed, &crops, settings, None)?;
        let size = self.network.size;
        let feature = size.feature();
        let levels = self.encode(&crops, settings);
        let network = &self.network;
        let graph = if settings.space {
            let sampled =
                |taps: &Taps| if levels.is_empty() { vec![0.0; taps.rows() * feature] } else { taps.sample(&levels) };
            let node_feature = network.table(sampled(&inputs.node_taps), feature);
            let nodes = network.node_inputs(&inputs.nodes);
            to_vec(network.graph(node_feature, nodes, self.place.clone(), &self.edges))
        } else {
            Vec::new()
        };

        let (row, count) = (size.row(), self.body.gaussians());
        if settings.time {
            self.memory.fit(count, row);
        }
        let mut colors = Vec::with_capacity(count);
        // A chunk's rows stay in the cache from sampling to colour.
        for first in (0..count).step_by(CHUNK) {
            let range = first..(first + CHUNK).min(count);
            let mut rows = self.rows(&inputs, range.clone(), (&levels, &graph), settings);
            if settings.time {
                let weights: Vec<f32> = inputs.state[range.clone()].iter().map(|state| state[3]).collect();
                self.memory.fuse(first, &mut rows, &weights, &inputs.seen[range.clone()], settings);
            }
            let corrections = self.corrections(&rows);
            colors.par_extend(rows.par_chunks_exact(row).zip(&corrections).map(|(row, added)| {
                let color = |c: usize| linear_from_srgb((srgb_from_linear(row[c]) + added[c]).clamp(0.0, 1.0));
                [color(0), color(1), color(2), 1.0]
            }));
        }
        Ok(colors)
    }

    /// Computes the colour network's inputs for some Gaussians, before the memory. With an empty `graph` nothing is
    /// inpainted.
    fn rows(
        &self,
        inputs: &FrameInputs,
        range: Range<usize>,
        (levels, graph): (&[FeatureMaps], &[f32]),
        settings: &AppearanceSettings,
    ) -> Vec<f32> {
        let (network, size) = (&self.network, self.network.size);
        let (feature, node, row) = (size.feature(), size.node, size.row());
        let visible = if levels.is_empty() {
            vec![0.0; range.len() * feature]
        } else {
            inputs.taps.sample_rows(levels, range.clone())
        };
        let filled = if settings.space {
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
            let around = network.table(around, node);
            to_vec(network.fill(network.table(visible, feature), network.table(weights, 1), around))
        } else {
            visible
        };
        let mut rows = vec![0.0; range.len() * row];
        rows.par_chunks_mut(row).zip(filled.par_chunks(feature)).zip(&inputs.state[range]).for_each(
            |((row, filled), state)| {
                row[..STATE].copy_from_slice(state);
                row[STATE..].copy_from_slice(filled);
            },
        );
        rows
    }

    /// Computes the feature maps of all images; none without an image.
    fn encode(&mut self, crops: &Crops, settings: &AppearanceSettings) -> Vec<FeatureMaps> {
        let mut levels: Vec<FeatureMaps> = Vec::new();
        if crops.rgba.is_empty() {
            return levels;
        }
        for view in 0..crops.views {
            self.counts.views_encoded += 1;
            let picture = self.network.pictures(crops.planes(view, settings), 1, crops.height, crops.width);
            for (level, map) in feature_maps(&self.network.encode(picture)).into_iter().enumerate() {
                let size = map.values.len();
                if levels.len() <= level {
                    let values = vec![0.0; size * crops.views];
                    levels.push(FeatureMaps { values, ..map.without_values() });
                }
                levels[level].values[view * size..(view + 1) * size].copy_from_slice(&map.values);
            }
        }
        levels
    }

    /// Returns the sRGB correction of the colour of each row's Gaussian; zero where it is not finite.
    fn corrections(&mut self, rows: &[f32]) -> Vec<[f32; 3]> {
        let row = self.network.size.row();
        if rows.is_empty() {
            return Vec::new();
        }
        let colors = to_vec(self.network.color(self.network.table(rows.to_vec(), row)));
        let mut added: Vec<[f32; 3]> = (rows.par_chunks_exact(row).zip(colors.par_chunks_exact(3)))
            .map(|(input, color)| std::array::from_fn(|c| color[c] - srgb_from_linear(input[c])))
            .collect();
        self.counts.colors_computed += added.len() as u64;
        for added in added.iter_mut().filter(|added| !added.iter().all(|v| v.is_finite())) {
            self.counts.poisoned += 1;
            *added = [0.0; 3];
        }
        added
    }
}

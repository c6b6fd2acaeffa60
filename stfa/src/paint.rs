//! One frame through the networks.

use burn_tensor::{Device, Int, Tensor};
use flyrig_renderer::{AppearanceSettings, Observations, linear_from_srgb, srgb_from_linear};
use rayon::prelude::*;

use crate::{
    BodyGraph, Parameters, StfaError,
    crops::{Crops, ViewPicture},
    inputs::{STATE, frame_inputs},
    memory::FeatureMemory,
    network::{Network, feature_maps},
    parameters::to_vec,
    taps::{FeatureMaps, Taps},
};

/// Gaussians that go through the colour network together.
const CHUNK: usize = 16_384;

/// What was done and what was left out since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PaintCounts {
    /// Pictures that were encoded.
    pub views_encoded: u64,
    /// Pictures that had not changed: their features were at hand.
    pub views_kept: u64,
    /// Gaussians that went through the colour network.
    pub colors_computed: u64,
    /// Gaussians whose inputs had hardly changed: what was added to their colour before was added again.
    pub colors_kept: u64,
    /// Gaussians whose new colour was not finite; they got the colour of direct appearance.
    pub poisoned: u64,
}

/// Features of one picture.
#[derive(Debug)]
struct EncodedView {
    width: usize,
    rgba: Vec<u8>,
    levels: Vec<FeatureMaps>,
}

/// What was added to each Gaussian's colour the last time, and what the colour network saw then.
#[derive(Debug, Default)]
struct Corrections {
    rows: Vec<f32>,
    /// sRGB.
    added: Vec<[f32; 3]>,
}

/// Paints every Gaussian: direct appearance and what the networks add to it.
#[derive(Debug)]
pub struct LearnedAppearance {
    network: Network,
    body: BodyGraph,
    place: Tensor<2>,
    edges: Tensor<1, Int>,
    memory: FeatureMemory,
    encoded: Vec<EncodedView>,
    corrections: Corrections,
    /// What is kept from frame to frame: features of pictures that did not change at all, and what the networks add to a
    /// Gaussian none of whose inputs changed by more than this. 0: nothing is kept.
    pub reuse: f32,
    /// What was done so far.
    pub counts: PaintCounts,
}

impl LearnedAppearance {
    /// For one body. The same weights serve every body.
    #[must_use]
    pub fn new(parameters: &Parameters, body: BodyGraph) -> Self {
        let device = Device::flex();
        let tensors = parameters.tensors(&device, false);
        let network = Network { device, size: parameters.size, tensors };
        let (place, edges) = network.body_tensors(&body);
        Self {
            network,
            body,
            place,
            edges,
            memory: FeatureMemory::default(),
            encoded: Vec::new(),
            corrections: Corrections::default(),
            reuse: 0.0,
            counts: PaintCounts::default(),
        }
    }

    /// Forgets all earlier frames.
    pub fn reset(&mut self) {
        self.memory.clear();
        self.corrections = Corrections::default();
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
        let levels = self.encode(&crops, settings);
        let network = &self.network;
        let sample = |taps: &Taps| {
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
        self.add_corrections(&rows);
        Ok(rows
            .chunks_exact(row)
            .zip(&self.corrections.added)
            .map(|(row, added)| {
                let color = |c: usize| linear_from_srgb((srgb_from_linear(row[c]) + added[c]).clamp(0.0, 1.0));
                let color = [color(0), color(1), color(2), 1.0];
                if color.iter().all(|v| v.is_finite()) { color } else { [0.2, 0.2, 0.2, 1.0] }
            })
            .collect())
    }

    /// Feature maps of all views; those of unchanged pictures are taken from the frame before.
    fn encode(&mut self, crops: &Crops, settings: &AppearanceSettings) -> Vec<FeatureMaps> {
        let bytes = crops.width * crops.height * 4;
        if bytes == 0 {
            return Vec::new();
        }
        let planes = crops.planes(settings);
        let mut before = std::mem::take(&mut self.encoded);
        for (rgba, planes) in crops.rgba.chunks_exact(bytes).zip(planes.chunks_exact(bytes)) {
            let same = |view: &EncodedView| view.width == crops.width && view.rgba == rgba;
            let kept = if self.reuse > 0.0 { before.iter().position(same) } else { None };
            self.encoded.push(if let Some(index) = kept {
                self.counts.views_kept += 1;
                before.swap_remove(index)
            } else {
                self.counts.views_encoded += 1;
                let picture = self.network.pictures(planes.to_vec(), 1, crops.height, crops.width);
                let levels = feature_maps(&self.network.encode(picture));
                EncodedView { width: crops.width, rgba: rgba.to_vec(), levels }
            });
        }
        let level = |index: usize| {
            let of = |view: &EncodedView| view.levels[index].values.clone();
            let values = self.encoded.iter().flat_map(of).collect();
            Some(FeatureMaps { values, ..self.encoded.first()?.levels.get(index)?.without_values() })
        };
        (0..3).filter_map(level).collect()
    }

    /// Brings what is added to each Gaussian's colour up to date with its row.
    fn add_corrections(&mut self, rows: &[f32]) {
        let row = self.network.size.row();
        let Corrections { rows: before, added } = &mut self.corrections;
        let fresh = before.len() != rows.len() || self.reuse <= 0.0;
        if fresh {
            *before = rows.to_vec();
            *added = vec![[0.0; 3]; rows.len() / row];
        }
        let reuse = self.reuse;
        let changed: Vec<u32> = (0..added.len() as u32)
            .into_par_iter()
            .filter(|&gaussian| {
                let range = gaussian as usize * row..(gaussian as usize + 1) * row;
                let near = |(a, b): (&f32, &f32)| (a - b).abs() <= reuse;
                fresh || !rows[range.clone()].iter().zip(&before[range]).all(near)
            })
            .collect();
        self.counts.colors_computed += changed.len() as u64;
        self.counts.colors_kept += (added.len() - changed.len()) as u64;
        for which in changed.chunks(CHUNK) {
            let of = |gaussian: u32| gaussian as usize * row..(gaussian as usize + 1) * row;
            let inputs: Vec<f32> = which.iter().flat_map(|&g| rows[of(g)].iter().copied()).collect();
            let colors = to_vec(self.network.color(self.network.table(inputs.clone(), row)));
            for ((&gaussian, color), inputs) in which.iter().zip(colors.chunks_exact(3)).zip(inputs.chunks_exact(row)) {
                let base = [inputs[0], inputs[1], inputs[2]].map(srgb_from_linear);
                let add: [f32; 3] = std::array::from_fn(|c| color[c] - base[c]);
                let finite = add.iter().all(|v| v.is_finite());
                self.counts.poisoned += u64::from(!finite);
                added[gaussian as usize] = if finite { add } else { [0.0; 3] };
                before[of(gaussian)].copy_from_slice(inputs);
            }
        }
    }
}

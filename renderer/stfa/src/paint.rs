//! One frame through the networks.

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

/// Gaussians that go through the networks together.
const CHUNK: usize = if cfg!(test) { 1000 } else { 16_384 };

/// What was done and what was left out since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PaintCounts {
    /// Images that were encoded.
    pub views_encoded: u64,
    /// Images that had not changed: their features were at hand.
    pub views_kept: u64,
    /// Gaussians that went through the colour network.
    pub colors_computed: u64,
    /// Gaussians whose inputs had hardly changed: what was added to their colour before was added again.
    pub colors_kept: u64,
    /// Gaussians whose new colour was not finite; they got the colour of direct appearance.
    pub poisoned: u64,
}

/// Feature maps of all images, and the images themselves where features are to be reused.
#[derive(Debug, Default)]
struct Encoded {
    crops: Crops,
    levels: Vec<FeatureMaps>,
    /// What the images' masks were believed by.
    min_mask: Option<f32>,
}

/// What was added to each Gaussian's colour the last time.
#[derive(Debug, Default)]
struct Corrections {
    /// What the colour network saw then; empty where nothing is to be reused.
    rows: Vec<f32>,
    /// sRGB.
    added: Vec<[f32; 3]>,
    /// Whether this frame is the first that is kept.
    fresh: bool,
}

/// Paints every Gaussian: direct appearance and what the networks add to it.
#[derive(Debug)]
pub struct LearnedAppearance {
    network: Network,
    digest: u64,
    body: BodyGraph,
    place: Tensor<2>,
    edges: Tensor<1, Int>,
    memory: FeatureMemory,
    encoded: Encoded,
    corrections: Corrections,
    /// What is kept from frame to frame: features of images that did not change at all, and what the networks add to a
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
            digest: parameters.digest(),
            body,
            place,
            edges,
            memory: FeatureMemory::default(),
            encoded: Encoded::default(),
            corrections: Corrections::default(),
            reuse: 0.0,
            counts: PaintCounts::default(),
        }
    }

    /// Returns the features that were accumulated.
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
        self.corrections = Corrections::default();
    }

    /// Linear RGB of every Gaussian (opacity 1) from what direct appearance observed with these settings in these images,
    /// view by view. Without `settings.space` no graph network runs, without `settings.time` nothing is remembered.
    ///
    /// # Errors
    /// [`StfaError::Frame`] when observations and images do not fit.
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
        self.encode(crops, settings);
        let (network, levels) = (&self.network, &self.encoded.levels);
        let graph = if settings.space {
            let sampled =
                |taps: &Taps| if levels.is_empty() { vec![0.0; taps.rows() * feature] } else { taps.sample(levels) };
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
        self.corrections.fit(count, row, self.reuse);
        let mut colors = Vec::with_capacity(count);
        // A chunk's rows stay in the cache from sampling to colour.
        for first in (0..count).step_by(CHUNK) {
            let range = first..(first + CHUNK).min(count);
            let mut rows = self.rows(&inputs, range.clone(), &graph, settings);
            if settings.time {
                let weights: Vec<f32> = inputs.state[range.clone()].iter().map(|state| state[3]).collect();
                self.memory.fuse(first, &mut rows, &weights, &inputs.seen[range.clone()], settings);
            }
            self.add_corrections(first, &rows);
            colors.par_extend(rows.par_chunks_exact(row).zip(&self.corrections.added[range]).map(|(row, added)| {
                let color = |c: usize| linear_from_srgb((srgb_from_linear(row[c]) + added[c]).clamp(0.0, 1.0));
                [color(0), color(1), color(2), 1.0]
            }));
        }
        Ok(colors)
    }

    /// What the colour network sees of some Gaussians, before the memory. Without `graph` nothing is filled in.
    fn rows(
        &self,
        inputs: &FrameInputs,
        range: Range<usize>,
        graph: &[f32],
        settings: &AppearanceSettings,
    ) -> Vec<f32> {
        let (network, size) = (&self.network, self.network.size);
        let (feature, node, row) = (size.feature(), size.node, size.row());
        let visible = if self.encoded.levels.is_empty() {
            vec![0.0; range.len() * feature]
        } else {
            inputs.taps.sample_rows(&self.encoded.levels, range.clone())
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

    /// Brings the feature maps up to date; those of unchanged images are kept.
    fn encode(&mut self, crops: Crops, settings: &AppearanceSettings) {
        if crops.rgba.is_empty() {
            self.encoded = Encoded::default();
            return;
        }
        let before = std::mem::take(&mut self.encoded.crops);
        let form = |crops: &Crops| (crops.views, crops.width, crops.height);
        let comparable =
            self.reuse > 0.0 && form(&before) == form(&crops) && self.encoded.min_mask == Some(settings.min_mask);
        self.encoded.min_mask = Some(settings.min_mask);
        if !comparable {
            self.encoded.levels.clear();
        }
        for view in 0..crops.views {
            if comparable && before.view(view) == crops.view(view) {
                self.counts.views_kept += 1;
                continue;
            }
            self.counts.views_encoded += 1;
            let picture = self.network.pictures(crops.planes(view, settings), 1, crops.height, crops.width);
            for (level, map) in feature_maps(&self.network.encode(picture)).into_iter().enumerate() {
                let size = map.values.len();
                if self.encoded.levels.len() <= level {
                    let values = vec![0.0; size * crops.views];
                    self.encoded.levels.push(FeatureMaps { values, ..map.without_values() });
                }
                self.encoded.levels[level].values[view * size..(view + 1) * size].copy_from_slice(&map.values);
            }
        }
        if self.reuse > 0.0 {
            self.encoded.crops = crops;
        }
    }

    /// Brings what is added to the colours of the Gaussians from `first` on up to date with their rows.
    fn add_corrections(&mut self, first: usize, rows: &[f32]) {
        let (row, reuse) = (self.network.size.row(), self.reuse);
        let of = |place: u32| place as usize * row..(place as usize + 1) * row;
        let count = rows.len() / row;
        let Corrections { rows: before, added, fresh } = &mut self.corrections;
        let added = &mut added[first..first + count];
        let mut kept = before.get_mut(first * row..(first + count) * row);
        let near = |(a, b): (&f32, &f32)| (a - b).abs() <= reuse;
        let differs = |place: u32| {
            let known = kept.as_deref().filter(|_| !*fresh);
            known.is_none_or(|known| !rows[of(place)].iter().zip(&known[of(place)]).all(near))
        };
        let changed: Vec<u32> = (0..count as u32).into_par_iter().filter(|&place| differs(place)).collect();
        self.counts.colors_computed += changed.len() as u64;
        self.counts.colors_kept += (count - changed.len()) as u64;
        let mut inputs = Vec::with_capacity(changed.len() * row);
        changed.iter().for_each(|&place| inputs.extend_from_slice(&rows[of(place)]));
        if inputs.is_empty() {
            return;
        }
        let colors = to_vec(self.network.color(self.network.table(inputs, row)));
        let additions: Vec<[f32; 3]> = (changed.par_iter().zip(colors.par_chunks_exact(3)))
            .map(|(&place, color)| {
                let input = &rows[of(place)];
                std::array::from_fn(|c| color[c] - srgb_from_linear(input[c]))
            })
            .collect();
        for (&place, add) in changed.iter().zip(additions) {
            let finite = add.iter().all(|v| v.is_finite());
            self.counts.poisoned += u64::from(!finite);
            added[place as usize] = if finite { add } else { [0.0; 3] };
            if let Some(kept) = &mut kept {
                kept[of(place)].copy_from_slice(&rows[of(place)]);
            }
        }
    }
}

impl Corrections {
    /// Makes room; what is of another form, or not to be reused, is forgotten.
    fn fit(&mut self, count: usize, row: usize, reuse: f32) {
        let wanted = if reuse > 0.0 { count * row } else { 0 };
        self.fresh = wanted == 0 || self.rows.len() != wanted;
        self.rows.resize(wanted, 0.0);
        self.added.resize(count, [0.0; 3]);
    }
}

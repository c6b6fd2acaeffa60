//! Prediction of an avatar's lists by LoGAvatar's local networks.
//!
//! Geometry: anchors spread over the surface, a group of Gaussians around each with free displacements (Eq. 11), and a
//! hash encoding whose features three decoders map to scales, rotations and opacities (Eq. 12). Further stages use the
//! Gaussians of the previous stage as anchors and predict offsets too (Eq. 13). Texture: a neural texture, a
//! convolutional encoder, and an atlas of spherical harmonics that is sampled for each Gaussian (Eq. 14).
//!
//! Networks predict residuals that start at zero, so that the first image is that of the initial avatar. Every step
//! writes their outputs to the avatar's lists, so that the result needs no network. Derivatives of encoding, groups, sampling
//! and convolutions are computed by hand, those of the decoders by burn.

use std::collections::BTreeMap;

use flyrig_learn::{
    AdamStep, Moments, Parameter, Tensors,
    burn_tensor::{Device, Tensor, TensorData},
    drawn, to_vec,
};
use glam::{Vec2, Vec3, Vec4};

use crate::local::atlas_map::{AtlasLayout, AtlasMap};
use crate::local::decoders::{self, OFFSET_M, branches, decode};
use crate::local::groups::{Groups, farthest};
use crate::local::hash::{Box3, FEATURES, HashEncoding, LEVELS, ROWS, WIDTH};
use crate::local::texture::{self, Encoded};

use crate::error::AvatarError;
use crate::model::avatar::Avatar;
use crate::model::parameters::GaussianParameters;
use flyrig_fit::Element;

/// Decay rates of Adam's moments.
const BETAS: [f32; 2] = [0.9, 0.99];
/// Share of the usual derivatives in Adam's denominator, for parameters of one position: see the direct fit's Adam.
const SHARE: f32 = 0.3;
/// Steps between updates of the later stages' input positions.
const REFRESH: u64 = 200;
/// Bound on derivatives.
const LARGEST: f32 = 1e6;
/// Spread of the hash tables at the start.
const TABLE_SPREAD: f32 = 0.1;

/// Settings of the local networks. Rates are given at the start and at the end.
#[derive(Debug, Clone, PartialEq)]
pub struct LocalSettings {
    /// Whether networks predict positions, scales, rotations and opacities; otherwise these are learned directly.
    pub geometry: bool,
    /// Whether colours are sampled from an atlas; otherwise they are learned directly.
    pub colors: bool,
    /// Mean number of Gaussians around an anchor.
    pub group: usize,
    /// Number of stages; all have about the same number of Gaussians.
    pub stages: usize,
    /// Layout of the surface in the atlas.
    pub layout: AtlasLayout,
    /// Texels along a side of a chart.
    pub side: usize,
    /// Rate of displacements, metres.
    pub displacement_rate_m: [f32; 2],
    /// Rate of hash tables.
    pub table_rate: [f32; 2],
    /// Rate of decoders.
    pub decoder_rate: [f32; 2],
    /// Rate of the neural texture.
    pub texture_rate: [f32; 2],
    /// Rate of the texture's encoder.
    pub encoder_rate: [f32; 2],
}

impl Default for LocalSettings {
    fn default() -> Self {
        Self {
            geometry: true,
            colors: true,
            group: 4,
            stages: 1,
            layout: AtlasLayout::Uv,
            side: 256,
            displacement_rate_m: [2e-4, 2e-5],
            table_rate: [1e-2, 1e-3],
            decoder_rate: [2e-3, 2e-4],
            texture_rate: [2e-2, 2e-3],
            encoder_rate: [2e-3, 2e-4],
        }
    }
}

/// Stage of the geometry.
#[derive(Debug)]
struct Stage {
    groups: Groups,
    /// Encoded positions: indices of Gaussians of the previous stage.
    inputs: Vec<u32>,
    /// Their positions at the last encoding.
    encoded: Vec<[f32; 3]>,
    encoding: HashEncoding,
}

/// Intermediate results of an evaluation for its derivatives.
#[derive(Debug)]
struct Tape {
    tensors: Tensors,
    /// Features and outputs of all branches, per stage.
    stages: Vec<(Tensor<2>, Vec<Tensor<2>>)>,
    atlas: Option<Encoded>,
}

/// Local networks of one avatar.
#[derive(Debug)]
pub(crate) struct Local {
    settings: LocalSettings,
    device: Device,
    /// Lists of the initial avatar, without colours, and positions of its Gaussians.
    start: GaussianParameters,
    places: Vec<Vec3>,
    around: Box3,
    stages: Vec<Stage>,
    /// Atlas and its initial value; `None` where colours are learned directly.
    atlas: Option<(AtlasMap, Vec<f32>)>,
    /// Parameters that burn differentiates.
    networks: BTreeMap<String, Parameter>,
    /// Parameters that are differentiated by hand: displacements, hash tables, texture and its encoder.
    tables: BTreeMap<String, Parameter>,
    moments: BTreeMap<String, Moments>,
    tape: Option<Tape>,
    step: u64,
}

impl Local {
    /// Creates the networks for an initial avatar; `uvs` are the texture coordinates of its Gaussians, empty without
    /// any.
    pub fn new(avatar: &Avatar, uvs: &[Vec2], settings: &LocalSettings, seed: u64) -> Result<Self, AvatarError> {
        let places = avatar.places.clone();
        let (count, order) = (places.len(), avatar.parameters.order());
        let (stage_count, group) = (settings.stages.clamp(1, 8), settings.group.max(1));
        // The first ones of farthest-point sampling are spread evenly, and so are the next ones: anchors and stages alike.
        let size = count.div_ceil(stage_count).max(1);
        let anchors = size.div_ceil(group);
        let wanted = if stage_count > 1 { size * (stage_count - 1) } else { anchors };
        let mut sampled = farthest(&places, if settings.geometry { wanted } else { 0 });
        let inputs = sampled[..anchors.min(sampled.len())].to_vec();
        let mut is_sampled = vec![false; count];
        sampled.iter().for_each(|i| is_sampled[*i as usize] = true);
        sampled.extend((0..count as u32).filter(|i| !is_sampled[*i as usize]));
        let around = Box3::around(&places);
        let mut stages: Vec<Stage> = Vec::new();
        let mut networks = Vec::new();
        let mut tables = Vec::new();
        if settings.geometry {
            tables.push(("displacement".to_owned(), vec![count, 4], 0.0));
        }
        let mut inputs = inputs;
        for (stage, members) in sampled.chunks(size).enumerate().filter(|_| settings.geometry) {
            let groups = Groups::new(&places, &inputs, members);
            let at = of(&places, &inputs);
            let (encoded, encoding) = (at.iter().map(Vec3::to_array).collect(), HashEncoding::new(&at, around));
            networks.extend(decoders::parameters(stage, groups.slots));
            tables.push((format!("stage.{stage}.hash"), vec![LEVELS * ROWS, FEATURES], TABLE_SPREAD));
            stages.push(Stage { groups, inputs: std::mem::replace(&mut inputs, members.to_vec()), encoded, encoding });
        }
        let mut start = avatar.parameters.clone();
        let mut atlas = None;
        if settings.colors {
            let map = AtlasMap::new(settings.layout, &places, uvs, settings.side)?;
            networks.extend(texture::parameters(&map, order.coefficients()));
            let first = map.splat(&start.harmonics, order);
            start.harmonics.fill([0.0; 4]);
            atlas = Some((map, first));
        }
        let (networks, by_hand): (BTreeMap<_, _>, BTreeMap<_, _>) =
            drawn(networks, seed).into_iter().partition(|(name, _)| name.starts_with("stage"));
        let mut tables = drawn(tables, seed.wrapping_add(1));
        tables.extend(by_hand);
        let zeros =
            |(name, p): (&String, &Parameter)| (name.clone(), [vec![0.0; p.values.len()], vec![0.0; p.values.len()]]);
        let moments = networks.iter().chain(&tables).map(zeros).collect();
        Ok(Self {
            settings: settings.clone(),
            device: Device::flex().autodiff(),
            start,
            places,
            around,
            stages,
            atlas,
            networks,
            tables,
            moments,
            tape: None,
            step: 0,
        })
    }

    /// Returns the number of learned parameters.
    pub fn numbers(&self) -> usize {
        flyrig_learn::count(&self.networks) + flyrig_learn::count(&self.tables)
    }

    /// Returns whether a list of [`GaussianParameters::lists`] is predicted. Others are learned directly.
    pub fn predicts(&self, list: usize) -> bool {
        if list == 3 { self.settings.colors } else { self.settings.geometry }
    }

    /// Writes the networks' outputs to an avatar's lists. Lists that they do not predict are unchanged.
    pub fn evaluate(&mut self, into: &mut GaussianParameters) {
        let tensors = Tensors::new(&self.networks, &self.device, true);
        let mut lists = self.start.clone();
        for (list, (to, from)) in lists.lists_mut().into_iter().zip(into.lists()).enumerate() {
            if !self.predicts(list) {
                to.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
            }
        }
        let displacement = self.tables.get("displacement").map_or(&[][..], |p| p.values.as_slice());
        let mut stages = Vec::new();
        for (stage, Stage { groups, inputs, encoding, .. }) in self.stages.iter().enumerate() {
            let table = self.tables.get(&format!("stage.{stage}.hash")).map_or(&[][..], |p| p.values.as_slice());
            let features = table_of(encoding.encode(table), inputs.len(), WIDTH, &self.device).require_grad();
            let outputs = decode(&tensors, &self.device, stage, &features);
            for ((branch, columns), output) in branches(stage).iter().zip(&outputs) {
                let values = to_vec(output.clone());
                let (list, first, unit) = column(branch);
                let list = &mut lists.lists_mut()[list];
                for (cell, gaussian) in groups.cells() {
                    let row = values.get(cell * columns..(cell + 1) * columns).unwrap_or_default();
                    list[gaussian][first..].iter_mut().zip(row).for_each(|(value, more)| *value += unit * more);
                }
            }
            if stage == 0 {
                for (_, gaussian) in groups.cells() {
                    let row = displacement.get(4 * gaussian..4 * gaussian + 3).unwrap_or_default();
                    lists.offset[gaussian].iter_mut().zip(row).for_each(|(value, more)| *value += more);
                }
            }
            stages.push((features, outputs));
        }
        let coefficients = lists.order().coefficients();
        let atlas = self.atlas.as_ref().map(|(map, first)| {
            let encoded = Encoded::new(&self.tables, map);
            map.query(first, 3, &mut lists.harmonics, coefficients);
            map.query(&encoded.atlas, 3 * coefficients, &mut lists.harmonics, coefficients);
            encoded
        });
        *into = lists;
        self.tape = Some(Tape { tensors, stages, atlas });
    }

    /// Descends by one step along derivatives with respect to the lists of the last evaluation. `progress` is in 0..=1.
    pub fn descend(&mut self, slopes: &[Vec<Element>], progress: f32) {
        let [offset, shape, rotation, harmonics] = slopes else { return };
        let mut slopes = [offset, shape, rotation, harmonics].map(|list| finite(list));
        self.hide_orders(&mut slopes[3], progress);
        let gradients = self.gradients(&slopes);
        self.step += 1;
        for (name, gradient) in gradients {
            let Some(rate) = self.rate(&name, progress) else { continue };
            let (Some(parameter), Some(moments)) =
                (self.networks.get_mut(&name).or_else(|| self.tables.get_mut(&name)), self.moments.get_mut(&name))
            else {
                continue;
            };
            // Sums of finite numbers can still be too large.
            if gradient.len() == parameter.values.len() && gradient.iter().all(|slope| slope.is_finite()) {
                let share = if is_local(&name) { SHARE } else { 0.0 };
                let step = AdamStep { betas: BETAS, count: self.step, rate, decay: 0.0, scale: 1.0, share };
                step.descend(&mut parameter.values, moments, &gradient);
            }
        }
    }

    /// Updates the input positions of later stages every few steps.
    pub fn refresh(&mut self, now: &GaussianParameters) {
        if !self.step.is_multiple_of(REFRESH) {
            return;
        }
        for stage in self.stages.iter_mut().skip(1) {
            let moved = |i: &u32| {
                let i = *i as usize;
                (self.places[i] + Vec4::from(now.offset[i]).truncate()).to_array()
            };
            stage.encoded = stage.inputs.iter().map(moved).collect();
        }
        self.encode_places();
    }

    fn encode_places(&mut self) {
        for stage in self.stages.iter_mut().skip(1) {
            let places: Vec<Vec3> = stage.encoded.iter().copied().map(Vec3::from).collect();
            stage.encoding = HashEncoding::new(&places, self.around);
        }
    }

    /// Returns all numbers that change from step to step, by name.
    pub fn state(&mut self) -> Vec<(String, &mut [f32])> {
        let mut all = Vec::new();
        for (name, parameter) in self.networks.iter_mut().chain(&mut self.tables) {
            all.push((format!("network.{name}"), parameter.values.as_mut_slice()));
        }
        for (name, moments) in &mut self.moments {
            for (k, moment) in moments.iter_mut().enumerate() {
                all.push((format!("moment.{k}.{name}"), moment.as_mut_slice()));
            }
        }
        for (number, stage) in self.stages.iter_mut().enumerate().skip(1) {
            all.push((format!("encoded.{number}"), stage.encoded.as_flattened_mut()));
        }
        all
    }

    /// Resumes after [`Self::state`] was overwritten by that of a fit with `step` completed steps.
    pub fn resume(&mut self, step: u64, into: &mut GaussianParameters) {
        self.step = step;
        self.encode_places();
        self.evaluate(into);
    }

    /// Returns the derivatives with respect to all parameters from those with respect to the lists.
    fn gradients(&mut self, slopes: &[Vec<Element>; 4]) -> BTreeMap<String, Vec<f32>> {
        let mut gradients = BTreeMap::new();
        let Some(Tape { tensors, stages, atlas }) = self.tape.take() else { return gradients };
        let coefficients = self.start.order().coefficients();
        let mut totals: Vec<Tensor<1>> = Vec::new();
        if let (Some(atlas), Some((map, _))) = (atlas, &self.atlas) {
            gradients = atlas.backward(&map.backward(&slopes[3], coefficients));
        }
        let mut displacement = vec![0.0; 4 * self.places.len()];
        for (stage, (Stage { groups, inputs, .. }, (_, outputs))) in self.stages.iter().zip(&stages).enumerate() {
            for ((branch, columns), output) in branches(stage).iter().zip(outputs) {
                let (list, first, unit) = column(branch);
                let mut wanted = vec![0.0; groups.members.len() * columns];
                for (cell, gaussian) in groups.cells() {
                    let row = &slopes[list][gaussian][first..first + columns];
                    wanted[cell * columns..].iter_mut().zip(row).for_each(|(out, slope)| *out = unit * slope);
                }
                let wanted = table_of(wanted, inputs.len(), groups.slots * columns, &self.device);
                totals.push((output.clone() * wanted).sum());
            }
            if stage == 0 {
                for (_, gaussian) in groups.cells() {
                    displacement[4 * gaussian..4 * gaussian + 3].copy_from_slice(&slopes[0][gaussian][..3]);
                }
            }
        }
        // Colours alone move no Gaussian.
        let Some(total) = totals.into_iter().reduce(|a, b| a + b) else { return gradients };
        let found = total.backward();
        tensors.add_gradients(&found, &mut gradients);
        for (stage, (features, _)) in stages.iter().enumerate() {
            if let Some(slope) = features.grad(&found) {
                gradients.insert(format!("stage.{stage}.hash"), self.stages[stage].encoding.backward(&to_vec(slope)));
            }
        }
        gradients.insert("displacement".to_owned(), displacement);
        gradients
    }

    /// Drops the derivatives of colours of higher orders at first: of three orders, the first third of the steps learns
    /// order 0 alone.
    fn hide_orders(&self, slopes: &mut [Element], progress: f32) {
        let order = self.start.order();
        let orders = order.coefficients().isqrt();
        let shown = ((progress.clamp(0.0, 1.0) * orders as f32) as usize + 1).min(orders);
        for rows in slopes.chunks_mut(order.coefficients()) {
            rows.iter_mut().skip(shown * shown).for_each(|row| *row = [0.0; 4]);
        }
    }

    fn rate(&self, name: &str, progress: f32) -> Option<f32> {
        let LocalSettings { displacement_rate_m, table_rate, decoder_rate, texture_rate, encoder_rate, .. } =
            &self.settings;
        let [from, to] = match name {
            "displacement" => displacement_rate_m,
            "texture" => texture_rate,
            name if name.ends_with("hash") => table_rate,
            name if name.starts_with("stage") => decoder_rate,
            name if name.starts_with("encoder") => encoder_rate,
            _ => return None,
        };
        Some(from * (to / from).powf(progress.clamp(0.0, 1.0)))
    }
}

/// Returns whether parameters belong to positions, so that few of them influence an image.
fn is_local(name: &str) -> bool {
    name == "displacement" || name == "texture" || name.ends_with("hash")
}

/// Returns the list and first column that a branch writes, and the size of one unit.
fn column(branch: &str) -> (usize, usize, f32) {
    match branch {
        "offset" => (0, 0, OFFSET_M),
        "opacity" => (1, 3, 1.0),
        "rotation" => (2, 0, 1.0),
        _ => (1, 0, 1.0),
    }
}

/// Returns the positions of these Gaussians.
fn of(places: &[Vec3], indices: &[u32]) -> Vec<Vec3> {
    indices.iter().map(|i| places[*i as usize]).collect()
}

fn table_of(values: Vec<f32>, rows: usize, columns: usize, device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(values, [rows, columns]), device)
}

/// Replaces non-finite derivatives with zero and bounds the others: through the networks, a single one would spoil all
/// Gaussians.
fn finite(list: &[Element]) -> Vec<Element> {
    list.iter().map(|row| row.map(|slope| if slope.abs() < LARGEST { slope } else { 0.0 })).collect()
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;

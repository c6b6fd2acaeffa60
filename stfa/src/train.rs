//! Training: pixels of cameras that were not inputs, compared with what the coloured Gaussians would show there.
//!
//! A picture is linear in the Gaussians' colours, so a sample carries the shares of the Gaussians in its pixels and no
//! picture is drawn. The temporal memory is left out, as the paper does. Pixel-aligned sampling stands between two tapes:
//! the gradient of the sampled features is carried back to the feature maps by hand and handed to the encoder's tape.

use std::{collections::BTreeMap, path::Path};

use burn_tensor::{Device, Tensor, TensorData};
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng, seq::SliceRandom as _};
use safetensors::SafeTensors;
use serde::{Deserialize, Serialize};

use crate::{
    NetworkSize, Parameters, StfaError,
    body_graph::PLACE,
    inputs::{NODE, STATE},
    network::{Network, feature_maps, linear_from_srgb, srgb_from_linear},
    parameters::to_vec,
    sample::{SHARES, Target, TrainingSample},
    structure::{fine_contrast, structural_similarity},
    taps::Taps,
    tensor_file::{TensorFile, array, read},
    variation::Variation,
    weights::header,
};

/// Exponential means of Adam (Kingma and Ba 2015).
const BETAS: [f32; 2] = [0.9, 0.99];
/// A sample's loss counts as if direct appearance's were this: well tracked people teach as much as badly tracked ones.
const USUAL_MSE: f64 = 0.01;
/// Added to direct appearance's loss before that.
const SMALL_MSE: f64 = 5e-4;
/// Gradients longer than this are shortened to it.
const MAX_GRADIENT: f32 = 1.0;

/// How to train.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainSettings {
    /// Order of samples, starting weights.
    pub seed: u64,
    /// Steps in all; the rate falls to zero along half a cosine.
    pub steps: u64,
    /// Adam's rate at the start.
    pub rate: f32,
    /// Weight of what SSIM misses of 1 against the mean squared difference: the perceptual term, which keeps contrast
    /// where the mean squared difference alone would rather blur.
    pub structure: f32,
    /// Weight of the difference of a patch's fine contrast (mean standard deviation of 4x4 pixels): SSIM's windows are too
    /// wide to see a weave or a print fade.
    pub contrast: f32,
    /// Share of steps without the graph, so that the same weights serve the ablation.
    pub without_space: f64,
    /// Decay of the weights, relative to the rate (Loshchilov and Hutter 2019).
    pub decay: f32,
    /// Whether a sample comes in another variation each time: colour channels swapped and darkened, left and right turned.
    pub vary: bool,
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self {
            seed: 1,
            steps: 10_000,
            rate: 2e-3,
            structure: 0.2,
            contrast: 1.0,
            without_space: 0.1,
            decay: 0.05,
            vary: true,
        }
    }
}

/// Loss of one step, and of direct appearance on the same pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Loss {
    /// Number of the step.
    pub step: u64,
    /// Mean squared sRGB difference.
    pub mse: f64,
    /// The same of direct appearance.
    pub direct_mse: f64,
}

/// The state of a training: everything that the next step depends on.
#[derive(Debug, Clone, PartialEq)]
pub struct Trainer {
    /// What is being trained.
    pub parameters: Parameters,
    /// How.
    pub settings: TrainSettings,
    /// Steps done.
    pub step: u64,
    /// Mean and mean square of each gradient.
    moments: BTreeMap<String, [Vec<f32>; 2]>,
}

/// What a forward pass gave.
struct Forward {
    loss: Tensor<1>,
    errors: SampleErrors,
}

/// Mean squared sRGB errors of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SampleErrors {
    /// Pixels on black: shape and colour.
    pub mse: f64,
    /// The same of direct appearance.
    pub direct_mse: f64,
    /// As far as drawing and truth both cover a pixel: colour only.
    pub color_mse: f64,
    /// The same of direct appearance.
    pub direct_color_mse: f64,
    /// Mean structural similarity of the patches, of colour only.
    pub ssim: f64,
    /// The same of direct appearance.
    pub direct_ssim: f64,
    /// Fine contrast over the truth's.
    pub contrast: f64,
    /// The same of direct appearance.
    pub direct_contrast: f64,
}

impl Trainer {
    /// Starts anew.
    #[must_use]
    pub fn new(size: NetworkSize, settings: TrainSettings) -> Self {
        let parameters = Parameters::untrained(size, settings.seed);
        let zeros = |count: usize| [vec![0.0; count], vec![0.0; count]];
        let moments = parameters.by_name.iter().map(|(name, p)| (name.clone(), zeros(p.values.len()))).collect();
        Self { parameters, settings, step: 0, moments }
    }

    /// Place of the sample that the next step wants, out of `count`: every sample once a round, in random order.
    #[must_use]
    pub fn next_sample(&self, count: usize) -> usize {
        if count == 0 {
            return 0;
        }
        let (round, place) = (self.step / count as u64, self.step % count as u64);
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(&mut SmallRng::seed_from_u64(self.settings.seed.wrapping_mul(0x9e37_79b9).wrapping_add(round)));
        order[place as usize]
    }

    /// One step on one sample. A step whose loss or gradient is not finite changes nothing but the count.
    pub fn step(&mut self, sample: &TrainingSample) -> Option<Loss> {
        let mut rng =
            SmallRng::seed_from_u64(self.settings.seed.wrapping_add(self.step.wrapping_mul(0x2545_f491_4f6c)));
        let step = self.step;
        self.step += 1;
        if sample.targets.is_empty() || sample.crops.rgba.is_empty() {
            return None;
        }
        let target = &sample.targets[rng.random_range(0..sample.targets.len())];
        let numbers = target.state.as_flattened().iter().chain(sample.nodes.as_flattened());
        if !numbers.copied().all(f32::is_finite) {
            return None;
        }
        let variation = Variation::draw(&self.settings, &mut rng);
        let (forward, sums, _) = self.gradients(sample, target, variation)?;
        self.adam(step, &sums);
        Some(Loss { step, mse: forward.errors.mse, direct_mse: forward.errors.direct_mse })
    }

    /// The forward pass, dL/d parameters, and the loss.
    fn gradients(
        &self,
        sample: &TrainingSample,
        target: &Target,
        variation: Variation,
    ) -> Option<(Forward, BTreeMap<String, Vec<f32>>, f64)> {
        let device = Device::flex().autodiff();
        let tensors = self.parameters.tensors(&device, true);
        let network = Network { device, size: self.parameters.size, tensors };
        let levels = network.encode(planes(&network, sample, variation));
        let maps = feature_maps(&levels);
        let feature = network.size.feature();
        let leaf = |taps: &Taps| network.table(taps.sample(&maps), feature).require_grad();
        let taps = [&target.taps, &sample.node_taps].map(|taps| variation.taps(taps, sample.crops.width));
        let (visible, nodes) = (leaf(&taps[0]), leaf(&taps[1]));
        let weights = [self.settings.structure, self.settings.contrast];
        let forward = forward(&network, sample, target, [visible.clone(), nodes.clone()], variation, weights);
        if !forward.errors.mse.is_finite() {
            return None;
        }
        let loss = to_vec(forward.loss.clone()).first().copied().map_or(f64::NAN, f64::from);
        let gradients = forward.loss.backward();
        let mut sums = BTreeMap::new();
        network.tensors.add_gradients(&gradients, &mut sums);

        let mut map_gradients: Vec<Vec<f32>> = maps.iter().map(|map| vec![0.0; map.values.len()]).collect();
        for (taps, leaf) in taps.iter().zip([&visible, &nodes]) {
            let Some(gradient) = leaf.grad(&gradients) else { continue };
            for (sum, part) in map_gradients.iter_mut().zip(taps.sample_backward(&maps, &to_vec(gradient))) {
                sum.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
            }
        }
        let seeds = levels.into_iter().zip(map_gradients).map(|(level, gradient)| {
            let shape = level.dims();
            (level * Tensor::<4>::from_data(TensorData::new(gradient, shape), &network.device)).sum()
        });
        if let Some(total) = seeds.reduce(|a, b| a + b) {
            network.tensors.add_gradients(&total.backward(), &mut sums);
        }
        Some((forward, sums, loss))
    }

    fn adam(&mut self, step: u64, gradients: &BTreeMap<String, Vec<f32>>) {
        let length = gradients.values().flatten().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt() as f32;
        if !length.is_finite() {
            return;
        }
        let shorten = (MAX_GRADIENT / length.max(1e-12)).min(1.0);
        let progress = (step as f32 / self.settings.steps.max(1) as f32).min(1.0);
        let rate = self.settings.rate * 0.5 * (1.0 + (std::f32::consts::PI * progress).cos());
        let count = i32::try_from(step + 1).unwrap_or(i32::MAX);
        let unbias = BETAS.map(|beta| 1.0 - beta.powi(count));
        for (name, gradient) in gradients {
            let (Some(parameter), Some([mean, square])) =
                (self.parameters.by_name.get_mut(name), self.moments.get_mut(name))
            else {
                continue;
            };
            // Biases and scales have one dimension.
            let decay = if parameter.shape.len() > 1 { rate * self.settings.decay } else { 0.0 };
            for (((value, mean), square), gradient) in parameter.values.iter_mut().zip(mean).zip(square).zip(gradient) {
                let gradient = gradient * shorten;
                *mean = BETAS[0] * *mean + (1.0 - BETAS[0]) * gradient;
                *square = BETAS[1] * *square + (1.0 - BETAS[1]) * gradient * gradient;
                *value -= decay * *value + rate * (*mean / unbias[0]) / ((*square / unbias[1]).sqrt() + 1e-8);
            }
        }
    }

    /// Writes everything that the next step depends on, whole or not at all.
    ///
    /// # Errors
    /// [`StfaError::File`].
    pub fn save(&self, path: &Path) -> Result<(), StfaError> {
        let mut file = TensorFile::default();
        self.parameters.push_to(&mut file, "");
        for (name, [mean, square]) in &self.moments {
            file.push(format!("mean.{name}"), vec![mean.len()], mean);
            file.push(format!("square.{name}"), vec![square.len()], square);
        }
        let card = serde_json::json!({ "step": self.step, "settings": self.settings });
        file.write(path, self.parameters.metadata(&card))
    }

    /// Goes on where [`Self::save`] left off.
    ///
    /// # Errors
    /// [`StfaError::File`], [`StfaError::Weights`] for a damaged checkpoint.
    pub fn load(path: &Path) -> Result<Self, StfaError> {
        let bytes = read(path)?;
        let refuse = |what: String| StfaError::Weights { name: path.display().to_string(), what };
        let file = SafeTensors::deserialize(&bytes).map_err(|error| refuse(format!("not a whole file ({error})")))?;
        let metadata = header(&bytes).map_err(refuse)?;
        let parameters = Parameters::read_from(&file, &metadata, "").map_err(refuse)?;
        #[derive(Deserialize)]
        struct Card {
            step: u64,
            settings: TrainSettings,
        }
        let card = metadata.get("card").ok_or_else(|| refuse("it is no checkpoint".to_owned()))?;
        let Card { step, settings } =
            serde_json::from_str(card).map_err(|error| refuse(format!("it is no checkpoint ({error})")))?;
        let mut moments = BTreeMap::new();
        for (name, parameter) in &parameters.by_name {
            let shape = [parameter.values.len()];
            let get = |what: &str| array(&file, &format!("{what}.{name}"), &shape).map_err(refuse);
            moments.insert(name.clone(), [get("mean")?, get("square")?]);
        }
        Ok(Self { parameters, settings, step, moments })
    }
}

/// Errors of the networks and of direct appearance on all targets of a sample.
#[must_use]
pub fn evaluate(parameters: &Parameters, sample: &TrainingSample, space: bool) -> Option<SampleErrors> {
    if sample.targets.is_empty() || sample.crops.rgba.is_empty() {
        return None;
    }
    let device = Device::flex();
    let tensors = parameters.tensors(&device, false);
    let network = Network { device, size: parameters.size, tensors };
    let variation = Variation::plain(space);
    let maps = feature_maps(&network.encode(planes(&network, sample, variation)));
    let table = |taps: &Taps| network.table(taps.sample(&maps), network.size.feature());
    let (mut sum, mut pixels) = (SampleErrors::default(), 0.0);
    for target in &sample.targets {
        let tables = [table(&target.taps), table(&sample.node_taps)];
        let errors = forward(&network, sample, target, tables, variation, [0.0; 2]).errors;
        let SampleErrors { mse, direct_mse, color_mse, direct_color_mse, ssim, direct_ssim, .. } = errors;
        let count = target.truth.len() as f64;
        sum.mse += mse * count;
        sum.direct_mse += direct_mse * count;
        sum.color_mse += color_mse * count;
        sum.direct_color_mse += direct_color_mse * count;
        sum.ssim += ssim * count;
        sum.direct_ssim += direct_ssim * count;
        sum.contrast += errors.contrast * count;
        sum.direct_contrast += errors.direct_contrast * count;
        pixels += count;
    }
    Some(SampleErrors {
        mse: sum.mse / pixels,
        direct_mse: sum.direct_mse / pixels,
        color_mse: sum.color_mse / pixels,
        direct_color_mse: sum.direct_color_mse / pixels,
        ssim: sum.ssim / pixels,
        direct_ssim: sum.direct_ssim / pixels,
        contrast: sum.contrast / pixels,
        direct_contrast: sum.direct_contrast / pixels,
    })
}

/// The input pictures in this variation.
fn planes(network: &Network, sample: &TrainingSample, variation: Variation) -> Tensor<4> {
    let crops = &sample.crops;
    let planes = crops.planes(&flyrig_renderer::AppearanceSettings::default());
    let pixels = crops.width * crops.height;
    let mut out = Vec::with_capacity(planes.len());
    for view in planes.chunks_exact((4 * pixels).max(1)) {
        let [a, b, c] = variation.channels;
        let [e, f, g] = variation.gain;
        for (channel, gain) in [(a, e), (b, f), (c, g), (3, 1.0)] {
            for row in view[channel * pixels..(channel + 1) * pixels].chunks_exact(crops.width) {
                if variation.flip {
                    out.extend(row.iter().rev().map(|v| v * gain));
                } else {
                    out.extend(row.iter().map(|v| v * gain));
                }
            }
        }
    }
    network.pictures(out, crops.views, crops.height, crops.width)
}

fn forward(
    network: &Network,
    sample: &TrainingSample,
    target: &Target,
    [visible, node_feature]: [Tensor<2>; 2],
    variation: Variation,
    [structure_weight, contrast_weight]: [f32; 2],
) -> Forward {
    let count = target.state.len();
    let mut state: Vec<[f32; STATE]> = target.state.iter().map(|row| variation.state(row)).collect();
    if !variation.space {
        state.iter_mut().for_each(|row| row[4..11].fill(0.0));
    }
    let weight = network.table(state.iter().map(|row| row[3]).collect(), 1);
    let current = if variation.space {
        let inputs: Vec<[f32; NODE]> = sample.nodes.iter().map(|row| variation.row(row, &[0, 4])).collect();
        let place = network.table(sample.place.as_flattened().to_vec(), PLACE);
        let edges = network.indices(sample.edges.as_flattened().iter().copied());
        let graph = network.graph(node_feature, network.node_inputs(&inputs), place, &edges);
        let node = network.size.node;
        let shares = network.table(target.node_weights.as_flattened().to_vec(), 4).reshape([count, 4, 1]);
        let gathered = graph.select(0, network.indices(target.nodes.as_flattened().iter().copied()));
        let around = (gathered.reshape([count, 4, node]) * shares).sum_dim(1).reshape([count, node]);
        network.fill(visible, weight, around)
    } else {
        visible
    };
    let base = network.table(state.iter().flat_map(|row| [row[0], row[1], row[2]]).collect(), 3);
    let rows = Tensor::cat(vec![network.table(state.as_flattened().to_vec(), STATE), current], 1);
    let color = linear_from_srgb(network.color(rows));

    let pixels = target.truth.len();
    let shares = network.table(target.shares.as_flattened().to_vec(), SHARES);
    let alpha = shares.clone().sum_dim(1);
    let which = network.indices(target.gaussians.as_flattened().iter().copied());
    let composed = |color: Tensor<2>| -> Tensor<2> {
        let parts =
            color.select(0, which.clone()).reshape([pixels, SHARES, 3]) * shares.clone().reshape([pixels, SHARES, 1]);
        let premultiplied = parts.sum_dim(1).reshape([pixels, 3]);
        // As the rasteriser's pictures are encoded: straight alpha, the sRGB value times alpha.
        srgb_from_linear(premultiplied / alpha.clone().clamp_min(1e-3)) * alpha.clone()
    };
    let truth = target.truth.iter().flat_map(|pixel| {
        let varied = |c: usize| variation.gain[c] * f32::from(pixel[variation.channels[c]]) / 255.0;
        [varied(0), varied(1), varied(2)]
    });
    let truth = network.table(truth.collect(), 3);
    // Only colours can be learned here. Where drawing and truth do not cover the same pixels, black against cloth would
    // teach dark seams: the difference counts as far as both cover a pixel.
    let covered = network.table(target.truth.iter().map(|pixel| f32::from(pixel[3]) / 255.0).collect(), 1);
    let (ours, direct) = (composed(color), composed(base));
    let difference = |of: Tensor<2>| of * covered.clone() - truth.clone() * alpha.clone();
    let mean = |difference: Tensor<2>| difference.powf_scalar(2.0).mean();
    let number = |tensor: Tensor<1>| to_vec(tensor).first().copied().map_or(f64::NAN, f64::from);
    let color_mse = mean(difference(ours.clone()));
    let errors = SampleErrors {
        mse: number(mean(ours.clone() - truth.clone())),
        direct_mse: number(mean(direct.clone() - truth.clone())),
        color_mse: number(color_mse.clone()),
        direct_color_mse: number(mean(difference(direct.clone()))),
        ..SampleErrors::default()
    };
    let [ours, direct] = [ours, direct].map(|of| of * covered.clone());
    let truth = truth * alpha;
    let [our_contrast, direct_contrast, true_contrast] =
        [ours.clone(), direct.clone(), truth.clone()].map(fine_contrast);
    let similarity = structural_similarity(ours, truth.clone());
    let share = |of: Tensor<4>| number(of.mean()) / number(true_contrast.clone().mean());
    let errors = SampleErrors {
        contrast: share(our_contrast.clone()),
        direct_contrast: share(direct_contrast),
        ssim: number(similarity.clone()),
        direct_ssim: number(structural_similarity(direct, truth)),
        ..errors
    };
    let importance = USUAL_MSE / (errors.direct_color_mse + SMALL_MSE);
    // Patch by patch: where misaligned detail cannot be right in any single window, its amount still can.
    let of_patch = |of: Tensor<4>| of.mean_dim(3).mean_dim(2);
    let faded = (of_patch(our_contrast) - of_patch(true_contrast)).abs().mean();
    let loss = color_mse * importance + (1.0 - similarity) * structure_weight + faded * contrast_weight;
    Forward { loss, errors }
}

#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;

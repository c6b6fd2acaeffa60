//! Training on pixels of held-out cameras, compared with the rendering of the coloured Gaussians.
//!
//! An image is linear in the Gaussians' colours, so a sample carries the shares of the Gaussians in its pixels and
//! nothing is rendered. The temporal memory is excluded, as in the paper. Pixel-aligned sampling separates two tapes:
//! the gradient of the sampled features is computed by hand with respect to the feature maps and passed to the
//! encoder's tape.

use std::{collections::BTreeMap, path::Path};

use flyrig_learn::{
    AdamStep, Moments,
    burn_tensor::{Device, Tensor, TensorData},
    to_vec,
};
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng, seq::SliceRandom as _};
use safetensors::SafeTensors;
use serde::{Deserialize, Serialize};

use crate::{
    Parameters, StfaError,
    comparison::{Comparison, PixelLoss, planes},
    network::{Network, feature_maps},
    sample::{TargetPixels, TrainingSample},
    taps::Taps,
    tensor_file::{TensorFile, array, read},
    train_settings::TrainSettings,
    variation::Variation,
    weights::header,
};

/// Decay rates of Adam's moments (Kingma and Ba 2015).
const BETAS: [f32; 2] = [0.9, 0.99];
/// Length to which longer gradients are clipped.
const MAX_GRADIENT: f32 = 1.0;

/// Loss of one step, and of direct appearance on the same pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Loss {
    /// Number of the step.
    pub step: u64,
    /// Mean squared sRGB difference.
    pub mse: f64,
    /// Mean squared sRGB difference of direct appearance.
    pub direct_mse: f64,
}

/// State of a training: everything that the next step depends on.
#[derive(Debug, Clone, PartialEq)]
pub struct Trainer {
    /// Trained parameters.
    pub parameters: Parameters,
    /// Settings.
    pub settings: TrainSettings,
    /// Completed steps.
    pub step: u64,
    /// Mean and mean square of each gradient.
    moments: BTreeMap<String, Moments>,
}

impl Trainer {
    /// Starts a training from these weights.
    #[must_use]
    pub fn new(parameters: Parameters, settings: TrainSettings) -> Self {
        let zeros = |count: usize| [vec![0.0; count], vec![0.0; count]];
        let moments = parameters.by_name.iter().map(|(name, p)| (name.clone(), zeros(p.values.len()))).collect();
        Self { parameters, settings, step: 0, moments }
    }

    /// Returns the index of the next step's sample among `count`: every sample once per round, in random order.
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

    /// Performs one step on one sample. A step with a non-finite loss or gradient changes nothing but the count.
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
        let (loss, sums) = self.gradients(sample, target, variation)?;
        self.adam(step, &sums);
        Some(Loss { step, mse: loss.mse, direct_mse: loss.direct_mse })
    }

    /// Computes the loss and dL/d parameters.
    fn gradients(
        &self,
        sample: &TrainingSample,
        target: &TargetPixels,
        variation: Variation,
    ) -> Option<(PixelLoss, BTreeMap<String, Vec<f32>>)> {
        let device = Device::flex().autodiff();
        let tensors = self.parameters.tensors(&device, true);
        let network = Network { device, size: self.parameters.size, tensors };
        let levels = network.encode(planes(&network, sample, variation));
        let maps = feature_maps(&levels);
        let feature = network.size.feature();
        let leaf = |taps: &Taps| network.table(taps.sample(&maps), feature).require_grad();
        let taps = [&target.taps, &sample.node_taps].map(|taps| variation.taps(taps, sample.crops.width));
        let (visible, nodes) = (leaf(&taps[0]), leaf(&taps[1]));
        let features = [visible.clone(), nodes.clone()];
        let loss = Comparison::new(&network, sample, target, features, variation)
            .loss(self.settings.structure, self.settings.contrast);
        if !loss.mse.is_finite() {
            return None;
        }
        let gradients = loss.total.clone().backward();
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
        Some((loss, sums))
    }

    fn adam(&mut self, step: u64, gradients: &BTreeMap<String, Vec<f32>>) {
        let length = gradients.values().flatten().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt() as f32;
        if !length.is_finite() {
            return;
        }
        let shorten = (MAX_GRADIENT / length.max(1e-12)).min(1.0);
        let progress = (step as f32 / self.settings.steps.max(1) as f32).min(1.0);
        let rate = self.settings.rate * 0.5 * (1.0 + (std::f32::consts::PI * progress).cos());
        for (name, gradient) in gradients {
            let (Some(parameter), Some(moments)) = (self.parameters.by_name.get_mut(name), self.moments.get_mut(name))
            else {
                continue;
            };
            // Biases and scales have one dimension.
            let decay = if parameter.shape.len() > 1 { rate * self.settings.decay } else { 0.0 };
            AdamStep { betas: BETAS, count: step + 1, rate, decay, scale: shorten, share: 0.0 }.descend(
                &mut parameter.values,
                moments,
                gradient,
            );
        }
    }

    /// Writes the state atomically.
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

    /// Resumes from a state written by [`Self::save`].
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

#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;

//! Comparison of the Gaussians' colours with the pixels of a held-out camera.

use flyrig_learn::{
    burn_tensor::{Device, Tensor},
    to_vec,
};
use flyrig_renderer::AppearanceSettings;

use crate::{
    Parameters,
    body_graph::PLACE,
    inputs::{NODE, STATE},
    network::{Network, feature_maps, linear_from_srgb, srgb_from_linear},
    sample::{SHARES, TargetPixels, TrainingSample},
    structure::{fine_contrast, structural_similarity},
    taps::Taps,
    variation::Variation,
};

/// Loss of direct appearance to which each sample is normalised, so that well and badly tracked people have equal
/// weight.
const USUAL_MSE: f64 = 0.01;
/// Constant added to direct appearance's loss before the normalisation.
const SMALL_MSE: f64 = 5e-4;

/// Errors of rendered pixels against the truth, sRGB.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Errors {
    /// Mean squared difference of the pixels on black: shape and colour.
    pub mse: f64,
    /// Mean squared difference where rendering and truth both cover a pixel: colour only.
    pub color_mse: f64,
    /// Mean structural similarity of the patches, of colour only.
    pub ssim: f64,
    /// Fine contrast relative to the truth's.
    pub contrast: f64,
}

/// Errors of networks and direct appearance on the same pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SampleErrors {
    /// Errors of the networks.
    pub learned: Errors,
    /// Errors of direct appearance.
    pub direct: Errors,
}

/// Computes the errors on all targets of a sample; `None` without any.
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
        let features = [table(&target.taps), table(&sample.node_taps)];
        let errors = Comparison::new(&network, sample, target, features, variation).errors();
        let count = target.truth.len() as f64;
        sum.learned.add(errors.learned, count);
        sum.direct.add(errors.direct, count);
        pixels += count;
    }
    let mut mean = SampleErrors::default();
    mean.learned.add(sum.learned, 1.0 / pixels);
    mean.direct.add(sum.direct, 1.0 / pixels);
    Some(mean)
}

impl Errors {
    fn add(&mut self, other: Self, times: f64) {
        self.mse += other.mse * times;
        self.color_mse += other.color_mse * times;
        self.ssim += other.ssim * times;
        self.contrast += other.contrast * times;
    }
}

/// Rendered pixels (pixel, sRGB) on black and the camera's pixels.
struct Pixels {
    ours: Tensor<2>,
    direct: Tensor<2>,
    truth: Tensor<2>,
}

/// Pixels of a target, unmasked and masked to where rendering and truth both cover them: elsewhere, black against cloth
/// would teach dark seams, and only colours can be learned here.
pub(crate) struct Comparison {
    whole: Pixels,
    covered: Pixels,
}

/// Training loss.
pub(crate) struct PixelLoss {
    pub(crate) total: Tensor<1>,
    /// Mean squared difference on black.
    pub(crate) mse: f64,
    /// Mean squared difference of direct appearance on black.
    pub(crate) direct_mse: f64,
}

impl Comparison {
    /// Renders a target with the networks' colours and with those of direct appearance; `visible` and `node_feature`
    /// are the sampled features of Gaussians and nodes.
    pub(crate) fn new(
        network: &Network,
        sample: &TrainingSample,
        target: &TargetPixels,
        [visible, node_feature]: [Tensor<2>; 2],
        variation: Variation,
    ) -> Self {
        let mut state: Vec<[f32; STATE]> = target.state.iter().map(|row| variation.state(row)).collect();
        if !variation.space {
            state.iter_mut().for_each(|row| row[4..11].fill(0.0));
        }
        let current = if variation.space {
            with_graph(network, sample, target, [visible, node_feature], &state, variation)
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
            let parts = color.select(0, which.clone()).reshape([pixels, SHARES, 3])
                * shares.clone().reshape([pixels, SHARES, 1]);
            let premultiplied = parts.sum_dim(1).reshape([pixels, 3]);
            // As the rasteriser's images are encoded: straight alpha, the sRGB value times alpha.
            srgb_from_linear(premultiplied / alpha.clone().clamp_min(1e-3)) * alpha.clone()
        };
        let truth = target.truth.iter().flat_map(|pixel| {
            let varied = |c: usize| variation.gain[c] * f32::from(pixel[variation.channels[c]]) / 255.0;
            [varied(0), varied(1), varied(2)]
        });
        let truth = network.table(truth.collect(), 3);
        let mask = network.table(target.truth.iter().map(|pixel| f32::from(pixel[3]) / 255.0).collect(), 1);
        let whole = Pixels { ours: composed(color), direct: composed(base), truth };
        let covered = Pixels {
            ours: whole.ours.clone() * mask.clone(),
            direct: whole.direct.clone() * mask,
            truth: whole.truth.clone() * alpha,
        };
        Self { whole, covered }
    }

    /// Computes the weighted sum of squared differences, 1 - SSIM, and the difference of fine contrast.
    pub(crate) fn loss(&self, structure_weight: f32, contrast_weight: f32) -> PixelLoss {
        let Pixels { ours, direct, truth } = &self.covered;
        let importance = USUAL_MSE / (number(mse(direct, truth)) + SMALL_MSE);
        let similarity = structural_similarity(ours.clone(), truth.clone());
        // Patch by patch: where misaligned detail cannot be right in any single window, its amount still can.
        let of_patch = |of: &Tensor<2>| fine_contrast(of.clone()).mean_dim(3).mean_dim(2);
        let faded = (of_patch(ours) - of_patch(truth)).abs().mean();
        PixelLoss {
            total: mse(ours, truth) * importance + (1.0 - similarity) * structure_weight + faded * contrast_weight,
            mse: number(mse(&self.whole.ours, &self.whole.truth)),
            direct_mse: number(mse(&self.whole.direct, &self.whole.truth)),
        }
    }

    fn errors(&self) -> SampleErrors {
        let Pixels { ours, direct, truth } = &self.covered;
        let contrast = |of: &Tensor<2>| number(fine_contrast(of.clone()).mean());
        let errors = |whole: &Tensor<2>, covered: &Tensor<2>| Errors {
            mse: number(mse(whole, &self.whole.truth)),
            color_mse: number(mse(covered, truth)),
            ssim: number(structural_similarity(covered.clone(), truth.clone())),
            contrast: contrast(covered) / contrast(truth),
        };
        SampleErrors { learned: errors(&self.whole.ours, ours), direct: errors(&self.whole.direct, direct) }
    }
}

fn mse(a: &Tensor<2>, b: &Tensor<2>) -> Tensor<1> {
    (a.clone() - b.clone()).powf_scalar(2.0).mean()
}

/// Returns the number of a tensor of one element; NaN for an empty one.
pub(crate) fn number(tensor: Tensor<1>) -> f64 {
    to_vec(tensor).first().copied().map_or(f64::NAN, f64::from)
}

/// Computes f_curr of Eq. 9 at the target's Gaussians.
fn with_graph(
    network: &Network,
    sample: &TrainingSample,
    target: &TargetPixels,
    [visible, node_feature]: [Tensor<2>; 2],
    state: &[[f32; STATE]],
    variation: Variation,
) -> Tensor<2> {
    let (count, node) = (state.len(), network.size.node);
    let inputs: Vec<[f32; NODE]> = sample.nodes.iter().map(|row| variation.row(row, &[0, 4])).collect();
    let place = network.table(sample.place.as_flattened().to_vec(), PLACE);
    let edges = network.indices(sample.edges.as_flattened().iter().copied());
    let graph = network.graph(node_feature, network.node_inputs(&inputs), place, &edges);
    let shares = network.table(target.node_weights.as_flattened().to_vec(), 4).reshape([count, 4, 1]);
    let gathered = graph.select(0, network.indices(target.nodes.as_flattened().iter().copied()));
    let around = (gathered.reshape([count, 4, node]) * shares).sum_dim(1).reshape([count, node]);
    let weight = network.table(state.iter().map(|row| row[3]).collect(), 1);
    network.fill(visible, weight, around)
}

/// Returns the input images of this variation in the encoder's format.
pub(crate) fn planes(network: &Network, sample: &TrainingSample, variation: Variation) -> Tensor<4> {
    let crops = &sample.crops;
    let pixels = crops.width * crops.height;
    let mut out = Vec::with_capacity(4 * pixels * crops.views);
    for view in 0..crops.views {
        let view = crops.planes(view, &AppearanceSettings::default());
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

//! Neural texture and its convolutional encoder: an atlas of coefficients of spherical harmonics.

use std::collections::BTreeMap;

use flyrig_learn::{Convolution, Parameter, Planes, Start};

use crate::local::atlas_map::AtlasMap;
use crate::local::decoders::he;

/// Features per texel of the neural texture.
pub(super) const FEATURES: usize = 8;
/// Channels of the encoder's hidden layers.
pub(super) const HIDDEN: usize = 16;
/// Initial spread of the neural texture: small, since its noise remains visible where no image corrects it.
const SPREAD: f32 = 0.05;
/// Initial spread of the hidden layers' biases, so that a texture without contrast has features too.
const SHIFT: f32 = 0.3;
/// Channels that each layer takes.
const INPUTS: [usize; 3] = [FEATURES, HIDDEN, HIDDEN];

/// Returns the parameters for an atlas of this many coefficients. The last layer is zero: nothing is added to the first
/// atlas.
pub(super) fn parameters(map: &AtlasMap, coefficients: usize) -> Vec<Start> {
    let mut list = vec![("texture".to_owned(), vec![map.charts, FEATURES, map.side, map.side], SPREAD)];
    let outputs = [HIDDEN, HIDDEN, 3 * coefficients];
    let spreads = [(he(9 * FEATURES), SHIFT), (he(9 * HIDDEN), SHIFT), (0.0, 0.0)];
    for (layer, (spread, shift)) in spreads.into_iter().enumerate() {
        let shape = vec![outputs[layer], INPUTS[layer], 3, 3];
        list.push((format!("encoder.{layer}.weight"), shape, spread));
        list.push((format!("encoder.{layer}.bias"), vec![outputs[layer]], shift));
    }
    list
}

/// Residual atlas with all that its derivatives need.
#[derive(Debug)]
pub(super) struct Encoded {
    /// Atlas: chart, channel, row, column.
    pub atlas: Vec<f32>,
    layers: [Convolution; 3],
    /// Inputs of each layer, for every chart.
    inputs: Vec<[Planes; 3]>,
}

impl Encoded {
    /// Computes the residual atlas from the parameters of [`parameters`].
    pub fn new(parameters: &BTreeMap<String, Parameter>, map: &AtlasMap) -> Self {
        let values = |name: &str| parameters.get(name).map_or(&[][..], |p| p.values.as_slice());
        let layers = [0, 1, 2].map(|layer| {
            let [weight, bias] = ["weight", "bias"].map(|part| values(&format!("encoder.{layer}.{part}")));
            Convolution::new(INPUTS[layer], weight, bias)
        });
        let mut atlas = Vec::new();
        let charts = values("texture").chunks_exact((FEATURES * map.texels()).max(1));
        let inputs = charts.map(|texture| {
            let texture = Planes::new(FEATURES, map.side, map.side, texture);
            let first = layers[0].forward(&texture, true);
            let second = layers[1].forward(&first, true);
            atlas.extend(layers[2].forward(&second, false).to_vec());
            [texture, first, second]
        });
        let inputs = inputs.collect();
        Self { atlas, layers, inputs }
    }

    /// Returns the derivatives with respect to all parameters, by name, from those with respect to the atlas.
    pub fn backward(&self, slopes: &[f32]) -> BTreeMap<String, Vec<f32>> {
        let mut found: BTreeMap<String, Vec<f32>> = BTreeMap::new();
        let length = slopes.len() / self.inputs.len().max(1);
        for (inputs, slopes) in self.inputs.iter().zip(slopes.chunks_exact(length.max(1))) {
            let [height, width] = inputs[0].size();
            let mut slopes = Planes::new(length / (height * width).max(1), height, width, slopes);
            for (layer, input) in inputs.iter().enumerate().rev() {
                // The texture itself was not rectified.
                let of = self.layers[layer].backward(input, &slopes, layer > 0);
                for (part, slopes) in [("weight", of.weights), ("bias", of.biases)] {
                    let sum = found.entry(format!("encoder.{layer}.{part}")).or_insert_with(|| vec![0.0; slopes.len()]);
                    sum.iter_mut().zip(slopes).for_each(|(sum, slope)| *sum += slope);
                }
                slopes = of.input;
            }
            found.entry("texture".to_owned()).or_default().extend(slopes.to_vec());
        }
        found
    }
}

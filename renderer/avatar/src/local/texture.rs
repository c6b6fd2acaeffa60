//! Neural texture and its convolutional encoder: an atlas of coefficients of spherical harmonics.

use flyrig_learn::{
    Start, Tensors,
    burn_tensor::{Device, Tensor, activation, module, ops::ConvOptions},
};

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

/// Returns the parameters for an atlas of this many coefficients. The last layer is zero: nothing is added to the first
/// atlas.
pub(super) fn parameters(map: &AtlasMap, coefficients: usize) -> Vec<Start> {
    let mut list = vec![("texture".to_owned(), vec![map.charts, FEATURES, map.side, map.side], SPREAD)];
    let layers = [
        (FEATURES, HIDDEN, he(9 * FEATURES), SHIFT),
        (HIDDEN, HIDDEN, he(9 * HIDDEN), SHIFT),
        (HIDDEN, 3 * coefficients, 0.0, 0.0),
    ];
    for (layer, (from, to, spread, shift)) in layers.into_iter().enumerate() {
        list.push((format!("encoder.{layer}.weight"), vec![to, from, 3, 3], spread));
        list.push((format!("encoder.{layer}.bias"), vec![to], shift));
    }
    list
}

/// Computes the residual atlas (chart, channel, row, column).
pub(super) fn encode(tensors: &Tensors, device: &Device) -> Tensor<4> {
    let conv = |x: Tensor<4>, layer: usize| {
        let weight = tensors.get(&format!("encoder.{layer}.weight"), device);
        let bias = tensors.get(&format!("encoder.{layer}.bias"), device);
        module::conv2d(x, weight, Some(bias), ConvOptions::new([1; 2], [1; 2], [1; 2], 1))
    };
    let x = activation::relu(conv(tensors.get("texture", device), 0));
    let x = activation::relu(conv(x, 1));
    conv(x, 2)
}

//! Geometry decoders: from features of a place to scales, rotations and opacities of its group (LoGAvatar Eq. 12), and to offsets where the
//! stage has no displacements of its own (Eq. 13).

use flyrig_learn::{
    Start, Tensors,
    burn_tensor::{Device, Tensor, activation},
};

use crate::local::hash::WIDTH;

/// Width of the hidden layers.
pub(super) const HIDDEN: usize = 64;
/// Metres of one unit of a predicted offset.
pub(super) const OFFSET_M: f32 = 0.01;

/// A branch, and its outputs for one Gaussian.
pub(super) const BRANCHES: [(&str, usize); 4] = [("scale", 3), ("rotation", 4), ("opacity", 1), ("offset", 3)];

/// Branches of a stage: the first one's offsets are free displacements.
pub(super) fn branches(stage: usize) -> &'static [(&'static str, usize)] {
    if stage == 0 { &BRANCHES[..3] } else { &BRANCHES }
}

/// Spread that keeps the size of features through a layer with ReLU (He et al. 2015).
pub(super) fn he(inputs: usize) -> f32 {
    (2.0 / inputs as f32).sqrt()
}

/// Parameters of a stage with `slots` Gaussians in a group. The last layers are zero: nothing is added to the start.
pub(super) fn parameters(stage: usize, slots: usize) -> Vec<Start> {
    let mut list = Vec::new();
    for (branch, outputs) in branches(stage) {
        let layers = [(WIDTH, HIDDEN, he(WIDTH)), (HIDDEN, HIDDEN, he(HIDDEN)), (HIDDEN, slots * outputs, 0.0)];
        for (layer, (from, to, spread)) in layers.into_iter().enumerate() {
            list.push((format!("stage.{stage}.{branch}.{layer}.weight"), vec![from, to], spread));
            list.push((format!("stage.{stage}.{branch}.{layer}.bias"), vec![to], 0.0));
        }
    }
    list
}

/// Outputs of all branches: a row an input.
pub(super) fn decode(tensors: &Tensors, device: &Device, stage: usize, features: &Tensor<2>) -> Vec<Tensor<2>> {
    let linear = |x: Tensor<2>, name: &str, layer: usize| -> Tensor<2> {
        let weight: Tensor<2> = tensors.get(&format!("stage.{stage}.{name}.{layer}.weight"), device);
        let bias: Tensor<1> = tensors.get(&format!("stage.{stage}.{name}.{layer}.bias"), device);
        x.matmul(weight) + bias.unsqueeze::<2>()
    };
    let of = |(branch, _): &(&str, usize)| {
        let x = activation::relu(linear(features.clone(), branch, 0));
        let x = activation::relu(linear(x, branch, 1));
        linear(x, branch, 2)
    };
    branches(stage).iter().map(of).collect()
}

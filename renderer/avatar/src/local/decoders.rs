//! Geometry decoders: from features of a position to scales, rotations and opacities of its group (LoGAvatar Eq. 12),
//! and to offsets in stages without displacements of their own (Eq. 13).

use flyrig_learn::{
    Start, Tensors,
    burn_tensor::{Device, Tensor, activation},
};

use crate::local::hash::WIDTH;

/// Width of the hidden layers.
pub(super) const HIDDEN: usize = 64;
/// Metres of one unit of a predicted offset.
pub(super) const OFFSET_M: f32 = 0.01;

/// Name of a branch and its number of outputs per Gaussian.
pub(super) const BRANCHES: [(&str, usize); 4] = [("scale", 3), ("rotation", 4), ("opacity", 1), ("offset", 3)];

/// Returns the branches of a stage; the first stage's offsets are free displacements instead.
pub(super) fn branches(stage: usize) -> &'static [(&'static str, usize)] {
    if stage == 0 { &BRANCHES[..3] } else { &BRANCHES }
}

/// Returns the spread that preserves the size of features through a layer with ReLU (He et al. 2015).
pub(super) fn he(inputs: usize) -> f32 {
    (2.0 / inputs as f32).sqrt()
}

/// Returns the parameters of a stage with `slots` Gaussians per group. The last layers are zero: nothing is added to
/// the start.
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

/// Computes the outputs of all branches, one row per input.
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

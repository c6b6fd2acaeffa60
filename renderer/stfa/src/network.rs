//! Networks on burn's tensors, for training and inference: encoder, graph transformer, inpainting (Eq. 9), colour.

use flyrig_learn::{
    Tensors,
    burn_tensor::{Device, Int, Tensor, TensorData, activation, module, ops::ConvOptions},
    to_vec,
};

use crate::{
    BodyGraph, NetworkSize,
    body_graph::{EDGES, PLACE},
    inputs::{CANDIDATES, NODE, STATE},
    taps::FeatureMaps,
};

/// Largest step towards a candidate; above 1, since detail blurred by rendering may be exaggerated.
const GATE: f32 = 1.5;
/// Largest residual, sRGB.
const RESIDUAL: f32 = 0.3;

/// Parameters on a device.
#[derive(Debug, Clone)]
pub(crate) struct Network {
    pub(crate) device: Device,
    pub(crate) size: NetworkSize,
    pub(crate) tensors: Tensors,
}

impl Network {
    fn linear(&self, x: Tensor<2>, name: &str) -> Tensor<2> {
        let weight: Tensor<2> = self.tensors.get(&format!("{name}.weight"), &self.device);
        let bias: Tensor<1> = self.tensors.get(&format!("{name}.bias"), &self.device);
        x.matmul(weight) + bias.unsqueeze::<2>()
    }

    fn conv(&self, x: Tensor<4>, name: &str, stride: usize) -> Tensor<4> {
        let weight = self.tensors.get(&format!("encoder.{name}.weight"), &self.device);
        let bias = self.tensors.get(&format!("encoder.{name}.bias"), &self.device);
        let options = ConvOptions::new([stride; 2], [1; 2], [1; 2], 1);
        activation::relu(module::conv2d(x, weight, Some(bias), options))
    }

    /// Computes feature maps at three scales, channels last, of images (views, 4, height, width).
    pub(crate) fn encode(&self, pictures: Tensor<4>) -> [Tensor<4>; 3] {
        let full = self.conv(pictures, "full", 1);
        let half = self.conv(full.clone(), "half", 2);
        let quarter = self.conv(half.clone(), "quarter", 2);
        let quarter = self.conv(quarter, "mix", 1);
        [full, half, quarter].map(|maps| maps.permute([0, 2, 3, 1]))
    }

    /// Applies the graph-transformer convolutions (Shi et al. 2021) over the nodes: image feature, node inputs,
    /// positional encoding -> node feature.
    pub(crate) fn graph(
        &self,
        feature: Tensor<2>,
        inputs: Tensor<2>,
        place: Tensor<2>,
        edges: &Tensor<1, Int>,
    ) -> Tensor<2> {
        let NetworkSize { node, heads, layers, .. } = self.size;
        let nodes = feature.dims()[0];
        let mut x = activation::relu(self.linear(Tensor::cat(vec![feature, inputs, place], 1), "graph.in"));
        for layer in 0..layers {
            let project = |what: &str| self.linear(x.clone(), &format!("graph.{layer}.{what}"));
            let (query, key, value) = (project("query"), project("key"), project("value"));
            let at_edges = |of: Tensor<2>, kind: &str| -> Tensor<4> {
                let edge: Tensor<2> = self.tensors.get(&format!("graph.{layer}.{kind}"), &self.device);
                let gathered = of.select(0, edges.clone()).reshape([nodes, EDGES, node]) + edge.unsqueeze::<3>();
                gathered.reshape([nodes, EDGES, heads, node / heads])
            };
            let (key, value) = (at_edges(key, "edge_key"), at_edges(value, "edge_value"));
            let query = query.reshape([nodes, 1, heads, node / heads]);
            let scores = (query * key).sum_dim(3) / ((node / heads) as f32).sqrt();
            let attention = activation::softmax(scores, 1);
            let message = (attention * value).sum_dim(1).reshape([nodes, node]);
            x = activation::relu(self.normalized(message + project("skip"), layer));
        }
        x
    }

    /// Applies layer normalisation.
    fn normalized(&self, x: Tensor<2>, layer: usize) -> Tensor<2> {
        let centered = x.clone() - x.mean_dim(1);
        let variance = centered.clone().powf_scalar(2.0).mean_dim(1);
        let scale: Tensor<1> = self.tensors.get(&format!("graph.{layer}.scale"), &self.device);
        let shift: Tensor<1> = self.tensors.get(&format!("graph.{layer}.shift"), &self.device);
        centered / (variance + 1e-5).sqrt() * scale.unsqueeze::<2>() + shift.unsqueeze::<2>()
    }

    /// Computes f_curr of Eq. 9 from f_vis, w_vis and the graph's feature at the Gaussians.
    pub(crate) fn fill(&self, visible: Tensor<2>, weight: Tensor<2>, graph: Tensor<2>) -> Tensor<2> {
        let filled = self.linear(Tensor::cat(vec![graph, visible.clone()], 1), "fill");
        (1.0 - weight) * filled + visible
    }

    /// Computes sRGB colours from rows of [`STATE`] numbers and a feature: the base colour, moved towards the
    /// candidates and by a residual.
    pub(crate) fn color(&self, rows: Tensor<2>) -> Tensor<2> {
        let count = rows.dims()[0];
        let base = srgb_from_linear(rows.clone().narrow(1, 0, 3));
        let candidates = rows.clone().narrow(1, STATE - 3 * CANDIDATES, 3 * CANDIDATES);
        // The colour network sees the encoded colour: dark cloth is not all the same.
        let seen = Tensor::cat(vec![base.clone(), rows.narrow(1, 3, self.size.row() - 3)], 1);
        let x = activation::relu(self.linear(seen, "color.0"));
        let x = activation::relu(self.linear(x, "color.1"));
        let out = self.linear(x, "color.2").tanh();
        let gates = out.clone().narrow(1, 0, CANDIDATES).reshape([count, CANDIDATES, 1]) * GATE;
        let moved = (gates * candidates.reshape([count, CANDIDATES, 3])).sum_dim(1).reshape([count, 3]);
        base + moved + out.narrow(1, CANDIDATES, 3) * RESIDUAL
    }

    /// Creates a tensor of planes (views, 4, height, width).
    pub(crate) fn pictures(&self, planes: Vec<f32>, views: usize, height: usize, width: usize) -> Tensor<4> {
        Tensor::from_data(TensorData::new(planes, [views, 4, height, width]), &self.device)
    }

    /// Creates a table with `columns` columns.
    pub(crate) fn table(&self, values: Vec<f32>, columns: usize) -> Tensor<2> {
        let rows = values.len() / columns.max(1);
        Tensor::from_data(TensorData::new(values, [rows, columns]), &self.device)
    }

    /// Creates indices for `select`.
    pub(crate) fn indices(&self, values: impl Iterator<Item = u32>) -> Tensor<1, Int> {
        let values: Vec<i32> = values.map(|v| i32::try_from(v).unwrap_or(0)).collect();
        let count = values.len();
        Tensor::from_data(TensorData::new(values, [count]), &self.device)
    }

    /// Returns the graph network's constant inputs for this body: positional encoding and edges.
    pub(crate) fn body_tensors(&self, body: &BodyGraph) -> (Tensor<2>, Tensor<1, Int>) {
        let place = self.table(body.place.as_flattened().to_vec(), PLACE);
        (place, self.indices(body.edges.as_flattened().iter().copied()))
    }

    /// Creates the node inputs of a frame.
    pub(crate) fn node_inputs(&self, nodes: &[[f32; NODE]]) -> Tensor<2> {
        self.table(nodes.as_flattened().to_vec(), NODE)
    }
}

/// Converts the encoder's maps to plain numbers.
pub(crate) fn feature_maps(levels: &[Tensor<4>; 3]) -> Vec<FeatureMaps> {
    levels
        .iter()
        .zip([1, 2, 4])
        .map(|(level, stride)| {
            let [_, height, width, channels] = level.dims();
            FeatureMaps { width, height, channels, stride, values: to_vec(level.clone()) }
        })
        .collect()
}

/// sRGB encoding, element by element; below 1e-4 linear its slope is that of the straight part.
pub(crate) fn srgb_from_linear<const D: usize>(linear: Tensor<D>) -> Tensor<D> {
    let linear = linear.clamp(0.0, 1.0);
    let dark = linear.clone().lower_elem(0.003_130_8);
    let curve = linear.clone().clamp_min(0.003_130_8).powf_scalar(1.0 / 2.4) * 1.055 - 0.055;
    curve.mask_where(dark, linear * 12.92)
}

/// The way back.
pub(crate) fn linear_from_srgb<const D: usize>(srgb: Tensor<D>) -> Tensor<D> {
    let srgb = srgb.clamp(0.0, 1.0);
    let dark = srgb.clone().lower_elem(0.040_45);
    let curve = ((srgb.clone().clamp_min(0.040_45) + 0.055) / 1.055).powf_scalar(2.4);
    curve.mask_where(dark, srgb / 12.92)
}

#[cfg(test)]
#[path = "network_tests.rs"]
mod tests;

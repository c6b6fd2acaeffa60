//! The networks' numbers: what there is, how it starts, and its way into tensors.

use std::collections::BTreeMap;

use burn_tensor::{Device, Gradients, Tensor, TensorData};
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};
use serde::{Deserialize, Serialize};

use crate::{
    body_graph::{EDGES, PLACE},
    inputs::{CANDIDATES, NODE, STATE},
};

/// Sizes of the networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkSize {
    /// Channels of the encoder's maps at full, half and quarter size.
    pub channels: [usize; 3],
    /// Features of a graph node.
    pub node: usize,
    /// Attention heads of a graph layer; divides `node`.
    pub heads: usize,
    /// Graph-transformer layers.
    pub layers: usize,
    /// Widths of the colour network's two hidden layers.
    pub hidden: [usize; 2],
}

impl NetworkSize {
    /// Small enough for two CPU cores.
    pub const SMALL: Self = Self { channels: [8, 16, 24], node: 32, heads: 2, layers: 3, hidden: [48, 32] };

    /// Half as wide.
    pub const TINY: Self = Self { channels: [4, 8, 12], node: 16, heads: 2, layers: 2, hidden: [24, 16] };
    /// Twice as wide.
    pub const MEDIUM: Self = Self { channels: [16, 32, 48], node: 64, heads: 4, layers: 4, hidden: [96, 64] };

    /// Numbers of an image feature.
    #[must_use]
    pub fn feature(&self) -> usize {
        self.channels.iter().sum()
    }

    /// Numbers of a Gaussian that pass through the memory.
    #[must_use]
    pub fn row(&self) -> usize {
        STATE + self.feature()
    }

    /// Name, shape and spread at the start (0: all zero, negative: all one) of every parameter.
    pub(crate) fn parameters(&self) -> Vec<(String, Vec<usize>, f32)> {
        let mut list = Vec::new();
        let he = |fan_in: usize| (2.0 / fan_in as f32).sqrt();
        let [full, half, quarter] = self.channels;
        for (name, to, from) in
            [("full", full, 4), ("half", half, full), ("quarter", quarter, half), ("mix", quarter, quarter)]
        {
            list.push((format!("encoder.{name}.weight"), vec![to, from, 3, 3], he(from * 9)));
            list.push((format!("encoder.{name}.bias"), vec![to], 0.0));
        }
        let mut linear = |name: &str, from: usize, to: usize, spread: f32| {
            list.push((format!("{name}.weight"), vec![from, to], spread));
            list.push((format!("{name}.bias"), vec![to], 0.0));
        };
        let (feature, node) = (self.feature(), self.node);
        linear("graph.in", feature + NODE + PLACE, node, he(feature + NODE + PLACE));
        for layer in 0..self.layers {
            for what in ["query", "key", "value", "skip"] {
                linear(&format!("graph.{layer}.{what}"), node, node, (1.0 / node as f32).sqrt());
            }
        }
        linear("fill", node + feature, feature, (1.0 / (node + feature) as f32).sqrt());
        let [wide, narrow] = self.hidden;
        linear("color.0", self.row(), wide, he(self.row()));
        linear("color.1", wide, narrow, he(wide));
        // Starts as direct appearance: nothing is added.
        linear("color.2", narrow, OUTPUTS, 0.0);
        for layer in 0..self.layers {
            list.push((format!("graph.{layer}.edge_key"), vec![EDGES, node], 0.1));
            list.push((format!("graph.{layer}.edge_value"), vec![EDGES, node], 0.1));
            list.push((format!("graph.{layer}.scale"), vec![node], -1.0));
            list.push((format!("graph.{layer}.shift"), vec![node], 0.0));
        }
        list
    }
}

/// What the colour network gives: how far towards each candidate, and three residuals.
pub(crate) const OUTPUTS: usize = CANDIDATES + 3;

/// One parameter.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Parameter {
    pub(crate) shape: Vec<usize>,
    pub(crate) values: Vec<f32>,
}

/// All parameters by name.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// What they belong to.
    pub size: NetworkSize,
    pub(crate) by_name: BTreeMap<String, Parameter>,
}

impl Parameters {
    /// Untrained: paints as direct appearance does.
    #[must_use]
    pub fn untrained(size: NetworkSize, seed: u64) -> Self {
        let mut rng = SmallRng::seed_from_u64(seed);
        let by_name = size
            .parameters()
            .into_iter()
            .map(|(name, shape, spread)| {
                let count = shape.iter().product();
                // Uniform of the wanted standard deviation.
                let mut draw =
                    || if spread > 0.0 { rng.random_range(-1.0f32..1.0) * spread * 3f32.sqrt() } else { -spread };
                let values = (0..count).map(|_| draw()).collect();
                (name, Parameter { shape, values })
            })
            .collect();
        Self { size, by_name }
    }

    /// How many numbers there are.
    #[must_use]
    pub fn count(&self) -> usize {
        self.by_name.values().map(|p| p.values.len()).sum()
    }

    /// Whether every number is one.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.by_name.values().all(|p| p.values.iter().all(|v| v.is_finite()))
    }

    pub(crate) fn tensors(&self, device: &Device, trained: bool) -> Tensors {
        let tensor = |p: &Parameter| {
            let flat = Tensor::<1>::from_data(TensorData::new(p.values.clone(), [p.values.len()]), device);
            (if trained { flat.require_grad() } else { flat }, p.shape.clone())
        };
        Tensors { by_name: self.by_name.iter().map(|(name, p)| (name.clone(), tensor(p))).collect() }
    }
}

/// Parameters as flat tensors on a device.
#[derive(Debug, Clone)]
pub(crate) struct Tensors {
    by_name: BTreeMap<String, (Tensor<1>, Vec<usize>)>,
}

impl Tensors {
    /// The parameter in its shape. Every name comes from [`NetworkSize::parameters`]; another one gives zeros.
    pub(crate) fn get<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        match self
            .by_name
            .get(name)
            .and_then(|(flat, shape)| Some((flat, <[usize; D]>::try_from(shape.as_slice()).ok()?)))
        {
            Some((flat, shape)) => flat.clone().reshape(shape),
            None => {
                debug_assert!(false, "{name}");
                Tensor::zeros([1; D], device)
            }
        }
    }

    /// Adds dL/d parameters; those that took no part stay.
    pub(crate) fn add_gradients(&self, gradients: &Gradients, into: &mut BTreeMap<String, Vec<f32>>) {
        for (name, (flat, _)) in &self.by_name {
            let Some(gradient) = flat.grad(gradients) else { continue };
            let values = to_vec(gradient);
            let sum = into.entry(name.clone()).or_insert_with(|| vec![0.0; values.len()]);
            for (sum, value) in sum.iter_mut().zip(values) {
                *sum += value;
            }
        }
    }
}

/// The tensor's numbers in order.
pub(crate) fn to_vec<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    // Tensors here are f32 on the CPU: the conversion cannot fail.
    tensor.into_data().try_into_vec::<f32>().unwrap_or_default()
}

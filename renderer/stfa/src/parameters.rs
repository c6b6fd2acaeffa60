//! Parameters of the networks: names, shapes and initial values.

use std::collections::BTreeMap;

use flyrig_learn::{Parameter, Start, Tensors, burn_tensor::Device, drawn};
use serde::{Deserialize, Serialize};

use crate::{
    body_graph::{EDGES, PLACE},
    inputs::{CANDIDATES, NODE, STATE},
};

/// Size of the networks.
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
    /// Size for two CPU cores.
    pub const SMALL: Self = Self { channels: [8, 16, 24], node: 32, heads: 2, layers: 3, hidden: [48, 32] };

    /// Half as wide as `small`.
    pub const TINY: Self = Self { channels: [4, 8, 12], node: 16, heads: 2, layers: 2, hidden: [24, 16] };
    /// Twice as wide as `small`.
    pub const MEDIUM: Self = Self { channels: [16, 32, 48], node: 64, heads: 4, layers: 4, hidden: [96, 64] };

    /// Returns the length of an image feature.
    #[must_use]
    pub fn feature(&self) -> usize {
        self.channels.iter().sum()
    }

    /// Returns the length of a Gaussian's row in the memory.
    #[must_use]
    pub fn row(&self) -> usize {
        STATE + self.feature()
    }

    /// Returns name, shape and initial spread (0: all zero, negative: all one) of every parameter.
    pub(crate) fn parameters(&self) -> Vec<Start> {
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

/// Number of outputs of the colour network: step towards each candidate, and three residuals.
pub(crate) const OUTPUTS: usize = CANDIDATES + 3;

/// Parameters by name.
///
/// # Examples
/// ```
/// use flyrig_stfa::{NetworkSize, Parameters};
///
/// let bundled = Parameters::named("tiny".as_ref())?;
/// assert_eq!(bundled.size, NetworkSize::TINY);
/// let untrained = Parameters::untrained(NetworkSize::TINY, 1);
/// assert_eq!(untrained.count(), bundled.count());
/// assert_ne!(untrained.digest(), bundled.digest());
/// # Ok::<(), flyrig_stfa::StfaError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// Size of the networks that they belong to.
    pub size: NetworkSize,
    pub(crate) by_name: BTreeMap<String, Parameter>,
}

impl Parameters {
    /// Creates untrained parameters, which give the colours of direct appearance.
    #[must_use]
    pub fn untrained(size: NetworkSize, seed: u64) -> Self {
        Self { size, by_name: drawn(size.parameters(), seed) }
    }

    /// Returns the number of scalars.
    #[must_use]
    pub fn count(&self) -> usize {
        flyrig_learn::count(&self.by_name)
    }

    /// Returns whether every number is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        flyrig_learn::is_finite(&self.by_name)
    }

    pub(crate) fn tensors(&self, device: &Device, trained: bool) -> Tensors {
        Tensors::new(&self.by_name, device, trained)
    }
}

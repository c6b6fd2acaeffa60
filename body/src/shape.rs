//! Shape of the built-in body.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Shape target name -> weight. An empty map is the average adult.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ShapeParams(pub BTreeMap<String, f32>);

impl ShapeParams {
    /// The same shape with one target changed.
    #[must_use]
    pub fn with(mut self, name: &str, weight: f32) -> Self {
        self.0.insert(name.to_owned(), weight);
        self
    }
}

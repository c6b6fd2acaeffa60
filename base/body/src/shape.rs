//! Shape of the built-in body.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Weights of shape targets by name ([`crate::shape_targets`] lists them). An empty map is the average of young adult women and men.
///
/// Macro targets (`gender` 0 woman .. 1 man, `age` 0 ten years .. 0.5 young adult .. 1 old, `muscle`, `weight`,
/// `height`, `proportions`) lie in 0..=1 with 0.5 for the average; local measures (`stomach-tone`,
/// `upperarm-scale-vert`, ...) lie in -1..=1 with 0 for no change.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ShapeParams(pub BTreeMap<String, f32>);

impl ShapeParams {
    /// Returns the shape with one target changed.
    #[must_use]
    pub fn with(mut self, name: &str, weight: f32) -> Self {
        self.0.insert(name.to_owned(), weight);
        self
    }

    fn from_pairs(pairs: &[(&str, f32)]) -> Self {
        Self(pairs.iter().map(|(name, weight)| ((*name).to_owned(), *weight)).collect())
    }

    /// Returns the shape of an average young man.
    #[must_use]
    pub fn man() -> Self {
        Self::from_pairs(&[("gender", 1.0)])
    }

    /// Returns the shape of an average young woman.
    #[must_use]
    pub fn woman() -> Self {
        Self::from_pairs(&[("gender", 0.0)])
    }

    /// Returns the shape of a child of about ten.
    #[must_use]
    pub fn child() -> Self {
        Self::from_pairs(&[("age", 0.0)])
    }

    /// Returns the shape of a tall, lean and strong man.
    #[must_use]
    pub fn athlete() -> Self {
        Self::from_pairs(&[("gender", 1.0), ("muscle", 0.9), ("weight", 0.4), ("height", 0.58), ("torso-vshape", 0.4)])
    }

    /// Returns the shape of a heavy, middle-aged man with a belly.
    #[must_use]
    pub fn heavy_man() -> Self {
        Self::from_pairs(&[
            ("gender", 1.0),
            ("age", 0.7),
            ("weight", 0.95),
            ("muscle", 0.45),
            ("stomach-pregnant", 0.3),
        ])
    }

    /// Returns the shape of a small, slender woman.
    #[must_use]
    pub fn petite_woman() -> Self {
        Self::from_pairs(&[("gender", 0.0), ("weight", 0.35), ("height", 0.44)])
    }
}

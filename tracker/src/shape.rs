//! Bone lengths of the person.

use std::collections::BTreeMap;

/// Result of a shape fit.
#[derive(Debug, Clone, PartialEq)]
pub struct ShapeFit {
    /// Scale of the whole body.
    pub scale: f64,
    /// Length factor of each group of bones on top of `scale`, by name.
    pub groups: BTreeMap<String, f64>,
    /// Stature of the fitted template in its bind pose, metres.
    pub height_m: f64,
    /// Median landmark distance after the fit, pixels.
    pub residual_px: f64,
    /// Frame sets used.
    pub sets: usize,
}

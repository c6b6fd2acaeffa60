//! The built-in body.

use crate::{BodyError, ShapeParams, Template};

/// The built-in CC0 body in the given shape.
///
/// # Errors
/// [`BodyError::UnknownTarget`], [`BodyError::TargetWeight`].
pub fn default_template(_shape: &ShapeParams) -> Result<Template, BodyError> {
    Err(BodyError::Asset("not yet".to_owned()))
}

/// Names of the shape targets.
#[must_use]
pub fn target_names() -> Vec<String> {
    Vec::new()
}

/// Joint names.
#[must_use]
pub fn default_skeleton_names() -> Vec<String> {
    Vec::new()
}

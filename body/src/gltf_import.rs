//! glTF 2.0 import of a skinned human.

use std::path::Path;

use flyrig_types::PoseTrack;

use crate::{BodyError, Template};

/// A body and its motion from one file.
#[derive(Debug, Clone)]
pub struct GltfHuman {
    /// The body.
    pub template: Template,
    /// The first animation; world is the file's own (y up).
    pub track: Option<PoseTrack>,
}

/// Reads a skinned human.
///
/// # Errors
/// [`BodyError::Io`], [`BodyError::Gltf`].
pub fn load_gltf(_path: &Path) -> Result<GltfHuman, BodyError> {
    Err(BodyError::Asset("not yet".to_owned()))
}

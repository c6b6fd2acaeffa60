//! BVH motion clips.

use std::path::Path;

use crate::BodyError;

/// One joint of a clip.
#[derive(Debug, Clone)]
pub struct BvhJoint {
    /// Name.
    pub name: String,
}

/// A motion clip.
#[derive(Debug, Clone)]
pub struct BvhClip {
    /// Joints, parents first.
    pub joints: Vec<BvhJoint>,
}

/// Reads a BVH file.
///
/// # Errors
/// [`BodyError::Io`], [`BodyError::Bvh`].
pub fn load_bvh(path: impl AsRef<Path>) -> Result<BvhClip, BodyError> {
    parse_bvh("", path.as_ref())
}

/// Reads BVH text; `path` is for messages.
///
/// # Errors
/// [`BodyError::Bvh`].
pub fn parse_bvh(_text: &str, _path: &Path) -> Result<BvhClip, BodyError> {
    Err(BodyError::Asset("not yet".to_owned()))
}

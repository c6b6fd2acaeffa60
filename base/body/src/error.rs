//! Errors of bodies, clips and poses.

use std::path::PathBuf;

use flyrig_types::PoseError;

/// Error of a body, a motion clip or a pose.
#[derive(Debug, thiserror::Error)]
pub enum BodyError {
    /// A file could not be read.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// File.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// A file was not written; an old one is untouched.
    #[error("{}: not written, {message}", path.display())]
    Unwritten {
        /// File.
        path: PathBuf,
        /// Reason.
        message: String,
    },
    /// A glTF file is damaged or holds no skinned human.
    #[error("{}: {message}", path.display())]
    Gltf {
        /// File.
        path: PathBuf,
        /// Problem and fix.
        message: String,
    },
    /// A BVH file is damaged.
    #[error("{} line {line}: {message}", path.display())]
    Bvh {
        /// File.
        path: PathBuf,
        /// Line, counted from 1.
        line: usize,
        /// Problem and fix.
        message: String,
    },
    /// The built-in body has no such shape target.
    #[error("the built-in body has no shape target '{name}'; did you mean {nearest}?")]
    UnknownTarget {
        /// Requested name.
        name: String,
        /// Most similar names of targets.
        nearest: String,
    },
    /// A shape weight is NaN or out of range.
    #[error("shape target '{name}' has the weight {weight}; it must lie in {min}..={max}")]
    TargetWeight {
        /// Name of the target.
        name: String,
        /// Given weight.
        weight: f32,
        /// Smallest permitted weight.
        min: f32,
        /// Largest permitted weight.
        max: f32,
    },
    /// The body file inside this program is damaged.
    #[error("the built-in body is damaged ({0}); build flyrig again from a clean checkout")]
    Asset(String),
    /// A mesh cannot carry Gaussians, a graph or clothes.
    #[error("mesh '{name}': {message}")]
    Mesh {
        /// Name of the template.
        name: String,
        /// Problem and fix.
        message: String,
    },
    /// A skeleton is no tree or does not fit.
    #[error("skeleton: {0}")]
    Skeleton(String),
    /// A pose does not fit the skeleton or is not finite.
    #[error("pose: {0}")]
    Pose(String),
    /// A device buffer has room for too few Gaussians.
    #[error("the buffer of {what} has room for {found} Gaussians, {needed} are needed")]
    Buffer {
        /// Content of the buffer.
        what: &'static str,
        /// Elements of the buffer.
        found: usize,
        /// Number of Gaussians.
        needed: usize,
    },
    /// Key poses form no track.
    #[error("{what}: {source}")]
    Track {
        /// Name of the clip.
        what: String,
        /// Faulty key.
        source: PoseError,
    },
}

/// Characters of a file's text that a message repeats.
const SHOWN: usize = 100;

/// Shortens and escapes text of a file for a message.
pub(crate) fn shown(text: &str) -> String {
    text.chars().take(SHOWN).collect::<String>().escape_debug().to_string()
}

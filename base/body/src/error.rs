//! What can go wrong with bodies and motion.

use std::path::PathBuf;

use flyrig_types::PoseError;

/// Why a body, a clip or a pose was refused.
#[derive(Debug, thiserror::Error)]
pub enum BodyError {
    /// A file could not be read.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// Which file.
        path: PathBuf,
        /// The system's word.
        source: std::io::Error,
    },
    /// A file that was not written; the old one, if any, is untouched.
    #[error("{}: not written, {message}", path.display())]
    Unwritten {
        /// Which file.
        path: PathBuf,
        /// Why.
        message: String,
    },
    /// A glTF file that is damaged or holds no skinned human.
    #[error("{}: {message}", path.display())]
    Gltf {
        /// Which file.
        path: PathBuf,
        /// Problem and fix.
        message: String,
    },
    /// A BVH file that is damaged.
    #[error("{} line {line}: {message}", path.display())]
    Bvh {
        /// Which file.
        path: PathBuf,
        /// Line, counted from 1.
        line: usize,
        /// Problem and fix.
        message: String,
    },
    /// A shape target that the built-in body does not have.
    #[error("the built-in body has no shape target '{name}'; did you mean {nearest}?")]
    UnknownTarget {
        /// The name asked for.
        name: String,
        /// The closest names there are.
        nearest: String,
    },
    /// A shape weight that is not a number or out of range.
    #[error("shape target '{name}' has the weight {weight}; it must lie in {min}..={max}")]
    TargetWeight {
        /// Which target.
        name: String,
        /// The weight given.
        weight: f32,
        /// Smallest weight allowed.
        min: f32,
        /// Largest weight allowed.
        max: f32,
    },
    /// The body file inside this program is damaged.
    #[error("the built-in body is damaged ({0}); build flyrig again from a clean checkout")]
    Asset(String),
    /// A mesh that cannot carry Gaussians or a graph.
    #[error("mesh '{name}': {message}")]
    Mesh {
        /// Which template.
        name: String,
        /// Problem and fix.
        message: String,
    },
    /// A skeleton that makes no tree or does not fit.
    #[error("skeleton: {0}")]
    Skeleton(String),
    /// A pose that does not fit the skeleton or is not finite.
    #[error("pose: {0}")]
    Pose(String),
    /// A GPU buffer of another number of Gaussians.
    #[error("the buffer of {what} has room for {found} Gaussians, {needed} are needed")]
    Buffer {
        /// What it holds.
        what: &'static str,
        /// Its length.
        found: usize,
        /// Gaussians.
        needed: usize,
    },
    /// Key poses that make no track.
    #[error("{what}: {source}")]
    Track {
        /// Which clip.
        what: String,
        /// Which key and why.
        source: PoseError,
    },
}

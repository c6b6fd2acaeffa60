//! Errors of splat files.

/// Reason why bytes are no PLY file of Gaussians.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum PlyError {
    /// The header is not one of a file of Gaussians.
    #[error(
        "the PLY header says {0:?}, which is not how 3D Gaussian Splatting tools write binary files; convert it with one of them"
    )]
    Header(String),
    /// The header does not end.
    #[error("the PLY header has no end_header line; the file is cut off or no PLY file")]
    NoEnd,
    /// A property is missing.
    #[error("the PLY file has no property {0}; it does not hold Gaussians")]
    Missing(String),
    /// The Gaussians are packed into integers.
    #[error("the Gaussians of the PLY file are packed; unpack them: splat-transform IN.ply OUT.ply")]
    Packed,
    /// There are fewer bytes than the header announces.
    #[error("the PLY header announces {gaussians} Gaussians, {found} bytes follow; the file is cut off")]
    Short {
        /// Gaussians announced.
        gaussians: u64,
        /// Bytes after the header.
        found: usize,
    },
}

//! Check of meshes before they are processed.

use crate::TriMesh;

/// Reason why a mesh cannot be processed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MeshFault {
    /// A triangle refers to a vertex that does not exist.
    #[error("a triangle refers to vertex {index} of {count}")]
    Index {
        /// Index of the vertex.
        index: u32,
        /// Number of vertices.
        count: usize,
    },
    /// A position is not finite.
    #[error("vertex {0} is not a finite number")]
    NotFinite(usize),
    /// The flags of holes do not fit the vertices.
    #[error("there are {count} positions but {flags} flags of holes")]
    Flags {
        /// Number of vertices.
        count: usize,
        /// Number of flags.
        flags: usize,
    },
}

impl MeshFault {
    /// Checks that all indices are in range, all positions finite, and the flags as many as the vertices or none.
    ///
    /// # Errors
    /// The first fault.
    pub(crate) fn check(mesh: &TriMesh) -> Result<(), Self> {
        let (count, flags) = (mesh.positions.len(), mesh.from_hole.len());
        if let Some(index) = mesh.triangles.as_flattened().iter().find(|i| **i as usize >= count) {
            return Err(Self::Index { index: *index, count });
        }
        if let Some(vertex) = mesh.positions.iter().position(|p| !p.is_finite()) {
            return Err(Self::NotFinite(vertex));
        }
        if flags != 0 && flags != count { Err(Self::Flags { count, flags }) } else { Ok(()) }
    }
}

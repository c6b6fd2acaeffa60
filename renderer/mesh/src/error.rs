//! Errors of meshing.

/// Error of meshing; each text names the fix.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MeshError {
    /// The cloud is too small to describe a surface.
    #[error("{count} Gaussians; at least {needed} are needed")]
    TooFewPoints {
        /// Usable points.
        count: usize,
        /// Smallest accepted number.
        needed: usize,
    },
    /// All points lie at one place, so that no spacing can be measured.
    #[error("the {count} points coincide: check that their positions are in metres and differ")]
    Coincident {
        /// Usable points.
        count: usize,
    },
    /// A setting is outside its range.
    #[error("{name} is {value}: {fix}")]
    Setting {
        /// Name of the setting.
        name: &'static str,
        /// Rejected value.
        value: f32,
        /// Accepted range.
        fix: &'static str,
    },
    /// The grid would not fit into memory.
    #[error(
        "voxels of {voxel_m} m over {} x {} x {} m need {blocks:.0} blocks, more than {limit}: use larger voxels or remove distant points",
        extent_m[0], extent_m[1], extent_m[2]
    )]
    Extent {
        /// Side of a voxel, metres.
        voxel_m: f32,
        /// Extent of the points with the margin of the field, metres.
        extent_m: [f32; 3],
        /// Needed blocks of 8 x 8 x 8 voxels.
        blocks: f64,
        /// Largest number of blocks.
        limit: usize,
    },
    /// No surface encloses a volume.
    #[error("the points enclose no volume: check that their normals point outwards")]
    NoSurface,
    /// The points show several bodies of similar size.
    #[error("{count} separate bodies: pass the points of one body, or ask for {count}")]
    SeveralBodies {
        /// Number of bodies of similar volume.
        count: usize,
    },
}

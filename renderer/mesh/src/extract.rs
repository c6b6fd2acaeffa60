//! From oriented points to a closed mesh, with a report.

use std::time::Instant;

use crate::carve::{Empty, carve};
use crate::components::{Removed, keep_largest};
use crate::density::Density;
use crate::error::MeshError;
use crate::field::fuse_blocks;
use crate::marching_cubes::marching_cubes;
use crate::mesh::TriMesh;
use crate::points::{Dropped, OrientedPoints};
use crate::settings::{Fusion, FusionSettings};
use crate::signs::close;
use crate::topology::Topology;
use crate::winding::Winding;

/// Smallest number of points that describe a person's surface.
pub(crate) const MIN_POINTS: usize = 1000;

/// Options of [`mesh_from_points`].
#[derive(Clone, Copy, Default)]
pub struct MeshOptions<'a> {
    /// Way of fusing points.
    pub fusion: Fusion,
    /// Side of a voxel, metres; twice the spacing of the points if `None`.
    pub voxel_m: Option<f32>,
    /// Settings of the fusion in place of those derived from the points; `voxel_m` is not applied to them.
    pub settings: Option<FusionSettings>,
    /// Space that is known to be empty.
    pub empty: Option<Empty<'a>>,
    /// Number of bodies to keep; 0 counts as 1.
    pub bodies: usize,
    /// Stores all blocks of the bounding box, those without points too: the same mesh, later. Measures what skipping them saves.
    pub dense: bool,
}

impl MeshOptions<'_> {
    /// Returns the settings that apply to points, from which distant ones were dropped.
    ///
    /// # Errors
    /// As [`Density::measure`].
    pub(crate) fn settings_of(&self, points: &OrientedPoints) -> Result<FusionSettings, MeshError> {
        self.settings.map_or_else(|| Ok(self.derived(points, &Density::measure(points)?)), Ok)
    }

    /// Returns the settings for points of measured density.
    fn derived(&self, points: &OrientedPoints, density: &Density) -> FusionSettings {
        let settings = FusionSettings::from_density(points, density);
        self.voxel_m.map_or(settings, |voxel_m| settings.with_voxel(voxel_m))
    }
}

/// Seconds per stage of [`mesh_from_points`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MeshSeconds {
    /// Density of the points and settings.
    pub density: f64,
    /// Fusion of points into distances.
    pub fuse: f64,
    /// Signs of voxels without evidence.
    pub signs: f64,
    /// Cut of empty space.
    pub carve: f64,
    /// Extraction of the surface.
    pub surface: f64,
    /// Removal of floaters.
    pub components: f64,
    /// Check of the result.
    pub topology: f64,
}

/// Counts of one run of [`mesh_from_points`].
#[derive(Debug, Clone, PartialEq)]
pub struct MeshReport {
    /// Applied settings.
    pub settings: FusionSettings,
    /// Fused points.
    pub points: usize,
    /// Dropped rows.
    pub dropped: Dropped,
    /// Stored blocks of 8 x 8 x 8 voxels.
    pub blocks: usize,
    /// Blocks of the bounding box that were not stored.
    pub skipped_blocks: usize,
    /// Voxels without evidence whose sign came from the winding number.
    pub signed_voxels: usize,
    /// Voxels that were cut away as empty.
    pub emptied_voxels: usize,
    /// Surface that closes holes in the evidence, square metres.
    pub hole_area_m2: f64,
    /// Share of that surface in the whole, 0..=1.
    pub hole_share: f64,
    /// Removed floaters and cavities.
    pub removed: Removed,
    /// Topology of the mesh.
    pub topology: Topology,
    /// Seconds per stage.
    pub seconds: MeshSeconds,
}

/// Reconstructs a closed, 2-manifold mesh from oriented points in metres: fusion into signed distances ([`fuse`](crate::fuse)), signs
/// where evidence lacks ([`close`]), cut of empty space ([`carve`]), extraction ([`marching_cubes`]), removal of floaters
/// ([`keep_largest`]). Points far from all others are dropped first. Equal input gives equal bytes for any number of threads,
/// except for the seconds in the report.
///
/// # Errors
/// [`MeshError::TooFewPoints`] below 1000 points, [`MeshError::Coincident`], [`MeshError::Setting`], [`MeshError::Extent`] if
/// the grid would not fit into memory, [`MeshError::NoSurface`], and [`MeshError::SeveralBodies`] if more components of
/// similar volume are found than asked for.
pub fn mesh_from_points(mut points: OrientedPoints, options: &MeshOptions) -> Result<(TriMesh, MeshReport), MeshError> {
    points.drop_distant();
    if points.len() < MIN_POINTS {
        return Err(MeshError::TooFewPoints { count: points.len(), needed: MIN_POINTS });
    }
    let mut seconds = MeshSeconds::default();
    let density = timed(&mut seconds.density, || Density::measure(&points))?;
    let settings = options.settings.unwrap_or_else(|| options.derived(&points, &density));
    let mut field = timed(&mut seconds.fuse, || fuse_blocks(&points, &settings, options.fusion, options.dense))?;
    let signed_voxels = timed(&mut seconds.signs, || close(&mut field, &Winding::new(&points, &density)))?;
    let emptied_voxels = timed(&mut seconds.carve, || options.empty.map_or(Ok(0), |empty| carve(&mut field, empty)))?;
    let mesh = timed(&mut seconds.surface, || marching_cubes(&field));
    let (mesh, removed) = timed(&mut seconds.components, || keep_largest(&mesh, options.bodies))?;
    let topology = timed(&mut seconds.topology, || Topology::measure(&mesh));
    let hole_area_m2 = mesh.hole_area();
    let report = MeshReport {
        settings,
        points: points.len(),
        dropped: points.dropped(),
        blocks: field.stored_blocks(),
        skipped_blocks: field.grid_blocks() - field.stored_blocks(),
        signed_voxels,
        emptied_voxels,
        hole_area_m2,
        hole_share: if topology.area_m2 > 0.0 { hole_area_m2 / topology.area_m2 } else { 0.0 },
        removed,
        topology,
        seconds,
    };
    Ok((mesh, report))
}

fn timed<T>(seconds: &mut f64, stage: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = stage();
    *seconds = start.elapsed().as_secs_f64();
    result
}

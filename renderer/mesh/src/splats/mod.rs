//! Closed, textured mesh of free Gaussians, such as another tool's splat file.
//!
//! No body says which side of a Gaussian is outside. Virtual cameras on all sides do: their pixels become points of the surface that
//! faces them (`views`), what they look through is empty ([`carve`](crate::carve)), and their images give the texture (`paint`).
//! The mesh moves from the planes of the Gaussians to the surface that they draw, as contours show it (`contour`).

mod contour;
mod error;
mod paint;
mod prepare;
mod views;

use std::time::Instant;

use flyrig_avatar::{Atlas, BakedMesh};
use flyrig_gpu::GpuContext;
use flyrig_renderer::{AnisotropicSplats, SplatFilter};
use glam::{Vec2, Vec3};

use crate::finish::{finish, untangle::untangle};
use crate::splats::contour::{drawn_beyond_m, move_outwards};
use crate::splats::{paint::Painter, prepare::prepare, views::render};
use crate::{AtlasSettings, MeshOptions, MeshReport, OrientedPoints, Topology, mesh_atlas, mesh_from_points};

pub use error::SplatError;
pub use prepare::SplatCounts;

/// Side of a voxel in distances of neighbouring Gaussians.
const VOXEL: f32 = 1.5;
/// Views that must see a place as empty before it is cut away: holes between Gaussians are seen by single ones.
const VOTES: usize = 3;

/// Mesh of Gaussians with a texture, in metres and in the axes of the Gaussians. Vertices are split where charts of the texture meet.
#[derive(Debug, Clone, PartialEq)]
pub struct SplatMesh {
    /// Positions, metres.
    pub positions: Vec<Vec3>,
    /// Unit normals.
    pub normals: Vec<Vec3>,
    /// Texture coordinates in 0..=1, v down.
    pub uvs: Vec<Vec2>,
    /// Vertices of each triangle, counter-clockwise from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Texture of the colours seen along the normals.
    pub texture: Atlas,
}

/// Options of [`mesh_splats`].
#[derive(Clone, Copy)]
pub struct SplatOptions<'a> {
    /// Length of the Gaussians' unit, metres.
    pub unit_m: f32,
    /// Filter that the Gaussians were trained with.
    pub filter: SplatFilter,
    /// Fusion and surface; without a voxel side, one and a half distances of neighbouring Gaussians. Its empty space is replaced by that
    /// of the virtual cameras.
    pub mesh: MeshOptions<'a>,
    /// Triangles to simplify to; a mesh with fewer keeps its own.
    pub triangles: usize,
    /// Texels along a side of the texture.
    pub texture_side: u32,
}

impl Default for SplatOptions<'_> {
    fn default() -> Self {
        let (filter, mesh) = (SplatFilter::default(), MeshOptions::default());
        Self { unit_m: 1.0, filter, mesh, triangles: 60_000, texture_side: 2048 }
    }
}

/// Counts of [`mesh_splats`].
#[derive(Debug, Clone)]
pub struct SplatReport {
    /// Gaussians used and left out.
    pub counts: SplatCounts,
    /// Distance of neighbouring Gaussians, metres.
    pub spacing_m: f32,
    /// Virtual cameras, and pixels along a side of their images.
    pub views: [u32; 2],
    /// Width of a pixel at the centre of the Gaussians, metres.
    pub pixel_m: f32,
    /// Distance from the planes of the Gaussians to the surface that they draw, along the normals, metres.
    pub drawn_beyond_m: f32,
    /// Vertices that stay on the planes, since the surface would intersect itself there.
    pub kept_vertices: usize,
    /// Topology of the simplified mesh.
    pub topology: Topology,
    /// Mean distance of the simplified mesh from the fused one before it is smoothed, metres.
    pub simplified_by_m: f32,
    /// Charts of the texture.
    pub charts: u32,
    /// Share of its texels that they cover, 0..=1.
    pub coverage: f32,
    /// Covered texels that no virtual camera sees, which have the colour of the nearest Gaussian.
    pub unseen_texels: usize,
    /// Seconds of the virtual cameras, of simplification, and of the texture.
    pub seconds: [f64; 3],
    /// Fusion and surface.
    pub mesh: MeshReport,
}

/// Meshes the surface that Gaussians draw: virtual cameras on all sides see oriented points of it, which are fused, cut where the
/// cameras see empty space, simplified and textured. Equal input gives equal bytes for any number of threads, except for the seconds in
/// the report.
///
/// # Errors
/// [`SplatError::Size`] for Gaussians that are not as large as a person, [`SplatError::Mesh`] for fewer than 1000 of them and for
/// several bodies, and [`SplatError`] where the mesh cannot be simplified or textured, or the device fails.
///
/// # Examples
/// ```
/// use flyrig_gpu::{AdapterChoice, GpuContext};
/// use flyrig_mesh::{SplatOptions, mesh_splats};
/// use flyrig_renderer::{AnisotropicSplats, HarmonicOrder};
///
/// let gpu = GpuContext::new(&AdapterChoice::Best)?.on_processor();
/// let none = AnisotropicSplats::empty(HarmonicOrder::Zero);
/// let refused = mesh_splats(&none, &gpu, &SplatOptions::default()).err().map(|error| error.to_string());
/// assert_eq!(refused.as_deref(), Some("0 Gaussians; at least 1000 are needed"));
/// # Ok::<(), flyrig_gpu::GpuError>(())
/// ```
pub fn mesh_splats(
    splats: &AnisotropicSplats,
    gpu: &GpuContext,
    options: &SplatOptions<'_>,
) -> Result<(SplatMesh, SplatReport), SplatError> {
    let prepared = prepare(splats, options.unit_m)?;
    let started = Instant::now();
    let (views, rows) = render(gpu, &prepared, options.filter)?;
    let drawn_beyond_m = drawn_beyond_m(&views, &rows, &prepared);
    let viewed_s = started.elapsed().as_secs_f64();

    let voxel_m = options.mesh.voxel_m.unwrap_or(VOXEL * prepared.spacing_m);
    let margin = (2.0 * voxel_m / prepared.unit.scale_m() as f32).max(1e-6);
    let empty = |place: Vec3| {
        let place = prepared.unit.normalized(place).as_vec3();
        views.iter().filter(|view| view.sees_through(place, margin)).nth(VOTES - 1).is_some()
    };
    let mesh_options = MeshOptions { voxel_m: Some(voxel_m), empty: Some(&empty), ..options.mesh };
    let (fused, mesh) = mesh_from_points(OrientedPoints::from_rows(rows), &mesh_options)?;

    let started = Instant::now();
    let mut simple = finish(&fused, options.triangles, prepared.spacing_m)?;
    let planes = simple.mesh.positions.clone();
    move_outwards(&mut simple.mesh, drawn_beyond_m);
    // In narrow gaps both sides would pass through each other.
    let kept_vertices = untangle(&mut simple.mesh, &planes);
    let simplified_s = started.elapsed().as_secs_f64();
    let started = Instant::now();
    let atlas = mesh_atlas(&simple.mesh, AtlasSettings { side: options.texture_side, ..AtlasSettings::default() })?;
    let (positions, normals) = (atlas.split(&simple.mesh.positions), atlas.split(&simple.mesh.normals()));
    let baked = BakedMesh { positions: &positions, normals: &normals, uvs: &atlas.uvs, triangles: &atlas.triangles };
    let mut unseen_texels = 0;
    let texture = baked.paint(options.texture_side, |points| {
        let colors = Painter::new(&views, &prepared).colors(points);
        unseen_texels = colors.iter().filter(|(_, is_seen)| !is_seen).count();
        colors.into_iter().map(|(color, _)| color).collect()
    })?;
    let report = SplatReport {
        counts: prepared.counts,
        spacing_m: prepared.spacing_m,
        views: [views.len() as u32, views.first().map_or(0, |view| view.side)],
        pixel_m: views.first().map_or(0.0, |view| view.pixel * prepared.unit.scale_m() as f32),
        drawn_beyond_m,
        kept_vertices,
        topology: Topology::measure(&simple.mesh),
        simplified_by_m: simple.mean_distance_m,
        charts: atlas.charts,
        coverage: atlas.coverage,
        unseen_texels,
        seconds: [viewed_s, simplified_s, started.elapsed().as_secs_f64()],
        mesh,
    };
    Ok((SplatMesh { positions, normals, uvs: atlas.uvs, triangles: atlas.triangles, texture }, report))
}

#[cfg(test)]
mod tests;

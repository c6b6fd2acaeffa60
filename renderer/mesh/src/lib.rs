//! Closed triangle meshes from oriented surface points.
//!
//! Centres of drawn Gaussian surfaces, or pixels of depth maps, become a closed, 2-manifold mesh in metres, in the frame of the
//! points. [`mesh_from_points`] runs all stages; each can be called by itself:
//!
//! 1. [`fuse`]: signed distances in sparse blocks of voxels, weighted by distance and agreement of normals (HGM, Eq. 18).
//! 2. [`close`]: signs of voxels without evidence from the [`Winding`] number of the points, so that holes close smoothly
//!    and interiors stay solid.
//! 3. [`carve`]: cut of space that is known to be empty.
//! 4. [`marching_cubes`]: the surface, manifold by construction.
//! 5. [`keep_largest`]: removal of floaters and cavities.
//!
//! [`decimate`] simplifies the mesh, [`mesh_atlas`] gives it texture coordinates, and writers make files for other programs:
//! [`write_glb`], [`write_obj`], [`write_3mf`], [`write_usdz`], [`write_usd_sequence`].
//!
//! [`mesh_splats`] runs all of this on Gaussians without a body, such as another tool's splat file.
//!
//! [`Topology`] verifies the result. [`skin_weights`] ties a mesh to a skeleton. [`Normalization`] brings Gaussians to unit size (HGM, Eq. 1) and back.
//!
//! ```
//! use flyrig_mesh::{MeshOptions, OrientedPoint, OrientedPoints, mesh_from_points};
//! use glam::Vec3;
//!
//! let rows = (0..4000).map(|i| {
//!     let z = 1.0 - (2.0 * i as f32 + 1.0) / 4000.0;
//!     let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
//!     let normal = Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
//!     OrientedPoint { position: normal * 0.2, normal, weight: 1.0, uncertainty_m: 0.001 }
//! });
//! let (mesh, report) = mesh_from_points(OrientedPoints::from_rows(rows), &MeshOptions::default())?;
//! assert!(report.topology.is_closed_manifold());
//! assert!(mesh.positions.iter().all(|position| (position.length() - 0.2).abs() < 0.002));
//! # Ok::<(), flyrig_mesh::MeshError>(())
//! ```

mod atlas;
mod carve;
mod components;
mod connectivity;
mod density;
mod error;
mod extract;
mod fault;
mod field;
mod files;
mod finish;
mod intersections;
mod marching_cubes;
mod mesh;
mod nearest;
mod normalization;
mod person;
mod points;
mod settings;
#[cfg(test)]
mod shapes;
mod signs;
mod skin;
mod splats;
mod texture;
mod topology;
mod triangle;
mod union_find;
mod winding;

pub use atlas::{AtlasError, AtlasSettings, MeshAtlas, mesh_atlas};
pub use carve::{Empty, carve};
pub use components::{Removed, keep_largest};
pub use connectivity::Connectivity;
pub use density::Density;
pub use error::MeshError;
pub use extract::{MeshOptions, MeshReport, MeshSeconds, mesh_from_points};
pub use fault::MeshFault;
pub use field::{Evidence, Field, Voxel, fuse};
pub use files::{
    JointFrame, MeshFile, MeshFileError, MeshFrame, MeshJoint, MeshSkeleton, write_3mf, write_glb, write_obj,
    write_usd_sequence, write_usdz,
};
pub use finish::decimate::{DecimateError, Decimated, decimate};
pub use intersections::self_intersections;
pub use marching_cubes::marching_cubes;
pub use mesh::TriMesh;
pub use normalization::{Normalization, clamped_scales};
pub use person::{MeshedPerson, PersonError, PersonOptions, PersonReport, ShellReport};
pub use points::{Dropped, OrientedPoint, OrientedPoints};
pub use settings::{Fusion, FusionSettings};
pub use signs::close;
pub use skin::{SkinReport, SkinSettings, skin_weights};
pub use splats::{SplatCounts, SplatError, SplatMesh, SplatOptions, SplatReport, mesh_splats};
pub use texture::{
    DrawnMesh, Photo, PhotoError, PhotoInputs, PhotoSettings, PhotoTexture, Poser, TexturedMesh, draw_textured,
    photograph_texture,
};
pub use topology::Topology;
pub use winding::Winding;

//! Human template: a skinned mesh with a skeleton, surface Gaussians and a deformation graph attached to it, linear blend
//! skinning, clothes, and importers of bodies and motion.
//!
//! ```
//! use flyrig_body::{ShapeParams, default_template, sample_surface, skin_mesh};
//!
//! let template = default_template(&ShapeParams::woman().with("height", 0.7))?;
//! let gaussians = sample_surface(&template, 500, 1)?;
//! assert_eq!(gaussians.len(), 500);
//! let (positions, normals) = skin_mesh(&template, &template.skeleton.rest_pose());
//! assert_eq!((positions.len(), normals.len()), (template.positions.len(), template.positions.len()));
//! # Ok::<(), flyrig_body::BodyError>(())
//! ```
//!
//! # Conventions
//!
//! - **Canonical space** is the bind pose of the mesh in metres, glTF axes: y up, the body faces +z,
//!   its left hand points to +x. The built-in body stands on y = 0.
//! - **Skinning matrices** are `world_from_canonical`, one per joint: `world_from_joint * joint_from_canonical`.
//! - **World** of a pose track is that of its source: y up for glTF, z up after retargeting.

mod body_asset;
mod bvh;
mod clip_axes;
mod coarse;
mod default_body;
mod eliminate;
mod error;
mod finger_axes;
mod fingers;
mod floor;
mod foot_contacts;
mod glb_writer;
mod gltf_export;
mod gltf_file;
mod gltf_import;
mod gltf_json;
mod gltf_limits;
mod gltf_mesh;
mod gltf_motion;
mod gltf_nodes;
mod gltf_skins;
mod gltf_uri;
mod gpu_skinner;
mod graph;
mod inset;
mod joint_names;
mod mesh_ply;
mod monotone_queue;
mod motion_clip;
mod outfit;
mod part;
mod point_grid;
mod reshape;
mod rest_alignment;
mod retarget;
mod rings;
mod shape;
mod shoes;
mod skeleton;
mod skinning;
mod skirt;
mod surface;
mod surface_links;
mod template;
mod vertex_means;

pub use bvh::{BvhChannel, BvhClip, BvhJoint, load_bvh, parse_bvh};
pub use coarse::{CoarseSurface, coarsen};
pub use default_body::{ShapeTarget, default_template, shape_targets};
pub use error::BodyError;
pub use finger_axes::{FingerAxes, finger_axes};
pub use fingers::{FingerJoints, find_fingers};
pub use glb_writer::GlbWriter;
pub use gltf_export::{GlbContents, write_glb};
pub use gltf_import::{GltfHuman, load_gltf};
pub use gltf_motion::load_gltf_motion;
pub use gpu_skinner::GpuSkinner;
pub use graph::{DEFAULT_NODE_COUNT, DEFAULT_SIGMA2_M2, DeformationGraph, build_graph, displacement};
pub use mesh_ply::write_mesh_ply;
pub use motion_clip::MotionClip;
pub use outfit::Outfit;
pub use point_grid::PointGrid;
pub use reshape::Reshaped;
pub use retarget::RetargetOptions;
pub use shape::ShapeParams;
pub use shoes::Shoes;
pub use skeleton::{Joint, Skeleton};
pub use skinning::{skin_jacobian_f64, skin_mesh, skin_normal_f64, skin_point_f64};
pub use skirt::{Skirt, hangs_from_hips};
pub use surface::{DEFAULT_GAUSSIAN_COUNT, SurfaceGaussians, attached_surface, sample_surface};
pub use template::{Part, SkinWeights, Template};
pub use vertex_means::VertexMeans;

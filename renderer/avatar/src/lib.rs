//! Personal avatars: Gaussians of three scales on the surface of a person's body, fitted to the images of a take and driven by poses.
//!
//! An [`Avatar`] is a body with skin weights, and for each Gaussian an offset, scales, a rotation, an opacity and a
//! colour in canonical space ([`GaussianParameters`]). [`Avatar::pose`] transforms them to the world by linear blend
//! skinning, with or without a deformation graph's translations. [`AvatarModel`] is what [`flyrig_fit::Fit`] optimises by
//! gradient descent on images, directly or as outputs of local networks ([`AvatarModel::use_networks`]).
//!
//! - `model`: attributes, posing, the room's light, files, rendering with fewer Gaussians in small images, and the surface and colours as the
//!   start of live tracking.
//! - `fit`: the avatar as a model of a fit, with corrections of poses and skin weights.
//! - `local`: LoGAvatar's local networks. `edit`: texture and shape.

mod edit;
mod error;
mod fit;
mod local;
mod model;

pub use edit::atlas::{Atlas, DEFAULT_ATLAS_SIDE, each_texel, encode as srgb_bytes, grow};
pub use edit::bake::BakedMesh;
pub use edit::paint::Painted;
pub use error::AvatarError;
pub use fit::avatar_model::{AvatarFitSettings, AvatarModel, TrainingFrame};
pub use local::atlas_map::AtlasLayout;
pub use local::networks::LocalSettings;
pub use model::avatar::{Attachment, Avatar, Card, Hanging};
pub use model::detail::DetailedScene;
pub use model::drawn_surface::{DRAWN_BEYOND, SurfacePoint};
pub use model::known_poses::KnownPoses;
pub use model::light::Light;
pub use model::parameters::GaussianParameters;
pub use model::posing::{Bones, PosedAvatar};
pub use model::scene::AvatarScene;
pub use model::splat_glb::write_splat_glb;

//! Personal avatars: Gaussians of three scales on the surface of a person's body, fitted to the images of a take and driven by poses.
//!
//! An [`Avatar`] is a body with a skin, and for each Gaussian an offset, scales, a rotation, an opacity and a colour in canonical space
//! ([`Parameters`]). [`Avatar::pose`] brings them into the world by linear blend skinning, with or without a deformation graph's
//! translations; [`Fit`] finds them by gradient descent on images, each number by itself or as outputs of local networks
//! ([`Fit::use_networks`]).

mod adam;
mod atlas;
mod avatar;
mod checkpoint;
mod coarser;
mod detail;
mod error;
mod file;
mod fit;
mod image_error;
mod known_poses;
mod light;
mod local;
mod neighbors;
mod outline;
mod paint;
mod parameters;
mod pose_fit;
mod posing;
mod reshape;
mod rest;
mod scene;
mod skin_fit;
mod skinning;
mod splat_glb;
mod ssim;
mod surface;
mod training_view;

pub use atlas::{Atlas, DEFAULT_ATLAS_SIDE};
pub use avatar::{Attachment, Avatar, Card, Hanging};
pub use checkpoint::FitProgress;
pub use detail::DetailedScene;
pub use error::AvatarError;
pub use fit::{Fit, FitSettings, StepReport, TrainingFrame};
pub use image_error::{ErrorWeights, ImageError, Photograph};
pub use known_poses::KnownPoses;
pub use light::Light;
pub use local::{AtlasLayout, LocalSettings};
pub use paint::Painted;
pub use parameters::Parameters;
pub use posing::{Bones, PosedAvatar};
pub use rest::Drawn;
pub use scene::AvatarScene;
pub use splat_glb::write_splat_glb;
pub use training_view::TrainingView;

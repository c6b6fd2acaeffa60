//! The words every flyrig crate speaks: ids, clocks, images, frames, camera models and poses.
//!
//! # Conventions
//!
//! - **World**: right-handed, metres. The rig states which way is up ([`Rig::world_up`]); our own
//!   rigs use z up, a data set keeps its own axes.
//! - **Camera**: OpenCV axes, x right, y down, z forward. Pixel centres lie at integer coordinates.
//! - **Transforms** are named `dst_from_src`: `camera_from_world * point_in_world = point_in_camera`.
//! - **Clock**: nanoseconds of `CLOCK_MONOTONIC` of the host that captured; names end in `_nanos`.
//!   An image's time is the middle of its exposure.
//! - **Angles** are radians, other units stand in the name.
//! - **Colour** is sRGB with 8 bits on the outside and linear `f32` inside.

mod camera;
mod color_match;
mod frame;
mod html;
mod ids;
mod image;
mod isometry;
mod panics;
mod person;
mod pose;
mod rendered_view;
mod restarts;
mod supervised;
mod whole_file;

pub use camera::{Camera, CameraError, Intrinsics, Lens, MAX_IMAGE_SIDE, Rig};
pub use color_match::ColorMatch;
pub use frame::{Frame, FrameSet, SetKind};
pub use html::escape_html;
pub use ids::CameraId;
pub use image::{Image, ImageError, Mask, PixelBuffer, PixelFormat, Recycle};
pub use isometry::Isometry;
pub use panics::caught;
pub use person::PersonId;
pub use pose::{Pose, PoseError, PoseTrack};
pub use rendered_view::RenderedView;
pub use restarts::Restarts;
pub use supervised::{SupervisedThread, ThreadHealth, ThreadWatch};
pub use whole_file::write_whole;

//! Types of all crates: ids, images, frames, camera models, poses; locks and supervised threads.
//!
//! # Conventions
//!
//! - **World**: right-handed, metres. The rig states the direction of up ([`Rig::world_up`]): z in rigs that this program
//!   calibrates; data sets keep their own axes.
//! - **Camera**: OpenCV axes, x right, y down, z forward. Pixel centres lie at integer coordinates.
//! - **Transforms** are named `dst_from_src`: `camera_from_world * point_in_world = point_in_camera`.
//! - **Clock**: nanoseconds of `CLOCK_MONOTONIC` of the capturing host; names end in `_nanos`. The time of an image is the
//!   middle of its exposure.
//! - **Angles** are radians; other units stand in the name.
//! - **Colour** is 8-bit sRGB in files and messages, linear `f32` in computations.

mod camera;
mod color_match;
mod frame;
mod html;
mod ids;
mod image;
mod isometry;
mod locks;
mod panics;
mod person;
mod pose;
mod printable;
mod rendered_view;
mod restarts;
mod seconds;
mod supervised;
mod text_file;
mod vectors;
mod whole_file;

pub use camera::{Camera, CameraError, Intrinsics, Lens, MAX_IMAGE_SIDE, Rig};
pub use color_match::ColorMatch;
pub use frame::{Frame, FrameSet, SetKind};
pub use html::escape_html;
pub use ids::{CameraId, CameraNameError};
pub use image::{Image, ImageError, Mask, PixelBuffer, PixelFormat, Recycle};
pub use isometry::Isometry;
pub use locks::{lock, wait, wait_timeout};
pub use panics::caught;
pub use person::PersonId;
pub use pose::{Pose, PoseError, PoseTrack};
pub use printable::{MAX_PRINTABLE, escape_controls, printable, shorten_values, shortened};
pub use rendered_view::RenderedView;
pub use restarts::Restarts;
pub use seconds::{deadline_after, saturating_secs};
pub use supervised::{SupervisedThread, ThreadHealth, ThreadWatch};
pub use text_file::{decode_text, read_text, read_text_up_to};
pub use vectors::{vectorized, wrong_vectors_limit};
pub use whole_file::write_whole;

//! One person: template, Gaussians on the GPU, deformation, colours and tracking quality.
//!
//! [`person`] has the [`Subject`] and its update, [`geometry`] the deformation and skinning, [`painter`] the colours. [`memory`] outlives
//! the subject; viewers get [`stream_frame`] with templates of the surface or of [`avatar_stream`].

pub(crate) mod avatar_stream;
mod figure;
mod geometry;
pub(crate) mod inputs;
mod instants;
pub(crate) mod memory;
mod memory_file;
mod painter;
pub(crate) mod person;
mod pose_curve;
mod rehearsal;
mod resume;
mod schedule;
mod stage_clock;
pub(crate) mod stream_frame;
pub(crate) mod surface;
pub(crate) mod track_watch;
pub(crate) mod upright;

pub use avatar_stream::encode_posed_avatar;
pub use geometry::PROCESSOR_STAGE;
pub use memory::PersonMemory;
pub use person::{Observed, Subject};
pub use stream_frame::{PersonFrame, stream_joints};
pub use surface::{person_gaussians, person_surface};
pub use track_watch::{Remedy, TrackState, TrackWatch};
pub use upright::Upright;

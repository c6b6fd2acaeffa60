//! Takes: footage in a folder, a recording or videos, or the cameras of a configuration, opened in one way.
//!
//! [`Take::open`] yields cameras, calibration, plates and the known body. [`Replay::open`] plays stored footage into a session and reads
//! the held-out cameras beside it as ground truth. Both find their files through [`Footage`] and [`dataset`].

mod avatar_stream;
mod avatar_take;
mod configured;
pub mod dataset;
mod devices;
mod footage;
mod frame_sets;
mod known_avatar;
mod network;
mod open;
mod person_up;
pub mod recorded;
mod replay;
mod silhouettes;
mod source_section;
mod take;
mod true_joints;
mod truth;

pub use avatar_stream::encode_avatar;
pub use avatar_take::AvatarTake;
pub use configured::{TakeConfig, simulated_plates};
pub use footage::{Footage, OpenFootage, require_inputs};
pub use known_avatar::{KnownBody, known_body};
pub use network::host_clock;
pub use open::{TakeInput, TakeOptions};
pub use person_up::person_up;
pub use replay::{Replay, ReplaySettings, frame_number};
pub use silhouettes::SilhouetteFinder;
pub use source_section::{CameraEntry, SourceKind, SourceSection};
pub use take::{Calibration, Needs, ReadErrors, Take, TakeBody, TakeSpan};
pub use truth::TruthReader;

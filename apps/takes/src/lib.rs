//! Takes: footage in a folder, a recording or videos, or the cameras of a configuration, opened in one way.
//!
//! [`import`] makes a take of a stranger's files, and [`check_take`] corrects its calibration by the person in it. [`Take::open`] yields cameras, calibration, plates and the known body. [`Replay::open`] plays stored footage into a session and reads
//! the held-out cameras beside it as ground truth. Both find their files through [`Footage`] and [`dataset`].

mod avatar_stream;
mod avatar_take;
mod check;
mod color_samples;
mod configured;
pub mod dataset;
mod depth_images;
mod devices;
mod footage;
mod frame_sets;
mod import;
mod known_avatar;
mod network;
mod open;
mod outline_memory;
mod person_tracks;
mod person_up;
pub mod recorded;
mod replay;
mod silhouettes;
mod source_section;
mod take;
mod true_joints;
mod truth;
mod video_files;

pub use avatar_stream::encode_avatar;
pub use avatar_take::AvatarTake;
pub use check::{CheckInput, Checked, check, check_take, mark_checked};
pub use color_samples::ColorSampler;
pub use configured::{TakeConfig, simulated_plates};
pub use depth_images::DepthFolder;
pub use footage::{Footage, OpenFootage, require_inputs};
pub use import::{ImportOptions, import, parse_pair};
pub use known_avatar::{KnownBody, known_body};
pub use network::host_clock;
pub use open::{TakeInput, TakeOptions};
pub use person_tracks::{PersonFinder, ensure_same_person, fit_person};
pub use person_up::person_up;
pub use replay::{Replay, ReplaySettings, frame_number};
pub use silhouettes::SilhouetteFinder;
pub use source_section::{CameraEntry, SourceKind, SourceSection};
pub use take::{Calibration, Needs, ReadErrors, Take, TakeBody, TakeSpan};
pub use truth::TruthReader;

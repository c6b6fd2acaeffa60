//! Shared by the programs: HTML reports, plots, images, progress bars, logging, arguments, and Ctrl-C as a flag.

pub mod arguments;
mod avatar_stream;
mod avatar_take;
mod contact;
pub mod dataset;
mod html;
mod known_avatar;
mod outlines;
pub mod plot;
pub mod png;
pub mod program;
mod progress;
mod replay;
pub mod stop;
mod take_sets;
mod trace;
mod true_joints;

pub use avatar_stream::encode_avatar;
pub use avatar_take::AvatarTake;
pub use contact::contact_images;
pub use html::{ContactRow, Curve, Report, Table, write_whole};
pub use known_avatar::known_body;
pub use outlines::{outlined_inputs, paint_outline};
pub use progress::progress_bar;
pub use replay::{KnownBody, Replay, ReplaySettings, TruthReader, frame_number};
pub use trace::traced;

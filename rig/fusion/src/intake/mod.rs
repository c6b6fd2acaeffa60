//! Frame sets from cameras: live ones into the newest frame set, recordings into every one.

pub(crate) mod cameras;
mod set_reader;
mod timing;

pub use cameras::{InputFormat, Intake};
pub use set_reader::{SetReader, next_frame};

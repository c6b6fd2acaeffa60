//! What the end-to-end tests share: a small simulated data set on disk, and running the command on it.

mod command;
mod dataset;
mod running;

pub use command::{Finished, run};
pub use dataset::{Dataset, FRAMES, SIDE, write_dataset, write_dataset_of};
pub use running::Running;

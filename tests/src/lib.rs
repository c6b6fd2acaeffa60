//! Shared parts of the end-to-end tests: a small simulated data set on disk, and execution of the command.

mod command;
mod dataset;
pub mod guide;
mod ports;
mod running;

pub use command::{Finished, run};
pub use dataset::{Dataset, FRAMES, SIDE, copy_folder, write_dataset, write_dataset_of, write_dataset_with_truth};
pub use ports::free_port;
pub use running::Running;

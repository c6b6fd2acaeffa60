//! Neural networks on crops of images: loading, running, and the pose networks built in or chosen by the user.

mod chosen_net;
mod clip;
mod depthwise;
mod heatmap;
pub(crate) mod landmark_net;
mod network_file;
pub(crate) mod output;
pub(crate) mod parallel;
mod pointwise;
pub(crate) mod pose_net;
mod upsample;
mod vector_state;

//! Avatar as a model that is fitted to the images of its take.

pub(crate) mod avatar_model;
mod node_fit;
mod pose_fit;
mod skin_fit;
mod skinning;

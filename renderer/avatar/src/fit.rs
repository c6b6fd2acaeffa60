//! Fit of an avatar to the images of a take by gradient descent.

mod adam;
pub(crate) mod checkpoint;
pub(crate) mod descent;
pub(crate) mod image_error;
mod outline;
mod pose_fit;
mod skin_fit;
mod skinning;
mod ssim;
pub(crate) mod training_view;

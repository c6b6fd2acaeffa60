//! Gradient descent of Gaussian models on images.
//!
//! A [`Model`] places Gaussians in the world for each frame of a take, and moves its parameters along the derivatives of
//! the images with respect to these Gaussians. [`Fit`] draws a view, compares it with its photograph
//! ([`ImageDifference`]), and with a surface where one is known ([`SurfaceDifference`]), differentiates, and passes the derivatives back; avatars, free Gaussians and meshes differ in
//! their model alone. [`Run`] keeps the time of a fit: its number of steps, and when a checkpoint and a picture are due.

mod checkpoint;
mod descent;
mod error;
mod image_error;
mod known_surface;
mod model;
mod neighbors;
mod outline;
mod run;
mod ssim;
mod surface_error;
mod training_view;

pub use checkpoint::FitProgress;
pub use descent::{Fit, FitSettings, StepReport};
pub use error::FitError;
pub use image_error::{ErrorWeights, ImageDifference, Photograph};
pub use known_surface::KnownSurface;
pub use model::{Element, Model, Step};
pub use neighbors::Neighbors;
pub use run::{Due, Length, Run};
pub use surface_error::{SurfaceDifference, SurfaceWeights};
pub use training_view::TrainingView;

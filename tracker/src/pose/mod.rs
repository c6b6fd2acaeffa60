//! The pose of a person: the skeleton as the solver sees it, the fit to landmarks, outlines and texture, and the estimator.

pub(crate) mod anatomy;
pub(crate) mod body_model;
pub(crate) mod config;
pub(crate) mod estimate;
pub(crate) mod estimator;
pub(crate) mod fit;
pub(crate) mod line_point;
pub(crate) mod outline;
pub(crate) mod texture;
pub(crate) mod viewers;

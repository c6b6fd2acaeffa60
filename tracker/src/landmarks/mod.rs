//! Body landmarks: their detection in each view, their places on a template, and triangulation.

pub(crate) mod bias;
pub(crate) mod inference_schedule;
pub(crate) mod keypoints;
pub(crate) mod presence;
pub(crate) mod search;
pub(crate) mod sighting;
pub(crate) mod single_view;
pub(crate) mod study;
pub(crate) mod surface_marks;
pub(crate) mod triangulate;

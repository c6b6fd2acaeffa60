//! Rendered views, and viewpoints of subscribers.

pub(crate) mod first_images;
pub(crate) mod renewal;
pub(crate) mod view;
pub(crate) mod viewpoint;

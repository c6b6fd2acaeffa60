//! Rendered views, and viewpoints of subscribers.

pub(crate) mod renewal;
pub(crate) mod view;
pub(crate) mod viewpoint;

//! Edits of a finished avatar: its texture and its shape.

pub(crate) mod atlas;
pub(crate) mod bake;
pub(crate) mod paint;
mod reshape;

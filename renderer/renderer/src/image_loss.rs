//! Loss of a rendered image against a wanted one, with its derivatives for the backward rasteriser.

pub(crate) mod loss;
mod processor;
pub(crate) mod settings;

//! Loss of a rendered image against a wanted one, with its derivatives for the backward rasteriser.
//!
//! The deformation compares renderings with halved images (FlyHuman, Eq. 3); values and derivatives stay on the device.

pub(crate) mod loss;
mod processor;
pub(crate) mod settings;

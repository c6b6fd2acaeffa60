//! Images as the tracker reads them: pixels, light, crops, small grids of numbers, and the camera that took them.

pub(crate) mod crop;
pub(crate) mod grid;
pub(crate) mod light;
pub(crate) mod pixels;
pub(crate) mod view;

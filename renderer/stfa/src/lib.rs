//! Learned appearance: networks of spatial-temporal feature aggregation (FlyHuman, section 3.2), trained on simulated
//! people, that correct direct appearance.
//!
//! # What goes through
//!
//! 1. **Encoder**: three scales of feature maps over the person's box of every image.
//! 2. **Aggregation** (Eq. 5 to 8): bilinear samples at the projected Gaussians, with the weights that direct appearance
//!    found ([`Observations`](flyrig_renderer::Observations)).
//! 3. **Graph**: graph-transformer layers over the deformation graph's nodes, with their position on the body, the
//!    colours seen around them and their visibility; each node has an edge to its mirror image. Eq. 9 inpaints unseen
//!    Gaussians.
//! 4. **Memory** (Eq. 10 to 12) of whole feature vectors.
//! 5. **Colour**: a small network that moves direct appearance's colour towards candidates (the colour around, the colour
//!    of the other side, sharper detail) and adds a residual.
//!
//! The last layer starts at zero: an untrained network gives the colours of direct appearance.

mod body_graph;
mod comparison;
mod crops;
mod error;
mod inputs;
mod memory;
mod network;
mod paint;
mod parameters;
mod sample;
mod structure;
mod taps;
mod tensor_file;
mod train;
mod train_settings;
mod variation;
mod weights;

pub use body_graph::{BodyGraph, EDGES, PLACE, POOLED};
pub use comparison::{Errors, SampleErrors, evaluate};
pub use crops::{Crops, DETAIL, ViewImage};
pub use error::StfaError;
pub use inputs::{CANDIDATES, FrameInputs, NODE, STATE, frame_inputs};
pub use memory::FeatureMemory;
pub use paint::{LearnedAppearance, PaintCounts};
pub use parameters::{NetworkSize, Parameters};
pub use sample::{PATCH, SHARES, TargetImage, TargetPixels, TrainingSample, training_sample};
pub use taps::{FeatureMaps, Tap, Taps};
pub use train::{Loss, Trainer};
pub use train_settings::TrainSettings;
pub use weights::{EMBEDDED, WEIGHTS_VERSION};

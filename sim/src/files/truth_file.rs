//! Ground truth of an image as an OpenEXR file.

use std::path::Path;

use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Image, Layer, LayerAttributes, SmallVec, Vec2, WritableImage as _,
};

use crate::camera::frame::SimFrame;
use crate::error::SimError;

/// Writes the channels `Z` (camera-space depth, metres), `N.X`, `.Y`, `.Z` (world normal), `canonical.X`, `.Y`, `.Z`
/// (metres) and `part` (index + 1; 0 is no person).
pub(crate) fn write_truth(path: &Path, frame: &SimFrame) -> Result<(), SimError> {
    let axis = |axis: usize| FlatSamples::F32(frame.canonical.iter().map(|p| p[axis]).collect());
    let normal = |axis: usize| FlatSamples::F32(frame.normal.iter().map(|n| n[axis]).collect());
    let part = |part: &Option<flyrig_body::Part>| part.map_or(0, |part| part as u32 + 1);
    let channels: SmallVec<[AnyChannel<FlatSamples>; 4]> = [
        AnyChannel::new("Z", FlatSamples::F32(frame.depth.clone())),
        AnyChannel::new("N.X", normal(0)),
        AnyChannel::new("N.Y", normal(1)),
        AnyChannel::new("N.Z", normal(2)),
        AnyChannel::new("canonical.X", axis(0)),
        AnyChannel::new("canonical.Y", axis(1)),
        AnyChannel::new("canonical.Z", axis(2)),
        AnyChannel::new("part", FlatSamples::U32(frame.part.iter().map(part).collect())),
    ]
    .into_iter()
    .collect();
    let size = Vec2(frame.color.width() as usize, frame.color.height() as usize);
    let layer = Layer::new(size, LayerAttributes::default(), Encoding::SMALL_LOSSLESS, AnyChannels::sort(channels));
    Image::from_layer(layer)
        .write()
        .non_parallel()
        .to_file(path)
        .map_err(|error| SimError::Export { path: path.to_owned(), message: format!("cannot be written: {error}") })
}

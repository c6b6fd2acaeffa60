//! PNG files of images.

use std::path::Path;

use anyhow::{Context, Result};
use flyrig_types::{Mask, RenderedView};
use image::{
    ExtendedColorType, ImageEncoder as _,
    codecs::png::{CompressionType, FilterType, PngEncoder},
};

use crate::write_whole;

/// Encodes an RGB image as PNG.
///
/// # Errors
/// The bytes do not fit the size.
pub fn encode_rgb(rgb: &[u8], width: u32, height: u32) -> Result<Vec<u8>> {
    encode(rgb, width, height, ExtendedColorType::Rgb8)
}

/// Encodes a rendered view as PNG with straight alpha.
///
/// # Errors
/// The bytes do not fit the size.
pub fn encode_rgba(view: &RenderedView) -> Result<Vec<u8>> {
    encode(&view.rgba, view.width, view.height, ExtendedColorType::Rgba8)
}

/// Encodes the coverage of a mask as a grey PNG.
///
/// # Errors
/// The bytes do not fit the size.
pub fn encode_mask(mask: &Mask) -> Result<Vec<u8>> {
    encode(mask.coverage(), mask.width(), mask.height(), ExtendedColorType::L8)
}

fn encode(bytes: &[u8], width: u32, height: u32, color: ExtendedColorType) -> Result<Vec<u8>> {
    let mut png = Vec::new();
    PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Adaptive)
        .write_image(bytes, width, height, color)
        .context("encoding a PNG image")?;
    Ok(png)
}

/// Writes a rendered view as straight-alpha PNG, whole or not at all.
///
/// # Errors
/// Names the file.
pub fn write_view(path: &Path, view: &RenderedView) -> Result<()> {
    write_whole(path, &encode_rgba(view)?)
}

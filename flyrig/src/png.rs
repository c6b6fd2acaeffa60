//! PNG and JPEG bytes of pictures.

use std::path::Path;

use anyhow::{Context, Result};
use image::{
    ExtendedColorType, ImageEncoder as _,
    codecs::{
        jpeg::JpegEncoder,
        png::{CompressionType, FilterType, PngEncoder},
    },
};

use crate::{engine::RenderedView, report::write_whole};

/// PNG bytes of an RGB picture.
pub fn encode_rgb(rgb: &[u8], width: u32, height: u32) -> Result<Vec<u8>> {
    encode(rgb, width, height, ExtendedColorType::Rgb8)
}

/// PNG bytes of a rendered view, straight alpha.
pub fn encode_rgba(view: &RenderedView) -> Result<Vec<u8>> {
    encode(&view.rgba, view.width, view.height, ExtendedColorType::Rgba8)
}

fn encode(bytes: &[u8], width: u32, height: u32, color: ExtendedColorType) -> Result<Vec<u8>> {
    let mut png = Vec::new();
    PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Adaptive)
        .write_image(bytes, width, height, color)
        .context("encoding a PNG picture")?;
    Ok(png)
}

/// JPEG bytes of an RGB picture.
pub fn encode_jpeg(rgb: &[u8], width: u32, height: u32, quality: u8) -> Result<Vec<u8>> {
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, quality)
        .write_image(rgb, width, height, ExtendedColorType::Rgb8)
        .context("encoding a JPEG picture")?;
    Ok(jpeg)
}

/// Writes a rendered view as straight-alpha RGBA, whole or not at all.
pub fn write_view(path: &Path, view: &RenderedView) -> Result<()> {
    write_whole(path, &encode_rgba(view)?)
}

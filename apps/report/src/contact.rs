//! Images of a contact sheet: truth, rendered view and error map.

use anyhow::Result;
use flyrig_metrics::{Picture, ScoredImages, flip};
use flyrig_types::{CameraId, Image, Mask, RenderedView};

use crate::png;

/// Encodes truth, rendered view and ꟻLIP map, cropped to the person, as captioned PNG images.
///
/// # Errors
/// Sizes differ, or an image cannot be read.
pub fn contact_images(
    camera: &CameraId,
    view: &RenderedView,
    truth: &Image,
    mask: Option<&Mask>,
) -> Result<Vec<(String, Vec<u8>)>> {
    let Some(ScoredImages { ours, truth, area }) = ScoredImages::new(view, truth, mask)? else { return Ok(Vec::new()) };
    let map = flip(&truth, &ours, area)?;
    let (width, height) = (area[2] - area[0], area[3] - area[1]);
    let cut = |picture: &Picture| -> Vec<u8> {
        let row = |y: u32| {
            let start = (y * picture.size().0 + area[0]) as usize;
            &picture.pixels()[start..start + width as usize]
        };
        (area[1]..area[3]).flat_map(row).flatten().map(|v| (v * 255.0).round() as u8).collect()
    };
    Ok(vec![
        (format!("held-out {camera}"), png::encode_rgb(&cut(&truth), width, height)?),
        ("ours".to_owned(), png::encode_rgb(&cut(&ours), width, height)?),
        (format!("FLIP {:.3}", map.mean), png::encode_rgb(&map.to_rgb8(), width, height)?),
    ])
}

//! Separate scores of head and hands, which are small but draw the eye.

use anyhow::Result;
use flyrig_avatar::DetailedScene;
use flyrig_body::Part;
use flyrig_metrics::{FrameScore, score_view};
use flyrig_types::{Camera, Image, Mask, RenderedView};

/// Margin around the centres of a part's Gaussians, pixels.
const MARGIN_PX: f64 = 3.0;
/// Separately scored parts; both hands share a row.
const PARTS: [(&str, Part); 3] = [("head", Part::Head), ("hands", Part::LeftHand), ("hands", Part::RightHand)];

/// Scores the boxes around head and hands of a view, with their names in place of the camera's.
pub(super) fn score_parts(
    (scene, camera): (&DetailedScene, &Camera),
    frame: u64,
    view: &RenderedView,
    truth: &Image,
    mask: &Mask,
) -> Result<Vec<FrameScore>> {
    let mut scores = Vec::new();
    for (name, part) in PARTS {
        let Some(area) = scene.part_box(&[part], camera, MARGIN_PX) else { continue };
        let view = RenderedView { rgba: cut(&view.rgba, view.width, 4, area), ..view.clone() };
        let mask = Mask::new(mask.width(), mask.height(), cut(mask.coverage(), mask.width(), 1, area))?;
        scores.extend(score_view(&name.into(), frame, &view, truth, Some(&mask))?);
    }
    Ok(scores)
}

/// Zeroes the pixels outside a box, in an image with this number of channels.
fn cut(bytes: &[u8], width: u32, channels: usize, [x0, y0, x1, y1]: [u32; 4]) -> Vec<u8> {
    let mut kept = vec![0; bytes.len()];
    let row = (width as usize * channels).max(1);
    let columns = x0 as usize * channels..x1 as usize * channels;
    let rows = kept.chunks_exact_mut(row).zip(bytes.chunks_exact(row)).skip(y0 as usize).take((y1 - y0) as usize);
    rows.for_each(|(to, from)| to[columns.clone()].copy_from_slice(&from[columns.clone()]));
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_box_is_kept() {
        let bytes: Vec<u8> = (1..=24).collect();
        let kept = cut(&bytes, 4, 2, [1, 1, 3, 2]);
        assert_eq!(kept[10..14], [11, 12, 13, 14]);
        assert_eq!(kept.iter().filter(|byte| **byte > 0).count(), 4);
        assert_eq!(cut(&bytes, 4, 2, [0, 0, 4, 3]), bytes);
    }
}

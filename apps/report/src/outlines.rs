//! Input images with the outlines of mask and rendered person, which show whether masks, pose and calibration fit.

use anyhow::{Result, ensure};
use flyrig_capture::to_rgb8;
use flyrig_fusion::{PersonId, Session};
use flyrig_metrics::{BOX_MARGIN_PX, PixelBox, person_box};
use flyrig_types::{Frame, Mask, RenderedView};

use crate::png;

/// Colour of the mask's outline.
const MASK: [u8; 3] = [0, 255, 80];
/// Colour of the rendered person's outline.
const DRAWN: [u8; 3] = [255, 0, 200];

/// Encodes every input view of a person's last update as a captioned PNG image with outlines, cropped to the person.
///
/// # Errors
/// A view cannot be rendered.
pub fn outlined_inputs(session: &mut Session, person: PersonId) -> Result<Vec<(String, Vec<u8>)>> {
    let mut out = Vec::new();
    for (view, camera) in session.viewed(person).into_iter().enumerate() {
        let drawn = session.render(&camera)?;
        let (width, height) = (drawn.width as usize, drawn.height as usize);
        let seen = session.subject(person).map_or(&[][..], |subject| subject.input(view));
        if seen.len() != drawn.rgba.len() {
            continue;
        }
        let mut rgb: Vec<u8> = seen.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
        paint_outline(&mut rgb, seen, width, height, MASK);
        paint_outline(&mut rgb, &drawn.rgba, width, height, DRAWN);
        let caption = format!("input {}: mask green, ours magenta", camera.id);
        let covered = |at: usize| seen[at].max(drawn.rgba[at]);
        let either = (3..seen.len()).step_by(4).map(covered).collect();
        let area = person_box(&Mask::new(drawn.width, drawn.height, either)?, BOX_MARGIN_PX);
        out.push((caption, cropped(&rgb, width, area.unwrap_or([0, 0, drawn.width, drawn.height]))?));
    }
    Ok(out)
}

/// Encodes a held-out image as a captioned PNG image, cropped to the person, with the outlines of its mask, if there is one, and of the
/// rendered view. `None` where the view shows nobody.
///
/// # Errors
/// The image cannot be read, or sizes differ.
pub fn outlined_view(view: &RenderedView, truth: &Frame, mask: Option<&Mask>) -> Result<Option<(String, Vec<u8>)>> {
    let (width, height) = (view.width as usize, view.height as usize);
    let mut rgb = to_rgb8(&truth.image)?;
    let alpha = |rgba: &[u8]| rgba.chunks_exact(4).map(|pixel| pixel[3]).collect::<Vec<u8>>();
    let silhouette = Mask::new(view.width, view.height, alpha(&view.rgba))?;
    // The box of the images beside it.
    let shown = truth.mask.as_ref().unwrap_or(&silhouette);
    let Ok(area) = person_box(shown, BOX_MARGIN_PX) else { return Ok(None) };
    let fits = |mask: &Mask| (mask.width(), mask.height()) == (view.width, view.height);
    ensure!(
        rgb.len() == 3 * width * height && truth.mask.as_ref().is_none_or(fits),
        "camera {}: image and view differ in size",
        truth.camera
    );
    let mut caption = format!("held-out {}: ours magenta", truth.camera);
    if let Some(mask) = mask.filter(|mask| fits(mask)) {
        let rgba: Vec<u8> = mask.coverage().iter().flat_map(|&a| [0, 0, 0, a]).collect();
        paint_outline(&mut rgb, &rgba, width, height, MASK);
        caption = format!("held-out {}: mask green, ours magenta", truth.camera);
    }
    paint_outline(&mut rgb, &view.rgba, width, height, DRAWN);
    Ok(Some((caption, cropped(&rgb, width, area)?)))
}

/// Encodes the pixels of a box in an image of this width.
fn cropped(rgb: &[u8], width: usize, [left, top, right, bottom]: PixelBox) -> Result<Vec<u8>> {
    let row = |y: usize| &rgb[3 * (y * width + left as usize)..3 * (y * width + right as usize)];
    let cut: Vec<u8> = (top as usize..bottom as usize).flat_map(row).copied().collect();
    png::encode_rgb(&cut, right - left, bottom - top)
}

/// Paints the pixels of `rgb` whose alpha in `rgba` is at least 128 while that of a neighbour is not.
pub fn paint_outline(rgb: &mut [u8], rgba: &[u8], width: usize, height: usize, color: [u8; 3]) {
    let covered = |x: usize, y: usize| rgba[(y * width + x) * 4 + 3] >= 128;
    for y in 0..height {
        for x in 0..width {
            let inner = x > 0 && y > 0 && x + 1 < width && y + 1 < height;
            let surrounded = inner && covered(x - 1, y) && covered(x + 1, y) && covered(x, y - 1) && covered(x, y + 1);
            if covered(x, y) && !surrounded {
                rgb[(y * width + x) * 3..][..3].copy_from_slice(&color);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_rim_is_painted() {
        let (width, height) = (6, 5);
        let inside = |i: usize| (1..5).contains(&(i % width)) && (1..4).contains(&(i / width));
        let rgba: Vec<u8> = (0..width * height).flat_map(|i| [0, 0, 0, if inside(i) { 200 } else { 90 }]).collect();
        let mut rgb = vec![7; width * height * 3];
        paint_outline(&mut rgb, &rgba, width, height, MASK);
        for i in 0..width * height {
            let rim = inside(i) && !((2..4).contains(&(i % width)) && i / width == 2);
            assert_eq!(rgb[i * 3..][..3] == MASK, rim, "pixel {i}");
        }
        let whole = vec![255; 4];
        let mut one = vec![0; 3];
        paint_outline(&mut one, &whole, 1, 1, DRAWN);
        assert_eq!(one, DRAWN);
    }
}

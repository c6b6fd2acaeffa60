//! Scores of rendered views against held-out images.

use std::fmt::Write as _;

use flyrig_capture::to_rgb8;
use flyrig_types::{CameraId, Image, Mask, RenderedView};
use serde::Serialize;

use crate::{
    error_parts::ErrorParts,
    image_metrics::{BOX_MARGIN_PX, MetricError, Picture, PixelBox, flip, mask_iou, person_box, psnr, ssim},
};

type Result<T, E = MetricError> = std::result::Result<T, E>;

/// Scores of one rendered image.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameScore {
    /// Name of the held-out camera.
    pub camera: String,
    /// Frame number.
    pub frame: u64,
    /// Peak signal-to-noise ratio, dB.
    pub psnr_db: f64,
    /// Structural similarity, at most 1.
    pub ssim: f64,
    /// Mean ꟻLIP error, 0..=1.
    pub flip: f64,
    /// Intersection over union of the silhouettes; `None` without a true mask.
    pub iou: Option<f64>,
    /// Parts of the error; filled in from [`error_parts`].
    pub parts: Option<ErrorParts>,
}

/// Mean scores of a camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraScore {
    /// Name of the held-out camera, or "all".
    pub camera: String,
    /// Number of scored images.
    pub frames: usize,
    /// Peak signal-to-noise ratio, dB.
    pub psnr_db: f64,
    /// Structural similarity, at most 1.
    pub ssim: f64,
    /// Mean ꟻLIP error, 0..=1.
    pub flip: f64,
    /// Intersection over union of the silhouettes; `None` without a true mask.
    pub iou: Option<f64>,
    /// Parts of the error; only with a true mask.
    pub parts: Option<ErrorParts>,
}

/// Rendered view and held-out image as they are scored, and the box around the person.
#[derive(Debug, Clone, PartialEq)]
pub struct ScoredImages {
    /// Composited view.
    pub ours: Picture,
    /// Held-out image.
    pub truth: Picture,
    /// Box around the person.
    pub area: PixelBox,
}

impl ScoredImages {
    /// Composites both images on black if the true mask is known. Without it, composites the view over the held-out image, inside the
    /// box of the view's own silhouette. Returns `None` if the mask or silhouette shows no person.
    ///
    /// # Errors
    /// Sizes differ, or the image cannot be converted to RGB.
    pub fn new(view: &RenderedView, truth: &Image, mask: Option<&Mask>) -> Result<Option<Self>> {
        let (width, height) = (view.width, view.height);
        let rgb = to_rgb8(truth).map_err(|error| MetricError::Image(error.to_string()))?;
        let silhouette = own_silhouette(view)?;
        let Some(mask) = mask else {
            let Ok(area) = person_box(&silhouette, BOX_MARGIN_PX) else { return Ok(None) };
            let truth = Picture::from_rgb8(truth.width(), truth.height(), &rgb)?;
            return Ok(Some(Self { ours: Picture::over(width, height, &view.rgba, &truth)?, truth, area }));
        };
        let Ok(area) = person_box(mask, BOX_MARGIN_PX) else { return Ok(None) };
        let rgba: Vec<u8> =
            rgb.chunks_exact(3).zip(mask.coverage()).flat_map(|(c, &a)| [c[0], c[1], c[2], a]).collect();
        Ok(Some(Self {
            ours: Picture::on_black(width, height, &view.rgba)?,
            truth: Picture::on_black(truth.width(), truth.height(), &rgba)?,
            area,
        }))
    }
}

/// Returns the alpha of a view as its mask.
fn own_silhouette(view: &RenderedView) -> Result<Mask> {
    let alpha = view.rgba.chunks_exact(4).map(|p| p[3]).collect();
    Mask::new(view.width, view.height, alpha).map_err(|error| MetricError::Image(error.to_string()))
}

/// Scores a rendered view; returns `None` if there is no person to compare.
///
/// ```
/// use flyrig_metrics::{ScoreSheet, score_view};
/// use flyrig_types::{CameraId, Image, Mask, PixelFormat, RenderedView};
///
/// let view = RenderedView { width: 32, height: 32, rgba: [90, 90, 90, 255].repeat(32 * 32) };
/// let truth = Image::new(32, 32, PixelFormat::Rgb8, vec![90; 32 * 32 * 3])?;
/// let mask = Mask::new(32, 32, vec![255; 32 * 32])?;
///
/// let mut sheet = ScoreSheet::default();
/// sheet.extend(score_view(&CameraId::from("01"), 0, &view, &truth, Some(&mask))?);
/// let mean = sheet.mean().expect("one image was scored");
/// assert!(mean.psnr_db > 98.0 && mean.iou == Some(1.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// See [`ScoredImages::new`].
pub fn score_view(
    camera: &CameraId,
    frame: u64,
    view: &RenderedView,
    truth: &Image,
    mask: Option<&Mask>,
) -> Result<Option<FrameScore>> {
    let Some(ScoredImages { ours, truth, area }) = ScoredImages::new(view, truth, mask)? else { return Ok(None) };
    let iou = mask.map(|mask| mask_iou(&own_silhouette(view)?, mask)).transpose()?;
    Ok(Some(FrameScore {
        camera: camera.to_string(),
        frame,
        psnr_db: psnr(&ours, &truth, area)?,
        ssim: ssim(&ours, &truth, area)?,
        flip: flip(&truth, &ours, area)?.mean,
        iou,
        parts: None,
    }))
}

/// Splits the error of a rendered view into parts; returns `None` if there is no person to compare.
///
/// # Errors
/// See [`ScoredImages::new`].
pub fn error_parts(view: &RenderedView, truth: &Image, mask: &Mask) -> Result<Option<ErrorParts>> {
    let Some(ScoredImages { ours, truth, area }) = ScoredImages::new(view, truth, Some(mask))? else { return Ok(None) };
    Ok(Some(ErrorParts::new(&ours, &truth, &own_silhouette(view)?, mask, area)))
}

/// Scores of all images of a run.
#[derive(Debug, Default)]
pub struct ScoreSheet {
    frames: Vec<FrameScore>,
}

impl ScoreSheet {
    /// Adds scores.
    pub fn extend(&mut self, scores: impl IntoIterator<Item = FrameScore>) {
        self.frames.extend(scores);
    }

    /// Returns the scores of all images.
    pub fn frames(&self) -> &[FrameScore] {
        &self.frames
    }

    /// Returns the name of the reference: true masks, or the silhouettes of the rendered views.
    pub fn reference(&self) -> &'static str {
        if self.frames.iter().any(|score| score.iou.is_some()) { "mask" } else { "own silhouette" }
    }

    /// Returns the mean scores of each camera, in the order of first appearance.
    pub fn per_camera(&self) -> Vec<CameraScore> {
        let mut names: Vec<&str> = Vec::new();
        for score in &self.frames {
            if !names.contains(&score.camera.as_str()) {
                names.push(&score.camera);
            }
        }
        names
            .into_iter()
            .filter_map(|name| mean(name, &self.frames.iter().filter(|score| score.camera == name)))
            .collect()
    }

    /// Returns the mean over all images; `None` without any.
    pub fn mean(&self) -> Option<CameraScore> {
        mean("all", &self.frames.iter())
    }

    /// Returns PSNR (dB) over frame numbers, one named line per camera.
    pub fn curves(&self) -> Vec<(String, Vec<(f64, f64)>)> {
        self.per_camera()
            .into_iter()
            .map(|camera| {
                let points = self.frames.iter().filter(|score| score.camera == camera.camera);
                (camera.camera.clone(), points.map(|score| (score.frame as f64, score.psnr_db)).collect())
            })
            .collect()
    }

    /// Formats the mean PSNR for a progress bar.
    pub fn progress(&self) -> String {
        self.mean().map(|mean| format!("PSNR {:.2} dB", mean.psnr_db)).unwrap_or_default()
    }

    /// Formats the scores for the terminal.
    pub fn table(&self) -> String {
        let mut text =
            format!("{:<8} {:>6} {:>9} {:>8} {:>8} {:>9}\n", "camera", "frames", "PSNR dB", "SSIM", "FLIP", "mask IoU");
        for s in self.per_camera().into_iter().chain(self.mean()) {
            let iou = s.iou.map_or_else(|| "-".to_owned(), |v| format!("{v:.4}"));
            let _ = writeln!(
                text,
                "{:<8} {:>6} {:>9.2} {:>8.4} {:>8.4} {iou:>9}",
                s.camera, s.frames, s.psnr_db, s.ssim, s.flip
            );
        }
        if let Some(parts) = self.mean().and_then(|mean| mean.parts) {
            let _ = writeln!(text, "{parts}");
        }
        text
    }
}

/// Averages scores; `None` without any.
fn mean<'a>(name: &str, scores: &(impl Iterator<Item = &'a FrameScore> + Clone)) -> Option<CameraScore> {
    let frames = scores.clone().count();
    if frames == 0 {
        return None;
    }
    let over = |pick: fn(&FrameScore) -> f64| scores.clone().map(pick).sum::<f64>() / frames as f64;
    let ious: Vec<f64> = scores.clone().filter_map(|score| score.iou).collect();
    let parts: Vec<ErrorParts> = scores.clone().filter_map(|score| score.parts).collect();
    Some(CameraScore {
        camera: name.to_owned(),
        frames,
        psnr_db: over(|s| s.psnr_db),
        ssim: over(|s| s.ssim),
        flip: over(|s| s.flip),
        iou: (!ious.is_empty()).then(|| ious.iter().sum::<f64>() / ious.len() as f64),
        parts: ErrorParts::mean(&parts),
    })
}

#[cfg(test)]
mod tests {
    use flyrig_types::PixelFormat;

    use super::*;

    fn view(value: u8, alpha: u8) -> RenderedView {
        RenderedView { width: 32, height: 32, rgba: [value, value, value, alpha].repeat(32 * 32) }
    }

    #[test]
    fn a_perfect_view_scores_perfectly_and_a_wrong_one_does_not() {
        let truth = Image::new(32, 32, PixelFormat::Rgb8, vec![90; 32 * 32 * 3]).unwrap();
        let mask = Mask::new(32, 32, vec![255; 32 * 32]).unwrap();
        let id = CameraId::from("01");
        let perfect = score_view(&id, 0, &view(90, 255), &truth, Some(&mask)).unwrap().unwrap();
        assert!(perfect.psnr_db > 98.0 && perfect.ssim > 0.999 && perfect.flip < 1e-3 && perfect.iou == Some(1.0));
        let wrong = score_view(&id, 0, &view(141, 255), &truth, Some(&mask)).unwrap().unwrap();
        assert!((wrong.psnr_db - 20.0 * 5.0f64.log10()).abs() < 0.01, "a fifth of the range off: {}", wrong.psnr_db);
    }

    #[test]
    fn nobody_is_not_a_score() {
        let truth = Image::new(32, 32, PixelFormat::Rgb8, vec![90; 32 * 32 * 3]).unwrap();
        let empty = Mask::new(32, 32, vec![0; 32 * 32]).unwrap();
        let id = CameraId::from("01");
        assert_eq!(score_view(&id, 0, &view(90, 255), &truth, Some(&empty)).unwrap(), None);
        assert_eq!(score_view(&id, 0, &view(90, 0), &truth, None).unwrap(), None);
        assert!(ScoreSheet::default().mean().is_none());
    }

    #[test]
    fn without_a_mask_only_our_own_silhouette_counts() {
        let truth = Image::new(32, 32, PixelFormat::Rgb8, vec![90; 32 * 32 * 3]).unwrap();
        let id = CameraId::from("01");
        let score = score_view(&id, 3, &view(90, 255), &truth, None).unwrap().unwrap();
        assert_eq!((score.iou, score.frame), (None, 3));
        assert!(score.psnr_db > 98.0);
    }
}

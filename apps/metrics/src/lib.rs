//! Image metrics: PSNR, SSIM, ꟻLIP and mask IoU of two images, scores of rendered views against held-out cameras, and the part of the
//! error at the silhouette.

mod error_parts;
mod image_metrics;
mod score;

pub use error_parts::{ErrorParts, SCALES_PX};
pub use image_metrics::{
    BOX_MARGIN_PX, FlipMap, MAX_PSNR_DB, MetricError, Picture, PixelBox, flip, mask_iou, person_box, psnr, ssim,
};
pub use score::{CameraScore, FrameScore, ScoreSheet, ScoredImages, error_parts, score_view};

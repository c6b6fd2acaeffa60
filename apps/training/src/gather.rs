//! Training samples from the last update of a session and held-out images.

use anyhow::{Context as _, Result, ensure};
use flyrig_capture::to_rgb8;
use flyrig_fusion::{Observed, PersonId, Session};
use flyrig_renderer::{AppearanceSettings, PosedGaussians};
use flyrig_stfa::{TargetImage, TrainingSample, ViewImage, training_sample};
use flyrig_types::{Camera, Image, Mask};

/// Number of patches per held-out image.
const PATCHES: usize = 16;

/// Image of a held-out camera.
#[derive(Debug, Clone, Copy)]
pub struct HeldOut<'a> {
    pub camera: &'a Camera,
    pub image: &'a Image,
    pub mask: &'a Mask,
}

/// Gathers a training sample from the session's last update.
pub fn gather(
    session: &Session,
    held_out: &[HeldOut<'_>],
    settings: &AppearanceSettings,
    seed: u64,
) -> Result<TrainingSample> {
    let person = PersonId::default();
    let subject = session.subject(person).context("no person was simulated")?;
    let Observed { observations, pictures, center_scale, normal, .. } = session.observed(person)?;
    let pictures: Vec<ViewImage<'_>> =
        pictures.iter().map(|(width, height, rgba)| ViewImage { width: *width, height: *height, rgba }).collect();
    let rgba: Vec<Vec<u8>> = held_out.iter().map(rgba).collect::<Result<_>>()?;
    let targets: Vec<TargetImage<'_>> = held_out
        .iter()
        .zip(&rgba)
        .map(|(of, rgba)| {
            let (width, height) = (of.image.width(), of.image.height());
            TargetImage { camera: of.camera, picture: ViewImage { width, height, rgba } }
        })
        .collect();
    let posed = PosedGaussians { center_scale: &center_scale, normal: &normal };
    Ok(training_sample(subject.body_graph(), &observations, &pictures, settings, posed, &targets, PATCHES, seed)?)
}

fn rgba(of: &HeldOut<'_>) -> Result<Vec<u8>> {
    let rgb = to_rgb8(of.image)?;
    let coverage = of.mask.coverage();
    ensure!(rgb.len() == coverage.len() * 3, "camera {}: mask and image differ in size", of.camera.id);
    Ok(rgb.chunks_exact(3).zip(coverage).flat_map(|(c, &a)| [c[0], c[1], c[2], a]).collect())
}

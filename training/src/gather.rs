//! From an engine's last update and held-out pictures to a training sample.

use anyhow::{Context as _, Result, ensure};
use flyrig_capture::to_rgb8;
use flyrig_fusion::{Observed, PersonId, Session};
use flyrig_renderer::{AppearanceSettings, PosedGaussians};
use flyrig_stfa::{TargetPicture, TrainingSample, ViewPicture, training_sample};
use flyrig_types::{Camera, Image, Mask};

/// Squares of pixels a held-out picture.
const PATCHES: usize = 16;

/// What a camera saw that was no input.
#[derive(Debug, Clone, Copy)]
pub struct HeldOut<'a> {
    pub camera: &'a Camera,
    pub image: &'a Image,
    pub mask: &'a Mask,
}

/// A sample of the last update.
pub fn gather(
    session: &Session,
    held_out: &[HeldOut<'_>],
    settings: &AppearanceSettings,
    seed: u64,
) -> Result<TrainingSample> {
    let person = PersonId::default();
    let subject = session.subject(person).context("nobody was simulated")?;
    let Observed { observations, pictures, center_scale, normal } = session.observed(person)?;
    let pictures: Vec<ViewPicture<'_>> =
        pictures.iter().map(|(width, height, rgba)| ViewPicture { width: *width, height: *height, rgba }).collect();
    let rgba: Vec<Vec<u8>> = held_out.iter().map(rgba).collect::<Result<_>>()?;
    let targets: Vec<TargetPicture<'_>> = held_out
        .iter()
        .zip(&rgba)
        .map(|(of, rgba)| {
            let (width, height) = (of.image.width(), of.image.height());
            TargetPicture { camera: of.camera, picture: ViewPicture { width, height, rgba } }
        })
        .collect();
    let posed = PosedGaussians { center_scale: &center_scale, normal: &normal };
    Ok(training_sample(subject.body_graph(), &observations, &pictures, settings, posed, &targets, PATCHES, seed)?)
}

fn rgba(of: &HeldOut<'_>) -> Result<Vec<u8>> {
    let rgb = to_rgb8(of.image)?;
    let coverage = of.mask.coverage();
    ensure!(rgb.len() == coverage.len() * 3, "camera {}: mask and picture differ in size", of.camera.id);
    Ok(rgb.chunks_exact(3).zip(coverage).flat_map(|(c, &a)| [c[0], c[1], c[2], a]).collect())
}

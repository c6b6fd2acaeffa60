//! Cameras of a take that are left out of everything and then compared with the textured mesh and with the Gaussians.

use anyhow::{Result, ensure};
use flyrig_avatar::{Avatar, DetailedScene, TrainingFrame};
use flyrig_gpu::GpuContext;
use flyrig_mesh::{DrawnMesh, MeshedPerson, draw_textured};
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_report::stop;
use flyrig_takes::{Replay, TruthReader};
use flyrig_types::{Camera, RenderedView};
use serde_json::json;

use super::arguments::LightKind;

/// Frames from one compared with held-out cameras to the next.
const EVERY: u64 = 10;

/// Held-out cameras of a take. Their images are read one frame at a time, so that memory does not grow with the take.
pub(super) struct HeldOut {
    cameras: Vec<Camera>,
    images: TruthReader,
    frames: Vec<HeldFrame>,
}

/// Frame that is compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct HeldFrame {
    /// Index among the frames of the take in which the person was found.
    at: usize,
    number: u64,
    /// Time of the frame, nanoseconds.
    nanos: i64,
}

impl HeldOut {
    /// Takes the held-out cameras of a tracked take; `None` without any. `frames` are number and time, nanoseconds, of the frames in which
    /// the person was found, ascending.
    pub fn of(replay: Replay, frames: &[(u64, i64)]) -> Option<Self> {
        let Replay { holdout: cameras, truth: images, .. } = replay;
        (!cameras.is_empty()).then(|| Self { cameras, images, frames: chosen(frames) })
    }

    /// Returns the mean scores of the textured mesh and of the avatar's Gaussians; `None` without a frame to compare. `frames` are all frames
    /// of the take in which the person was found.
    ///
    /// # Errors
    /// Names the image that cannot be read; the device fails, or the person asks to stop.
    pub fn compare(
        mut self,
        person: &MeshedPerson,
        (avatar, frames): (&Avatar, &[TrainingFrame]),
        light: LightKind,
        gpu: &dyn Fn() -> Result<GpuContext>,
    ) -> Result<Option<serde_json::Value>> {
        let (mut mesh, mut gaussians) = (ScoreSheet::default(), ScoreSheet::default());
        if self.frames.is_empty() {
            return Ok(None);
        }
        let mut scene = DetailedScene::new(&gpu()?.fastest(), avatar.clone(), true)?;
        for HeldFrame { at, number, nanos } in self.frames {
            let Some(frame) = frames.get(at) else { continue };
            let (positions, normals) = person.posed(&frame.pose, Some(&frame.translations));
            let shades = (light == LightKind::Removed).then(|| MeshedPerson::shades(&avatar.light, &normals));
            let drawn = DrawnMesh {
                positions: &positions,
                shades: shades.as_deref(),
                uvs: &person.template.uvs,
                triangles: &person.template.triangles,
                rgb: &person.texture.rgb,
                side: person.texture.side,
            };
            scene.pose(&frame.pose, Some(frame.translations.as_slice()).filter(|all| !all.is_empty()));
            for (camera, truth) in self.cameras.iter().zip(self.images.at(nanos)?) {
                ensure!(!stop::requested(), "stopped; nothing was written");
                let Some(truth) = truth else { continue };
                let score = |sheet: &mut ScoreSheet, view: &RenderedView| -> Result<()> {
                    sheet.extend(score_view(&camera.id, number, view, &truth.image, truth.mask.as_ref())?);
                    Ok(())
                };
                score(&mut mesh, &draw_textured(&drawn, camera))?;
                score(&mut gaussians, &scene.draw(camera)?)?;
            }
        }
        let scores = |sheet: &ScoreSheet| {
            sheet.mean().map(|CameraScore { frames, psnr_db, ssim, flip, iou, .. }| {
                json!({ "images": frames, "psnr_db": psnr_db, "ssim": ssim, "flip": flip, "iou": iou })
            })
        };
        Ok(Some(json!({ "mesh": scores(&mesh), "gaussians": scores(&gaussians) })))
    }
}

/// Chooses the first frame and every tenth one, by their numbers in the take.
fn chosen(frames: &[(u64, i64)]) -> Vec<HeldFrame> {
    let all = frames.iter().enumerate().map(|(at, &(number, nanos))| HeldFrame { at, number, nanos });
    all.filter(|frame| frame.at == 0 || frame.number.is_multiple_of(EVERY)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_frame_and_every_tenth_one_are_compared() {
        let frames: Vec<(u64, i64)> = [3, 4, 9, 10, 11, 20, 25].map(|number| (number, 100 * number as i64)).to_vec();
        let found: Vec<_> = chosen(&frames).iter().map(|frame| (frame.at, frame.number, frame.nanos)).collect();
        assert_eq!(found, [(0, 3, 300), (3, 10, 1000), (5, 20, 2000)]);
        assert_eq!(chosen(&[]), []);
    }
}

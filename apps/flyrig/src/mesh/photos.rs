//! Photographs of a take: the texture of its person, and images of held-out cameras to compare it with.

use std::time::Instant;

use anyhow::{Result, ensure};
use flyrig_avatar::DetailedScene;
use flyrig_fit::TrainingView;
use flyrig_gpu::GpuContext;
use flyrig_mesh::{DrawnMesh, MeshedPerson, Photo, PhotoSettings, draw_textured};
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_report::stop;
use flyrig_takes::{Replay, frame_number};
use flyrig_types::{Camera, FrameSet, Image, Mask, RenderedView};
use serde_json::json;

use super::{arguments::LightKind, source::Source};

/// Frames from one compared with held-out cameras to the next.
const HELD_EVERY: u64 = 10;

/// Photographs of a take.
#[derive(Debug, Default)]
pub(super) struct Photos {
    /// Images of the inputs, cropped to the person.
    pub views: Vec<TrainingView>,
    /// Images of the held-out cameras.
    held: Vec<HeldImage>,
}

/// Image of a held-out camera.
#[derive(Debug)]
struct HeldImage {
    number: u64,
    camera: Camera,
    image: Image,
    mask: Option<Mask>,
}

/// Texture that was made, and how it compares.
#[derive(Debug, Default)]
pub(super) struct PhotoReport {
    /// Share of the texels from photographs, 0..=1.
    pub seen: f32,
    /// Seconds of the texture.
    pub seconds: f64,
}

impl Photos {
    /// Keeps the images of the held-out cameras of every tenth frame, or of `only` this one.
    pub fn hold(&mut self, replay: &mut Replay, set: &FrameSet, only: Option<u64>) -> Result<()> {
        let number = frame_number(set);
        let is_held = only.map_or(number.is_multiple_of(HELD_EVERY), |only| only == number);
        if replay.holdout.is_empty() || !is_held {
            return Ok(());
        }
        let truths = replay.truth.at(set.master_nanos)?;
        for (camera, truth) in replay.holdout.iter().zip(truths) {
            let Some(truth) = truth else { continue };
            let (image, mask) = (&truth.image, truth.mask.clone());
            let image = Image::new(image.width(), image.height(), image.format(), image.bytes().to_vec())?;
            self.held.push(HeldImage { number, camera: camera.clone(), image, mask });
        }
        Ok(())
    }
}

/// Gives a person the texture of the take's photographs, or of its Gaussians where there are none.
pub(super) fn texture(person: &mut MeshedPerson, source: &Source, light: LightKind) -> Result<PhotoReport> {
    ensure!(!stop::requested(), "stopped; nothing was written");
    let started = Instant::now();
    let photos: Vec<Photo<'_>> = source
        .photos
        .views
        .iter()
        .map(|view| Photo { frame: view.frame(), camera: view.camera(), rgba: view.rgba() })
        .collect();
    let baked = (light == LightKind::Baked).then(|| person.mean_shades(&source.avatar));
    let made = (!photos.is_empty())
        .then(|| {
            let of = (source.frames.as_slice(), photos.as_slice());
            person.photographed(&source.avatar.light, of, baked.as_deref(), &PhotoSettings::default())
        })
        .transpose()?;
    let seen = made.as_ref().map_or(0.0, |made| made.seen);
    match (made, &baked) {
        (Some(made), _) => person.texture = made.atlas,
        (None, Some(shades)) => person.texture = person.lit_texture(shades)?,
        (None, None) => {}
    }
    Ok(PhotoReport { seen, seconds: started.elapsed().as_secs_f64() })
}

/// Returns the mean scores of the textured mesh and of the Gaussians at the held-out cameras; `None` without any.
pub(super) fn compare(
    person: &MeshedPerson,
    source: &Source,
    light: LightKind,
    gpu: &dyn Fn() -> Result<GpuContext>,
) -> Result<Option<serde_json::Value>> {
    let avatar = &source.avatar;
    let (mut mesh, mut gaussians) = (ScoreSheet::default(), ScoreSheet::default());
    if source.photos.held.is_empty() {
        return Ok(None);
    }
    let mut scene = DetailedScene::new(&gpu()?.fastest(), avatar.clone(), true)?;
    for HeldImage { number, camera, image, mask } in &source.photos.held {
        ensure!(!stop::requested(), "stopped; nothing was written");
        let at = source.numbers.iter().position(|known| known == number);
        let Some(frame) = at.and_then(|at| source.frames.get(at)) else { continue };
        let score = |sheet: &mut ScoreSheet, view: &RenderedView| -> Result<()> {
            sheet.extend(score_view(&camera.id, *number, view, image, mask.as_ref())?);
            Ok(())
        };
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
        score(&mut mesh, &draw_textured(&drawn, camera))?;
        scene.pose(&frame.pose, Some(frame.translations.as_slice()).filter(|all| !all.is_empty()));
        score(&mut gaussians, &scene.draw(camera)?)?;
    }
    let scores = |sheet: &ScoreSheet| {
        sheet.mean().map(|CameraScore { frames, psnr_db, ssim, flip, iou, .. }| {
            json!({ "images": frames, "psnr_db": psnr_db, "ssim": ssim, "flip": flip, "iou": iou })
        })
    };
    Ok(Some(json!({ "mesh": scores(&mesh), "gaussians": scores(&gaussians) })))
}

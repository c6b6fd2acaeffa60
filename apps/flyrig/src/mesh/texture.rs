//! Texture of a person from the photographs of the take, and how it compares at held-out cameras.

use std::time::Instant;

use anyhow::{Result, ensure};
use flyrig_avatar::DetailedScene;
use flyrig_gpu::GpuContext;
use flyrig_mesh::{DrawnMesh, MeshedPerson, Photo, PhotoSettings, draw_textured};
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_report::stop;
use flyrig_types::RenderedView;
use serde_json::json;

use super::{arguments::LightKind, photos::HeldImage, source::Source};

/// Texture that was made.
#[derive(Debug, Default)]
pub(super) struct PhotoReport {
    /// Share of the texels from photographs, 0..=1.
    pub seen: f32,
    /// Seconds of the texture.
    pub seconds: f64,
}

/// Gives a person the texture of the take's photographs, or of its Gaussians where there are none.
pub(super) fn photograph(person: &mut MeshedPerson, source: &Source, light: LightKind) -> Result<PhotoReport> {
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

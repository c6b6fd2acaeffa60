//! Texture of a person from the photographs of the take.

use std::time::Instant;

use anyhow::{Result, ensure};
use flyrig_mesh::{MeshedPerson, Photo, PhotoSettings};
use flyrig_report::stop;

use super::{arguments::LightKind, source::Source};

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

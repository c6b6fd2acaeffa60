//! Check of a take's calibration by the person in it: time offsets, poses and colours.
//!
//! Each is measured on the person and adopted only where silhouettes and colours that were kept back agree better with it. The result
//! lies in the take: `calibration.toml`, the old one beside it, and `calibration.check.json`, which says what was found.

mod checked;
mod colors;
mod files;
mod geometry;
mod sentences;
mod stretches;

use std::path::Path;

use anyhow::{Context as _, Result};
use flyrig_gpu::GpuContext;
use flyrig_sync::SyncSettings;
use flyrig_types::{Image, Rig};
use serde_json::json;

pub use self::{
    checked::{CheckInput, Checked},
    files::{mark_checked, save_checked},
};
use self::{
    colors::{ColorFinding, match_take},
    files::is_checked,
    geometry::measure,
    sentences::sentences,
    stretches::Stretches,
};
use crate::{
    dataset,
    footage::{Footage, OpenFootage},
    open::{TakeInput, TakeOptions},
    take::{Calibration, Take},
};
use flyrig_capture::FolderOptions;

/// Checks the calibration of a take folder that was never checked, adopts what agrees better, and prints what was wrong. A folder that
/// cannot be written, a single camera, and a person who tells nothing leave the calibration as it is, with a line that says so.
///
/// # Errors
/// The result cannot be written.
pub fn check_take(root: &Path, fps: f64, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    let footage = Footage::from_dataset(root);
    let Some(root) = footage.folder() else { return Ok(()) };
    // What cannot be opened is named by the command, which opens it again.
    let opened = footage.open(None, &FolderOptions { fps, ..FolderOptions::default() });
    let Ok(OpenFootage { sources, .. }) = opened else { return Ok(()) };
    let cameras: Vec<_> = sources.iter().map(|source| source.camera().clone()).collect();
    drop(sources);
    let Ok(all) = footage.load_rig(&cameras) else { return Ok(()) };
    let names: Vec<String> = all.cameras.iter().map(|camera| camera.id.to_string()).collect();
    let with_images: Vec<String> = names.into_iter().filter(|name| cameras.contains(&name.as_str().into())).collect();
    let rig = dataset::select_cameras(&all, &with_images, "the calibration")?;
    if rig.cameras.len() < 2 || with_images.is_empty() || is_checked(root, &all)? {
        return Ok(());
    }
    if let Err(error) = files::ensure_writable(root) {
        eprintln!("the calibration is used as it is, since nothing can be written beside it ({error})");
        return Ok(());
    }
    eprintln!("checking the calibration by the person in the take, once (--trust-calibration leaves it alone)");
    let plates = dataset::load_plates(&root.join("background"), &rig)?;
    let input = CheckInput { footage: &footage, fps, rigs: std::slice::from_ref(&rig), plates };
    match check(input, gpu) {
        Ok(mut checked) => {
            checked.sentences.iter().for_each(|sentence| eprintln!("{sentence}"));
            // Cameras without images stay.
            let kept = all.cameras.iter().map(|camera| {
                let found = checked.rig.cameras.iter().find(|other| other.id == camera.id);
                found.unwrap_or(camera).clone()
            });
            checked.rig = Rig { cameras: kept.collect(), world_up: all.world_up };
            save_checked(root, &checked)
        }
        Err(error) => {
            eprintln!("the calibration could not be checked and is used as it is: {error:#}");
            files::mark(root, &all)
        }
    }
}

/// Measures time offsets, poses and colours from the person in a take.
///
/// # Errors
/// No person is seen, or the cameras see different ones; the take cannot be read.
pub fn check(input: CheckInput<'_>, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Checked> {
    let CheckInput { footage, fps, rigs, plates } = input;
    let first = rigs.first().context("no calibration")?;
    let cameras: Vec<_> = first.cameras.iter().map(|camera| camera.id.clone()).collect();
    let options = FolderOptions { fps, ..FolderOptions::default() };
    let secs = footage.open(Some(&cameras), &options)?.secs;
    let stretches = Stretches::spread(secs, cameras.len());
    let open = |rig: &Rig| -> Result<Take> {
        let take =
            Take::open(&TakeInput::Footage(footage.clone()), &TakeOptions { fps, ..TakeOptions::default() }, &|| {
                anyhow::bail!("a take needs no adapter")
            })?;
        let sources = take.sources.into_iter().filter(|source| cameras.contains(source.camera())).collect();
        Ok(Take {
            sources,
            calibration: Some(Calibration::without_plates(rig.clone())),
            sync: SyncSettings::default().with_offsets_of(&rig.cameras),
            ..Take { sources: Vec::new(), ..take }
        })
    };
    let finding = measure(rigs, copies(&plates)?, open(first)?, &stretches)?;
    let gpu = gpu()?;
    let colors = open(&finding.rig).and_then(|take| match_take(&finding.rig, &plates, take, gpu));
    let colors = colors.unwrap_or_else(|error| {
        tracing::debug!(%error, "the colours could not be matched");
        ColorFinding::none(&finding.rig)
    });
    let mut rig = finding.rig.clone();
    if colors.is_adopted {
        for (camera, color) in rig.cameras.iter_mut().zip(&colors.colors) {
            camera.color = *color;
        }
    }
    rig.validate().context("the calibration that the person tells")?;
    let sentences = sentences(&rigs[finding.choice], &finding, &colors);
    let report = json!({ "geometry": finding.report(), "colors": colors.report(&rig) });
    let is_changed = colors.is_adopted || finding.adopts_lags || finding.adopts_poses;
    Ok(Checked { rig, choice: finding.choice, is_changed, sentences, report })
}

/// Copies plates, whose bytes are pooled and cannot be shared.
fn copies(plates: &[Option<Image>]) -> Result<Vec<Option<Image>>> {
    let copy = |image: &Image| Image::new(image.width(), image.height(), image.format(), image.bytes().to_vec());
    Ok(plates.iter().map(|plate| plate.as_ref().map(copy).transpose()).collect::<Result<_, _>>()?)
}

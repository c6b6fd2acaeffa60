//! Import of a stranger's files: finds footage and calibration, and writes a take that every command reads.

mod calibration;
mod files;
mod footage;
mod names;
mod options;

use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use flyrig_calib::{Crop, Format, resize_lens};
use flyrig_gpu::GpuContext;
use flyrig_types::{CameraId, Rig};
use glam::DVec3;

use self::{
    calibration::{FoundCalibration, find_calibration},
    files::TakeWriter,
    footage::FoundFootage,
    names::matched,
};
pub use self::{names::parse_pair, options::ImportOptions};
use crate::{
    check::{CheckInput, check, mark_checked, save_checked},
    dataset,
    footage::Footage,
    person_up::person_up,
};

/// Imports footage with its calibration as a take, and prints what was found, assumed and corrected.
///
/// # Errors
/// Names the file or camera that is missing or wrong, and the option that helps. Nothing is left of a take that fails.
pub fn import(options: &ImportOptions, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    let found = FoundFootage::find(&options.inputs)?;
    println!("{found}");
    let calibration = find_calibration(options, &found)?;
    calibration.notes.iter().for_each(|note| println!("{note}"));
    let pairs = matched(&found.names(), &calibration.names(), &options.names)?;
    pairs.notes.iter().for_each(|note| println!("{note}"));
    let rigs = fit_sizes(&found, &calibration, &pairs.pairs)?;
    let writer = TakeWriter::create(&options.out)?;
    writer.footage(&found, &pairs.pairs.iter().map(|(camera, _)| *camera).collect::<Vec<_>>())?;
    let rigs = find_up(&options.out, rigs, calibration.up_is_stated, options.fps);
    let chosen = correct(options, &rigs, gpu)?;
    writer.finish();
    println!("{}: {} cameras, {}", options.out.display(), chosen.cameras.len(), found.kind());
    println!("next: flyrig eval {}", options.out.display());
    Ok(())
}

/// Returns the calibration of the footage's cameras, with lenses for the size of their images. Where images were cropped or extended,
/// two calibrations are possible.
fn fit_sizes(found: &FoundFootage, calibration: &FoundCalibration, pairs: &[(usize, usize)]) -> Result<Vec<Rig>> {
    let sizes = pairs.iter().map(|(slot, _)| found.cameras[*slot].size()).collect::<Result<Vec<_>>>()?;
    let mut rigs = Vec::new();
    for crop in [Crop::Cropped, Crop::Extended] {
        let (mut cameras, mut is_certain) = (Vec::new(), true);
        for ((slot, known), &size) in pairs.iter().zip(&sizes) {
            let source = &found.cameras[*slot];
            let mut camera = calibration.rig.cameras[*known].clone();
            camera.id = CameraId::from(source.name.as_str());
            if size != (camera.intrinsics.width, camera.intrinsics.height) {
                let (lens, resize) = resize_lens(&camera.intrinsics, size, crop)
                    .map_err(|problem| anyhow::anyhow!("camera {}: {problem}", source.name))?;
                camera.intrinsics = lens;
                is_certain &= resize.is_scaled_only();
                if crop == Crop::Cropped || !resize.is_scaled_only() {
                    let or = if crop == Crop::Cropped { "" } else { "or, which the person decides: " };
                    println!("{or}camera {}: {resize}", source.name);
                }
            }
            cameras.push(camera);
        }
        let rig = Rig { cameras, world_up: calibration.rig.world_up };
        rig.validate()?;
        rigs.push(rig);
        if is_certain {
            break;
        }
    }
    Ok(rigs)
}

/// Takes the up direction from the person in the images where the calibration does not state it, and warns where they contradict it.
fn find_up(root: &Path, mut rigs: Vec<Rig>, is_stated: bool, fps: f64) -> Vec<Rig> {
    let Some(rig) = rigs.first() else { return rigs };
    let person = person_up(rig, &Footage::from_dataset(root), fps).unwrap_or_else(|error| {
        eprintln!("warning: up is not checked against the person: {error:#}");
        flyrig_fusion::Upright::default()
    });
    match (person.fault(rig.world_up), person.up()) {
        (Some(fault), _) if is_stated => eprintln!("warning: {fault}"),
        (Some(_), Some(up)) => {
            let DVec3 { x, y, z } = up;
            println!("up is {x:.3} {y:.3} {z:.3}, as the person in the images stands");
            rigs.iter_mut().for_each(|rig| rig.world_up = up);
        }
        _ => {}
    }
    rigs
}

/// Corrects the calibration by the person, and writes it; returns it.
fn correct(options: &ImportOptions, rigs: &[Rig], gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Rig> {
    let rig = rigs.first().context("no calibration fits")?;
    Format::Flyrig.write(&options.out, rig)?;
    if rig.cameras.len() < 2 || options.trusts_calibration {
        mark_checked(&options.out)?;
        return Ok(rig.clone());
    }
    eprintln!("checking the calibration by the person in the take (--trust-calibration leaves it alone)");
    let footage = Footage::from_dataset(&options.out);
    let plates = dataset::load_plates(&options.out.join("background"), rig)?;
    match check(CheckInput { footage: &footage, fps: options.fps, rigs, plates }, gpu) {
        Ok(checked) => {
            if rigs.len() > 1 {
                let words = if checked.choice == 0 { "cut off" } else { "added" };
                println!("the person fits better to images with margins {words}");
            }
            checked.sentences.iter().for_each(|sentence| println!("{sentence}"));
            Format::Flyrig.write(&options.out, &rigs[checked.choice])?;
            save_checked(&options.out, &checked)?;
            Ok(checked.rig)
        }
        Err(error) => {
            ensure!(!flyrig_report::stop::requested(), "stopped");
            eprintln!("warning: the calibration could not be checked and is used as it is: {error:#}");
            mark_checked(&options.out)?;
            Ok(rig.clone())
        }
    }
}

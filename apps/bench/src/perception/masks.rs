//! `flyrig-bench masks`: masks estimated in each camera independently, against which several calibrations are scored.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;
use flyrig_body::{ShapeParams, default_template};
use flyrig_capture::{FolderOptions, FolderReplay};
use flyrig_fusion::SetReader;
use flyrig_report::{arguments::FpsArgs, png, progress_bar, write_whole};
use flyrig_sync::SyncSettings;
use flyrig_takes::{dataset, frame_number};
use flyrig_tracker::{PoseConfig, PoseNet, Viewers};
use flyrig_types::Rig;

/// Arguments of the command.
#[derive(Debug, Args)]
pub struct BenchMasksArgs {
    /// A data set in EasyMocap's layout.
    pub dataset: PathBuf,
    /// Folder of the masks, CAM/000000.png.
    #[arg(long)]
    pub out: PathBuf,
    #[command(flatten)]
    pub rate: FpsArgs,
}

/// Runs the command.
pub fn masks(args: &BenchMasksArgs) -> Result<()> {
    let rig = dataset::load_rig(&args.dataset, &[])?;
    let template = default_template(&ShapeParams::default())?;
    for camera in &rig.cameras {
        let alone = Rig { cameras: vec![camera.clone()], world_up: rig.world_up };
        let plates = dataset::load_plates(&args.dataset.join("background"), &alone)?;
        let mut viewers = Viewers::new(&PoseNet::embedded()?, &template, &alone, plates, &PoseConfig::default())?;
        let options = FolderOptions { fps: args.rate.fps, ..FolderOptions::default() };
        let sources = FolderReplay::open(&args.dataset, Some(std::slice::from_ref(&camera.id)), &options)?;
        let count = sources.iter().map(|source| source.remaining() as u64).sum();
        let sources = sources.into_iter().map(|source| Box::new(source) as _).collect();
        let mut sets = SetReader::new(sources, &SyncSettings::default());
        let folder = args.out.join(camera.id.as_str());
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
        let bar = progress_bar(count, format!("masks of {}", camera.id));
        let mut found = 0;
        while let Some(set) = sets.next_set()? {
            let masks = viewers.estimate(&set)?.into_iter().flatten().flat_map(|estimate| estimate.masks).flatten();
            for mask in masks {
                let file = folder.join(format!("{:06}.png", frame_number(&set)));
                write_whole(&file, &png::encode_mask(&mask)?)?;
                found += 1;
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        println!("{}: {found} masks of {count} images", camera.id);
    }
    Ok(())
}

//! Training samples of a recorded rig: every camera is held out in turn, the others are the inputs.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use flyrig_gpu::GpuContext;
use flyrig_types::CameraId;

use super::gather::{HeldOut, gather};
use crate::{
    cli::{EvalArgs, LagArgs, NetworkUse, TrainArgs},
    config::{AppearanceMode, Origin, Solver},
    dataset,
    eval::{Replay, progress_bar},
    stop,
};

/// Writes what is missing of a data set's samples into a folder below `out`, and tells which one.
pub fn record(args: &TrainArgs, root: &Path, out: &Path, gpu: &GpuContext) -> Result<PathBuf> {
    let name = root.file_name().map_or_else(|| "dataset".to_owned(), |name| name.to_string_lossy().into_owned());
    let folder = out.join(format!("recorded-{name}"));
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    let rig = dataset::load_rig(root, &[])?;
    let all: Vec<String> = rig.cameras.iter().map(|camera| camera.id.to_string()).collect();
    let cameras = if args.cameras.is_empty() { all } else { args.cameras.clone() };
    ensure!(cameras.len() >= 2, "leaving one camera out needs at least two; {} has {}", root.display(), cameras.len());
    for camera in &cameras {
        if !stop::requested() {
            leave_out(args, root, &cameras, camera, &folder, gpu)
                .with_context(|| format!("leaving camera {camera} of {} out", root.display()))?;
        }
    }
    Ok(folder)
}

fn leave_out(
    args: &TrainArgs,
    root: &Path,
    cameras: &[String],
    left_out: &String,
    folder: &Path,
    gpu: &GpuContext,
) -> Result<()> {
    let done = folder.join(format!("{left_out}.done"));
    if done.exists() {
        return Ok(());
    }
    let mask = root.join("mask").join(CameraId::from(left_out.as_str()).as_str());
    ensure!(mask.is_dir(), "there are no masks of it; write them to {}", mask.display());
    let replay = EvalArgs {
        lags: LagArgs::default(),
        dataset: root.to_owned(),
        inputs: cameras.iter().filter(|camera| *camera != left_out).cloned().collect(),
        holdout: vec![left_out.clone()],
        out: folder.to_owned(),
        pose: args.pose,
        masks: Origin::Given,
        solver: Solver::GaussNewton,
        appearance: AppearanceMode::Direct,
        weights: None,
        networks: NetworkUse::default(),
        frames: None,
        fps: args.fps,
        gaussians: args.gaussians,
        nodes: flyrig_body::DEFAULT_NODE_COUNT,
    };
    let settings = replay.appearance.settings();
    let Replay { mut pipeline, mut frames, buffered, holdout, mut truth } = Replay::open(&replay, gpu)?;
    pipeline.engine_mut().keep_observations()?;
    let bar = progress_bar(frames.count as u64, "recorded");
    let mut buffered = buffered.into_iter();
    let mut index = 0;
    while let Some(set) = buffered.next().map_or_else(|| frames.next_set(), |set| Ok(Some(set)))? {
        if stop::requested() {
            return Ok(());
        }
        pipeline.process(&set)?;
        bar.inc(1);
        index += 1;
        if index % args.every != 0 || pipeline.pose().is_none() {
            continue;
        }
        let frames = truth.at(set.master_nanos)?;
        let held_out: Vec<HeldOut<'_>> = holdout
            .iter()
            .zip(&frames)
            .filter_map(|(camera, frame)| {
                let frame = (*frame)?;
                Some(HeldOut { camera, image: &frame.image, mask: frame.mask.as_ref()? })
            })
            .collect();
        let sample = gather(pipeline.engine(), &held_out, &settings, args.seed ^ index)?;
        sample.save(&folder.join(format!("{left_out}-{index:06}.safetensors")))?;
    }
    bar.finish_and_clear();
    crate::report::write_whole(&done, b"")
}

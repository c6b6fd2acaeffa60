//! Training samples of a recorded rig: every camera is held out in turn, the others are the inputs.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, ensure};
use flyrig_fusion::{BodySettings, PerceptionSettings, SessionSettings};
use flyrig_gpu::GpuContext;
use flyrig_report::{progress_bar, stop, write_whole};
use flyrig_takes::{Replay, ReplaySettings, dataset};
use flyrig_types::CameraId;

use super::{
    TrainArgs,
    gather::{HeldOut, gather},
};

/// Writes the missing samples of a data set to a folder below `out`, and returns the folder.
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
    let settings = ReplaySettings {
        dataset: root.to_owned(),
        inputs: cameras.iter().filter(|camera| *camera != left_out).cloned().collect(),
        holdout: vec![left_out.clone()],
        session: SessionSettings {
            perception: PerceptionSettings { pose: args.pose, ..PerceptionSettings::given() },
            body: BodySettings { gaussians: args.gaussians, ..BodySettings::default() },
            ..SessionSettings::default()
        },
        fps: args.fps,
        frames: None,
        lags_nanos: BTreeMap::new(),
        true_masks: false,
        true_joints: Vec::new(),
        body: None,
    };
    let appearance = settings.session.appearance.mode.settings();
    let mut replay = Replay::open(&settings, gpu)?;
    replay.session.keep_observations()?;
    let bar = progress_bar(replay.count as u64, "recorded");
    let mut index = 0;
    while let Some(set) = replay.next_set()? {
        if stop::requested() {
            return Ok(());
        }
        replay.session.process(&set)?;
        bar.inc(1);
        index += 1;
        if index % args.every != 0 || !replay.session.has_people() {
            continue;
        }
        let frames = replay.truth.at(set.master_nanos)?;
        let held_out: Vec<HeldOut<'_>> = replay
            .holdout
            .iter()
            .zip(&frames)
            .filter_map(|(camera, frame)| {
                let frame = (*frame)?;
                Some(HeldOut { camera, image: &frame.image, mask: frame.mask.as_ref()? })
            })
            .collect();
        let sample = gather(&replay.session, &held_out, &appearance, args.seed ^ index)?;
        sample.save(&folder.join(format!("{left_out}-{index:06}.safetensors")))?;
    }
    bar.finish_and_clear();
    write_whole(&done, b"")
}

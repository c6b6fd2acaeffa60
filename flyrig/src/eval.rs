//! `flyrig eval`: replay a data set in order, as live, render the cameras that were held out, score them.

use std::{path::Path, time::Instant};

use anyhow::{Context, Result, bail, ensure};
use flyrig_body::{ShapeParams, Template, default_template, load_gltf, write_mesh_ply};
use flyrig_calib::{SyncConfig, Synchronizer};
use flyrig_capture::{CameraSource, CaptureErrorKind, FolderOptions, FolderReplay};
use flyrig_gpu::GpuContext;
use flyrig_tracker::{PoseConfig, PoseEstimator, PoseNet};
use flyrig_types::{Camera, CameraId, Frame, FrameSet, Rig};
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    cli::EvalArgs,
    config::{AppearanceMode, Origin, Solver},
    dataset,
    engine::{Engine, RenderedView},
    outlines::outlined_inputs,
    pipeline::{Counts, Outcome, Pipeline, PoseSource},
    png,
    report::{ContactRow, Curve, Report, write_whole},
    score::{CameraScore, FrameScore, ScoreSheet, contact_pictures, error_parts, score_view},
    stats::StageSummary,
};

/// Every so many frames the tracked surface is written.
const SURFACE_EVERY: u64 = 10;
/// Frame sets that the pose estimator sees before the first is processed, to learn the person's shape.
const SHAPE_SETS: usize = 8;
/// Rows of the report's contact sheet.
const CONTACT_ROWS: usize = 4;

/// `metrics.json`.
#[derive(Debug, Serialize)]
struct Metrics<'a> {
    dataset: String,
    inputs: &'a [String],
    holdout: &'a [String],
    pose: Origin,
    masks: Origin,
    solver: Solver,
    appearance: AppearanceMode,
    gaussians: usize,
    nodes: usize,
    adapter: String,
    frames: usize,
    seconds: f64,
    /// "mask": on black inside the held-out mask's box; "own silhouette": composited over the held-out picture
    /// inside the box of our own silhouette, because the data set has no mask of that camera.
    reference: &'static str,
    mean: Option<CameraScore>,
    cameras: Vec<CameraScore>,
    per_frame: &'a [FrameScore],
    counts: Counts,
    sync: serde_json::Value,
    stages: Vec<StageSummary>,
}

/// Runs the command.
pub fn eval(args: &EvalArgs, gpu: &GpuContext) -> Result<()> {
    let started = Instant::now();
    let Replay { mut pipeline, mut frames, buffered, holdout, mut truth } = Replay::open(args, gpu)?;
    std::fs::create_dir_all(args.out.join("surface"))
        .with_context(|| format!("cannot create {}", args.out.display()))?;
    for camera in &holdout {
        let folder = args.out.join(camera.id.as_str());
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    }

    let total = frames.count as u64;
    let bar = progress_bar(total, "eval");
    let mut sheet = ScoreSheet::default();
    let mut contact = Vec::new();
    let contact_every = (total / CONTACT_ROWS as u64).max(1);
    let mut processed = 0u64;
    let mut buffered = buffered.into_iter();
    while let Some(set) = buffered.next().map_or_else(|| frames.next_set(), |set| Ok(Some(set)))? {
        let number = frame_number(&set);
        match pipeline.process(&set)? {
            Outcome::Updated => {}
            Outcome::Held(reason) => {
                tracing::warn!(frame = number, %reason, "frame not used");
                if pipeline.pose().is_none() {
                    bar.inc(1);
                    continue;
                }
            }
        }
        let views: Vec<RenderedView> = holdout.iter().map(|camera| pipeline.render(camera)).collect::<Result<_>>()?;
        if let (Some(pose), 0) = (pipeline.pose(), number % SURFACE_EVERY) {
            let engine = pipeline.engine();
            let (positions, normals) = engine.surface(pose);
            let path = args.out.join(format!("surface/{number:06}.ply"));
            write_mesh_ply(&path, &positions, &normals, &engine.template().triangles, &[])?;
        }
        let truths = truth.at(set.master_nanos)?;
        let jobs: Vec<_> = holdout.iter().zip(&views).zip(&truths).collect();
        let scores: Vec<Option<FrameScore>> = jobs
            .into_par_iter()
            .map(|((camera, view), truth)| {
                png::write_view(&args.out.join(camera.id.as_str()).join(format!("{number:06}.png")), view)?;
                match truth {
                    Some(truth) => {
                        let mut score = score_view(&camera.id, number, view, &truth.image, truth.mask.as_ref())?;
                        if let (Some(score), Some(mask)) = (&mut score, &truth.mask) {
                            score.parts = error_parts(view, &truth.image, mask)?;
                        }
                        Ok(score)
                    }
                    None => Ok(None),
                }
            })
            .collect::<Result<_>>()?;
        sheet.extend(scores.into_iter().flatten());
        if processed % contact_every == contact_every / 2 && contact.len() < 2 * CONTACT_ROWS {
            contact.push(contact_row(number, &holdout, &views, &truths)?);
            let pictures = outlined_inputs(&mut pipeline)?;
            contact.push(ContactRow { label: format!("frame {number}, inputs"), pictures });
        }
        processed += 1;
        bar.set_message(sheet.progress());
        bar.inc(1);
    }
    bar.finish_and_clear();
    ensure!(processed > 0, "no frame of {} could be used; run with -v to see why", args.dataset.display());

    let cameras = sheet.per_camera();
    let seconds = started.elapsed().as_secs_f64();
    let metrics = Metrics {
        dataset: args.dataset.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned()),
        inputs: &args.inputs,
        holdout: &args.holdout,
        pose: args.pose,
        masks: args.masks,
        solver: args.solver,
        appearance: args.appearance,
        gaussians: args.gaussians,
        nodes: args.nodes,
        adapter: gpu.adapter_name(),
        frames: processed as usize,
        seconds,
        reference: sheet.reference(),
        mean: sheet.mean(),
        cameras: cameras.clone(),
        per_frame: sheet.frames(),
        counts: pipeline.counts.clone(),
        sync: frames.sync_summary(),
        stages: pipeline.stages.summary(),
    };
    write_whole(&args.out.join("metrics.json"), &serde_json::to_vec_pretty(&metrics)?)?;
    contact.retain(|row| !row.pictures.is_empty());
    let report = Report {
        title: format!("flyrig eval: {}", metrics.dataset),
        facts: vec![
            ("adapter".to_owned(), metrics.adapter.clone()),
            ("inputs, held out".to_owned(), format!("{} → {}", args.inputs.join(" "), args.holdout.join(" "))),
            (
                "pose, masks, deformation, appearance".to_owned(),
                format!("{:?}, {:?}, {:?}, {:?}", args.pose, args.masks, args.solver, args.appearance),
            ),
            ("Gaussians, nodes".to_owned(), format!("{}, {}", args.gaussians, args.nodes)),
            ("lags taken off, ms".to_owned(), listed(&args.lags.by_camera)),
            ("frames".to_owned(), format!("{processed} in {seconds:.1} s, writing and scoring included")),
            ("scored against".to_owned(), metrics.reference.to_owned()),
        ],
        scores: vec![("Held-out cameras".to_owned(), cameras.into_iter().chain(sheet.mean()).collect())],
        stages: metrics.stages.clone(),
        curves: vec![Curve {
            title: "PSNR over frames".to_owned(),
            x_label: "frame".to_owned(),
            y_label: "dB".to_owned(),
            lines: sheet.curves(),
        }],
        contact,
    };
    report.save(&args.out.join("index.html"))?;
    print!("{}", sheet.table());
    println!();
    print!("{}", pipeline.stages.table());
    println!("\n{processed} frames in {seconds:.1} s; pictures and report in {}", args.out.display());
    Ok(())
}

/// A data set about to be replayed.
pub struct Replay {
    pub pipeline: Pipeline,
    pub frames: FrameReader,
    /// Sets that were read already, to learn the person's shape.
    pub buffered: Vec<FrameSet>,
    pub holdout: Vec<Camera>,
    pub truth: TruthReader,
}

impl Replay {
    /// Opens the cameras and makes the pipeline.
    pub fn open(args: &EvalArgs, gpu: &GpuContext) -> Result<Self> {
        let (rig, holdout) = load_rigs(args)?;
        let mut frames = FrameReader::open(args, &rig)?;
        let truth = TruthReader::open(args, &holdout)?;
        let plates = dataset::plates(&args.dataset, &rig)?;
        dataset::require_masks(args.pose, args.masks, &plates)?;
        let mut buffered = Vec::new();
        let (template, pose) = match args.pose {
            Origin::Given => given_pose(&args.dataset)?,
            Origin::Estimated => {
                eprintln!("eval: learning the person's shape from the first {SHAPE_SETS} frames");
                while buffered.len() < SHAPE_SETS {
                    match frames.next_set()? {
                        Some(set) => buffered.push(set),
                        None => break,
                    }
                }
                let config = PoseConfig { masks: args.masks == Origin::Estimated, ..PoseConfig::default() };
                let mut estimator = PoseEstimator::new(
                    PoseNet::embedded()?,
                    &default_template(&ShapeParams::default())?,
                    &rig,
                    config,
                )?;
                dataset::set_plates(&mut estimator, &plates)?;
                let fit = estimator.fit_shape(&buffered).context("no person found in the first frames")?;
                eprintln!("eval: the person is {:.2} m tall", fit.height_m);
                (estimator.template().clone(), PoseSource::Estimator(Box::new(estimator)))
            }
        };
        let mut engine = Engine::new(
            gpu.clone(),
            template,
            args.gaussians,
            args.nodes,
            &rig,
            args.appearance.settings(),
            args.solver.options(args.pose),
        )?;
        if let Some(networks) = args.appearance.networks(args.weights.as_deref())? {
            engine.use_networks(&networks, args.networks)?;
        }
        let pipeline = Pipeline::new(engine, rig, pose, args.masks, plates);
        Ok(Self { pipeline, frames, buffered, holdout, truth })
    }
}

fn load_rigs(args: &EvalArgs) -> Result<(Rig, Vec<Camera>)> {
    let chosen: Vec<CameraId> = args.inputs.iter().chain(&args.holdout).map(|name| name.as_str().into()).collect();
    let all = dataset::load_rig(&args.dataset, &chosen)?;
    let whose = format!("the calibration of {}", args.dataset.display());
    let (rig, holdout) = (dataset::pick(&all, &args.inputs, &whose)?, dataset::pick(&all, &args.holdout, &whose)?);
    let used = Rig { cameras: rig.cameras.iter().chain(&holdout.cameras).cloned().collect(), world_up: all.world_up };
    dataset::pick(&used, &args.lags.cameras(), "--inputs or --holdout, but in --lag")?;
    if let Some(both) = args.inputs.iter().find(|name| args.holdout.contains(name)) {
        bail!("camera {both} is both an input and held out; scores would flatter");
    }
    Ok((rig, holdout.cameras))
}

/// Template and pose track of the data set's glTF file.
fn given_pose(root: &Path) -> Result<(Template, PoseSource)> {
    let file = dataset::gltf_file(root)?;
    let human = load_gltf(&file)?;
    let track = human.track.with_context(|| format!("{} holds no animation; use --pose estimated", file.display()))?;
    Ok((human.template, PoseSource::Track { track, repeat: false }))
}

/// Reads the input cameras frame by frame and forms sets; a broken picture is missing from its set.
pub struct FrameReader {
    sources: Vec<FolderReplay>,
    sync: Synchronizer,
    ready: std::collections::VecDeque<FrameSet>,
    done: bool,
    pub count: usize,
    broken: u64,
}

impl FrameReader {
    fn open(args: &EvalArgs, rig: &Rig) -> Result<Self> {
        let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
        let options =
            FolderOptions { fps: args.fps, frames: args.frames.clone(), with_masks: args.masks == Origin::Given };
        let sources = FolderReplay::open(&args.dataset, Some(&ids), &options)?;
        let count = sources.iter().map(FolderReplay::remaining).max().unwrap_or(0);
        let config = SyncConfig {
            window_nanos: Some(half_period_nanos(args)),
            lags_nanos: args.lags.nanos(),
            ..SyncConfig::default()
        };
        Ok(Self {
            sources,
            sync: Synchronizer::new(&ids, &config),
            ready: Default::default(),
            done: false,
            count,
            broken: 0,
        })
    }

    pub fn next_set(&mut self) -> Result<Option<FrameSet>> {
        while self.ready.is_empty() && !self.done {
            let mut ended = 0;
            for source in &mut self.sources {
                match next_frame(source) {
                    Ok(Some(frame)) => self.ready.extend(self.sync.push(frame)),
                    Ok(None) => ended += 1,
                    Err(error) if error.kind == CaptureErrorKind::Corrupt => {
                        self.broken += 1;
                        tracing::warn!("{error}; going on without it");
                    }
                    Err(error) => return Err(error.into()),
                }
            }
            if ended == self.sources.len() {
                self.done = true;
                self.ready.extend(self.sync.flush());
            }
        }
        Ok(self.ready.pop_front())
    }

    fn sync_summary(&self) -> serde_json::Value {
        let counts = self.sync.counts();
        serde_json::json!({ "complete": counts.complete, "partial": counts.partial, "broken_pictures": self.broken })
    }
}

/// The next frame of a folder; `None` at its end.
fn next_frame(source: &mut FolderReplay) -> Result<Option<Frame>, flyrig_capture::CaptureError> {
    match source.next_frame(std::time::Duration::ZERO) {
        Ok(frame) => Ok(Some(frame)),
        Err(error) if error.kind == CaptureErrorKind::EndOfStream => Ok(None),
        Err(error) => Err(error),
    }
}

/// Reads the held-out cameras alongside, never ahead of what is scored.
pub struct TruthReader {
    /// With what is taken off the stamps, nanoseconds, and the frame of the last time.
    sources: Vec<(FolderReplay, i64, Option<Frame>)>,
    window_nanos: u64,
}

impl TruthReader {
    fn open(args: &EvalArgs, holdout: &[Camera]) -> Result<Self> {
        let ids: Vec<CameraId> = holdout.iter().map(|camera| camera.id.clone()).collect();
        let with_masks = ids.iter().all(|id| args.dataset.join("mask").join(id.as_str()).is_dir());
        let options = FolderOptions { fps: args.fps, frames: args.frames.clone(), with_masks };
        let sources = FolderReplay::open(&args.dataset, Some(&ids), &options)?;
        let lags = args.lags.nanos();
        let lag = |id: &CameraId| lags.get(id).copied().unwrap_or_default();
        let sources = sources.into_iter().zip(&ids).map(|(source, id)| (source, lag(id), None)).collect();
        Ok(Self { sources, window_nanos: half_period_nanos(args) })
    }

    /// Per held-out camera the frame nearest in time, within half a frame period.
    pub fn at(&mut self, nanos: i64) -> Result<Vec<Option<&Frame>>> {
        for (source, lag, current) in &mut self.sources {
            let earliest = nanos.saturating_sub_unsigned(self.window_nanos);
            while current.as_ref().is_none_or(|frame| frame.capture_nanos < earliest) {
                match next_frame(source) {
                    Ok(Some(frame)) => {
                        *current = Some(Frame { capture_nanos: frame.capture_nanos.saturating_sub(*lag), ..frame });
                    }
                    Ok(None) => break,
                    Err(error) if error.kind == CaptureErrorKind::Corrupt => {
                        tracing::warn!("held-out {error}; that frame is not scored");
                    }
                    Err(error) => return Err(error.into()),
                }
            }
        }
        let near = |frame: &&Frame| frame.capture_nanos.abs_diff(nanos) <= self.window_nanos;
        Ok(self.sources.iter().map(|(_, _, frame)| frame.as_ref().filter(near)).collect())
    }
}

/// Cameras and their lags for the report.
fn listed(lags: &[(String, f64)]) -> String {
    let each: Vec<String> = lags.iter().map(|(camera, lag)| format!("{camera} {lag}")).collect();
    if each.is_empty() { "none".to_owned() } else { each.join(", ") }
}

/// Half of the time from frame to frame: nearer than that a frame's set is unambiguous.
fn half_period_nanos(args: &EvalArgs) -> u64 {
    (0.5e9 / args.fps).ceil() as u64
}

/// Number of a set's frames in the data set's file names.
fn frame_number(set: &FrameSet) -> u64 {
    let at_master = set.present().min_by_key(|(_, frame)| frame.capture_nanos.abs_diff(set.master_nanos));
    at_master.map_or(set.index, |(_, frame)| frame.sequence)
}

fn contact_row(
    number: u64,
    holdout: &[Camera],
    views: &[RenderedView],
    truths: &[Option<&Frame>],
) -> Result<ContactRow> {
    let best = truths.iter().position(Option::is_some).unwrap_or(0);
    let mut pictures = Vec::new();
    let shown = if truths.is_empty() { 0 } else { (best + number as usize) % truths.len() };
    if let (Some(view), Some(Some(truth))) = (views.get(shown), truths.get(shown)) {
        pictures.extend(contact_pictures(&holdout[shown].id, view, &truth.image, truth.mask.as_ref())?);
    }
    Ok(ContactRow { label: format!("frame {number}"), pictures })
}

/// A bar with rate, time left and a message.
pub fn progress_bar(total: u64, what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{prefix} {bar:32} {pos}/{len} {per_sec} {eta} left {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(total).with_style(style).with_prefix(what)
}

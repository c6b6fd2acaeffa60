//! `flyrig eval`: replay a data set in order, as live, render the cameras that were held out, score them.

use std::{
    collections::{BTreeMap, VecDeque},
    ops::Range,
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context, Result, bail, ensure};
use flyrig_body::{ShapeParams, default_template, load_gltf, write_mesh_ply};
use flyrig_capture::{CameraSource, CaptureErrorKind, FolderOptions, FolderReplay};
use flyrig_fusion::{
    AppearanceMode, Counts, EstimatedPerception, GivenPerception, GivenPerson, Origin, Outcome, PersonId, SHAPE_SETS,
    Session, SessionBuilder, SessionSettings, SetReader, Solver, StageSummary, next_frame,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, FrameScore, ScoreSheet, error_parts, score_view};
use flyrig_report::{ContactRow, Curve, Report, contact_pictures, outlined_inputs, png, progress_bar, write_whole};
use flyrig_sync::SyncSettings;
use flyrig_types::{Camera, CameraId, Frame, FrameSet, RenderedView, Rig};
use rayon::prelude::*;
use serde::Serialize;

use crate::{cli::EvalArgs, dataset};

/// Every so many frames the tracked surface is written.
const SURFACE_EVERY: u64 = 10;
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
    let settings = ReplaySettings {
        dataset: args.dataset.clone(),
        inputs: args.inputs.clone(),
        holdout: args.holdout.clone(),
        session: SessionSettings {
            body: args.body.clone(),
            tracking: args.tracking.clone(),
            appearance: args.appearance.clone(),
        },
        fps: args.fps,
        frames: args.frames.clone(),
        lags_nanos: args.lags.nanos(),
    };
    let mut replay = Replay::open(&settings, gpu)?;
    let holdout = replay.holdout.clone();
    std::fs::create_dir_all(args.out.join("surface"))
        .with_context(|| format!("cannot create {}", args.out.display()))?;
    for camera in &holdout {
        let folder = args.out.join(camera.id.as_str());
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    }

    let total = replay.count as u64;
    let bar = progress_bar(total, "eval");
    let mut sheet = ScoreSheet::default();
    let mut contact = Vec::new();
    let contact_every = (total / CONTACT_ROWS as u64).max(1);
    let mut processed = 0u64;
    let person = PersonId::default();
    while let Some(set) = replay.next_set()? {
        let number = frame_number(&set);
        match replay.session.process(&set)? {
            Outcome::Updated => {}
            Outcome::Held(reason) => {
                tracing::warn!(frame = number, %reason, "frame not used");
                if !replay.session.has_people() {
                    bar.inc(1);
                    continue;
                }
            }
        }
        let views: Vec<RenderedView> =
            holdout.iter().map(|camera| replay.session.render(camera)).collect::<Result<_, _>>()?;
        if let (Some(subject), 0) = (replay.session.subject(person), number % SURFACE_EVERY)
            && let Some(pose) = subject.pose()
        {
            let (positions, normals) = subject.surface(pose);
            let path = args.out.join(format!("surface/{number:06}.ply"));
            write_mesh_ply(&path, &positions, &normals, &subject.template().triangles, &[])?;
        }
        let truths = replay.truth.at(set.master_nanos)?;
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
            let pictures = outlined_inputs(&mut replay.session, person)?;
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
        pose: args.body.pose,
        masks: args.body.masks,
        solver: args.tracking.solver,
        appearance: args.appearance.mode,
        gaussians: args.body.gaussians,
        nodes: args.body.nodes,
        adapter: gpu.adapter_name(),
        frames: processed as usize,
        seconds,
        reference: sheet.reference(),
        mean: sheet.mean(),
        cameras: cameras.clone(),
        per_frame: sheet.frames(),
        counts: replay.session.counts.clone(),
        sync: replay.sync_summary(),
        stages: replay.session.stages.summary(),
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
                format!("{:?}, {:?}, {:?}, {:?}", metrics.pose, metrics.masks, metrics.solver, metrics.appearance),
            ),
            ("Gaussians, nodes".to_owned(), format!("{}, {}", metrics.gaussians, metrics.nodes)),
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
    print!("{}", replay.session.stages.table());
    println!("\n{processed} frames in {seconds:.1} s; pictures and report in {}", args.out.display());
    Ok(())
}

/// Settings of a replayed data set.
#[derive(Debug, Clone)]
pub struct ReplaySettings {
    pub dataset: PathBuf,
    pub inputs: Vec<String>,
    pub holdout: Vec<String>,
    pub session: SessionSettings,
    /// Frame rate of the folder.
    pub fps: f64,
    /// All frames where `None`.
    pub frames: Option<Range<u64>>,
    /// Time offsets that are subtracted from the timestamps, nanoseconds.
    pub lags_nanos: BTreeMap<CameraId, i64>,
}

/// A data set that is replayed into a session.
pub struct Replay {
    pub session: Session,
    sets: SetReader,
    /// Number of frames.
    pub count: usize,
    /// Sets that were read already, to learn the person's shape.
    buffered: VecDeque<FrameSet>,
    pub holdout: Vec<Camera>,
    pub truth: TruthReader,
}

impl Replay {
    /// Opens the cameras and builds the session.
    pub fn open(settings: &ReplaySettings, gpu: &GpuContext) -> Result<Self> {
        let (rig, holdout) = load_rigs(settings)?;
        let (mut sets, count) = open_inputs(settings, &rig)?;
        let truth = TruthReader::open(settings, &holdout)?;
        let body = &settings.session.body;
        let plates = dataset::plates(&settings.dataset, &rig)?;
        dataset::require_masks(body.pose, body.masks, &plates)?;
        let builder = SessionBuilder::new(gpu.clone(), rig.clone()).settings(settings.session.clone());
        let mut buffered = VecDeque::new();
        let session = match body.pose {
            Origin::Given => {
                let person = given_person(&settings.dataset)?;
                builder.perception(GivenPerception::new(&rig, vec![person]).with_masks(body.masks, plates))
            }
            Origin::Estimated => {
                eprintln!("eval: learning the person's shape from the first {SHAPE_SETS} frames");
                while buffered.len() < SHAPE_SETS {
                    match sets.next_set()? {
                        Some(set) => buffered.push_back(set),
                        None => break,
                    }
                }
                let template = default_template(&ShapeParams::default())?;
                let mut perception = EstimatedPerception::new(&rig, &template, body.masks, plates)?;
                let fit = perception
                    .learn_shape(buffered.make_contiguous())
                    .context("no person found in the first frames")?;
                eprintln!("eval: the person is {:.2} m tall", fit.height_m);
                builder.perception(perception)
            }
        };
        Ok(Self { session: session.build()?, sets, count, buffered, holdout, truth })
    }

    /// Returns the next set; `None` at the end.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>> {
        match self.buffered.pop_front() {
            Some(set) => Ok(Some(set)),
            None => Ok(self.sets.next_set()?),
        }
    }

    fn sync_summary(&self) -> serde_json::Value {
        let counts = self.sets.counts();
        let damaged = self.sets.damaged();
        serde_json::json!({ "complete": counts.complete, "partial": counts.partial, "broken_pictures": damaged })
    }
}

fn load_rigs(args: &ReplaySettings) -> Result<(Rig, Vec<Camera>)> {
    let chosen: Vec<CameraId> = args.inputs.iter().chain(&args.holdout).map(|name| name.as_str().into()).collect();
    let all = dataset::load_rig(&args.dataset, &chosen)?;
    let whose = format!("the calibration of {}", args.dataset.display());
    let (rig, holdout) = (dataset::pick(&all, &args.inputs, &whose)?, dataset::pick(&all, &args.holdout, &whose)?);
    let used = Rig { cameras: rig.cameras.iter().chain(&holdout.cameras).cloned().collect(), world_up: all.world_up };
    let with_lags: Vec<String> = args.lags_nanos.keys().map(CameraId::to_string).collect();
    dataset::pick(&used, &with_lags, "--inputs or --holdout, but in --lag")?;
    if let Some(both) = args.inputs.iter().find(|name| args.holdout.contains(name)) {
        bail!("camera {both} is both an input and held out; scores would flatter");
    }
    Ok((rig, holdout.cameras))
}

/// The person of the data set's glTF file.
fn given_person(root: &Path) -> Result<GivenPerson> {
    let file = dataset::gltf_file(root)?;
    let human = load_gltf(&file)?;
    let track = human.track.with_context(|| format!("{} holds no animation; use --pose estimated", file.display()))?;
    Ok(GivenPerson { person: PersonId::default(), template: human.template, track, repeat: false })
}

/// Opens the input cameras; returns their number of frames as well.
fn open_inputs(settings: &ReplaySettings, rig: &Rig) -> Result<(SetReader, usize)> {
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let with_masks = settings.session.body.masks == Origin::Given;
    let options = FolderOptions { fps: settings.fps, frames: settings.frames.clone(), with_masks };
    let sources = FolderReplay::open(&settings.dataset, Some(&ids), &options)?;
    let count = sources.iter().map(FolderReplay::remaining).max().unwrap_or(0);
    let sync = SyncSettings {
        window_nanos: Some(half_period_nanos(settings.fps)),
        lags_nanos: settings.lags_nanos.clone(),
        ..SyncSettings::default()
    };
    let sources = sources.into_iter().map(|source| Box::new(source) as Box<dyn CameraSource>).collect();
    Ok((SetReader::new(sources, &sync), count))
}

/// Reads the held-out cameras alongside, never ahead of what is scored.
pub struct TruthReader {
    /// With what is taken off the stamps, nanoseconds, and the frame of the last time.
    sources: Vec<(FolderReplay, i64, Option<Frame>)>,
    window_nanos: u64,
}

impl TruthReader {
    fn open(args: &ReplaySettings, holdout: &[Camera]) -> Result<Self> {
        let ids: Vec<CameraId> = holdout.iter().map(|camera| camera.id.clone()).collect();
        let with_masks = ids.iter().all(|id| args.dataset.join("mask").join(id.as_str()).is_dir());
        let options = FolderOptions { fps: args.fps, frames: args.frames.clone(), with_masks };
        let sources = FolderReplay::open(&args.dataset, Some(&ids), &options)?;
        let lag = |id: &CameraId| args.lags_nanos.get(id).copied().unwrap_or_default();
        let sources = sources.into_iter().zip(&ids).map(|(source, id)| (source, lag(id), None)).collect();
        Ok(Self { sources, window_nanos: half_period_nanos(args.fps) })
    }

    /// Per held-out camera the frame nearest in time, within half a frame period.
    pub fn at(&mut self, nanos: i64) -> Result<Vec<Option<&Frame>>> {
        for (source, lag, current) in &mut self.sources {
            let earliest = nanos.saturating_sub_unsigned(self.window_nanos);
            while current.as_ref().is_none_or(|frame| frame.capture_nanos < earliest) {
                match next_frame(&mut *source) {
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
fn half_period_nanos(fps: f64) -> u64 {
    (0.5e9 / fps).ceil() as u64
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

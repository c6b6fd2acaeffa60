//! `flyrig eval`: replays a data set in order, as live, renders the held-out cameras, and scores the views.

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context, Result, ensure};
use clap::Args;
use flyrig_body::write_mesh_ply;
use flyrig_fusion::{
    AppearanceMode, AppearanceOptions, BodySettings, BudgetSettings, Counts, Origin, Outcome, PersonId, Session,
    SessionSettings, Solver, StageSummary,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, FrameScore, ScoreSheet, error_parts, score_view};
use flyrig_report::{ContactRow, Curve, Report, contact_images, outlined_inputs, png, progress_bar, write_whole};
use flyrig_takes::{Replay, ReplaySettings, frame_number, known_body};
use flyrig_types::{Camera, Frame, RenderedView};
use rayon::prelude::*;
use serde::Serialize;

use crate::arguments::{DatasetArgs, HoldoutArgs};

/// Arguments of `flyrig eval`.
#[derive(Debug, Args)]
pub struct EvalArgs {
    #[command(flatten)]
    pub take: DatasetArgs,
    #[command(flatten)]
    pub holdout: HoldoutArgs,
    /// Folder of images, surfaces and the report.
    #[arg(long)]
    pub out: PathBuf,
    #[command(flatten)]
    pub body: BodySettings,
    /// Avatar of the person (`flyrig avatar build`), from which tracking and colours start.
    #[arg(long, value_name = "FILE")]
    pub avatar: Option<PathBuf>,
    #[command(flatten)]
    pub appearance: AppearanceOptions,
    #[command(flatten)]
    pub budget: BudgetSettings,
}

/// Frame sets from one written surface to the next.
const SURFACE_EVERY: u64 = 10;
/// Number of instants on the report's contact sheet.
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
    /// Avatar that initialized tracking and colours.
    avatar: Option<String>,
    adapter: String,
    frames: usize,
    seconds: f64,
    /// "mask": scored on black inside the box of the held-out mask; "own silhouette": composited over the held-out image
    /// inside the box of the rendered silhouette, because the data set has no mask of that camera.
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
    let mut replay = Replay::open(&replay_settings(args)?, gpu)?;
    let mut evaluation = Evaluation::new(args, replay.count as u64, replay.holdout.clone());
    evaluation.run(&mut replay)?;
    let seconds = started.elapsed().as_secs_f64();
    let mut contact = std::mem::take(&mut evaluation.contact);
    contact.retain(|row| !row.pictures.is_empty());
    let metrics = evaluation.metrics(&replay, seconds);
    write_whole(&args.out.join("metrics.json"), &serde_json::to_vec_pretty(&metrics)?)?;
    let mut report = evaluation.report(&metrics, contact);
    report.facts.extend(replay.session.upright_fault().map(|fault| ("up".to_owned(), fault)));
    report.save(&args.out.join("index.html"))?;
    print!("{}", evaluation.sheet.table());
    println!();
    print!("{}", replay.session.stages.table());
    println!("\n{} frames in {seconds:.1} s; images and report in {}", evaluation.processed, args.out.display());
    Ok(())
}

fn replay_settings(args: &EvalArgs) -> Result<ReplaySettings> {
    let body = BodySettings { avatar: args.avatar.clone().unwrap_or_default(), ..args.body.clone() };
    let known = known_body(&body, false)?;
    Ok(ReplaySettings {
        dataset: args.take.dataset.clone(),
        inputs: args.take.inputs.clone(),
        holdout: args.holdout.holdout.clone(),
        session: SessionSettings {
            perception: args.take.perception.clone(),
            body,
            tracking: args.take.tracking.clone(),
            appearance: args.appearance.clone(),
            budget: args.budget,
        },
        fps: args.take.rate.fps,
        frames: args.take.range.frames.clone(),
        lags_nanos: args.take.lags.nanos(),
        true_masks: false,
        true_joints: Vec::new(),
        body: known,
    })
}

/// Scores and images of a data set, collected frame by frame.
struct Evaluation<'a> {
    args: &'a EvalArgs,
    /// Number of frame sets in the data set.
    total: u64,
    holdout: Vec<Camera>,
    sheet: ScoreSheet,
    contact: Vec<ContactRow>,
    /// Number of scored frame sets.
    processed: u64,
}

impl<'a> Evaluation<'a> {
    fn new(args: &'a EvalArgs, total: u64, holdout: Vec<Camera>) -> Self {
        Self { args, total, holdout, sheet: ScoreSheet::default(), contact: Vec::new(), processed: 0 }
    }

    /// Processes all frame sets, and writes the rendered views and tracked surfaces.
    fn run(&mut self, replay: &mut Replay) -> Result<()> {
        self.create_folders()?;
        let bar = progress_bar(self.total, "eval");
        while let Some(set) = replay.next_set()? {
            let number = frame_number(&set);
            if let Outcome::Held(reason) = replay.session.process(&set)? {
                tracing::warn!(frame = number, %reason, "frame not used");
                if !replay.session.has_people() {
                    bar.inc(1);
                    continue;
                }
            }
            self.score_set(replay, set.master_nanos, number)?;
            bar.set_message(self.sheet.progress());
            bar.inc(1);
        }
        bar.finish_and_clear();
        let dataset = self.args.take.dataset.display();
        ensure!(self.processed > 0, "no frame of {dataset} could be used; run with -v to see why");
        Ok(())
    }

    fn create_folders(&self) -> Result<()> {
        let out = &self.args.out;
        std::fs::create_dir_all(out.join("surface")).with_context(|| format!("cannot create {}", out.display()))?;
        for camera in &self.holdout {
            let folder = out.join(camera.id.as_str());
            std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
        }
        Ok(())
    }

    /// Renders, writes and scores the held-out views of the frame set with this time and number.
    fn score_set(&mut self, replay: &mut Replay, nanos: i64, number: u64) -> Result<()> {
        let views: Vec<RenderedView> =
            self.holdout.iter().map(|camera| replay.session.render(camera)).collect::<Result<_, _>>()?;
        if number.is_multiple_of(SURFACE_EVERY) {
            self.write_surface(&replay.session, number)?;
        }
        let truths = replay.truth.at(nanos)?;
        let jobs: Vec<_> = self.holdout.iter().zip(&views).zip(&truths).collect();
        let out = &self.args.out;
        let scores: Vec<Option<FrameScore>> = jobs
            .into_par_iter()
            .map(|((camera, view), truth)| write_and_score(out, number, camera, view, *truth))
            .collect::<Result<_>>()?;
        self.sheet.extend(scores.into_iter().flatten());
        let contact_every = (self.total / CONTACT_ROWS as u64).max(1);
        if self.processed % contact_every == contact_every / 2 && self.contact.len() < 2 * CONTACT_ROWS {
            self.contact.push(contact_row(number, &self.holdout, &views, &truths)?);
            let pictures = outlined_inputs(&mut replay.session, PersonId::default())?;
            self.contact.push(ContactRow { label: format!("frame {number}, inputs"), pictures });
        }
        self.processed += 1;
        Ok(())
    }

    fn write_surface(&self, session: &Session, number: u64) -> Result<()> {
        let Some(subject) = session.subject(PersonId::default()) else { return Ok(()) };
        let Some(pose) = subject.pose() else { return Ok(()) };
        let (positions, normals) = subject.surface(pose);
        let path = self.args.out.join(format!("surface/{number:06}.ply"));
        Ok(write_mesh_ply(&path, &positions, &normals, &subject.template().triangles, &[])?)
    }

    fn metrics(&self, replay: &Replay, seconds: f64) -> Metrics<'_> {
        let args = self.args;
        Metrics {
            dataset: args.take.dataset.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned()),
            inputs: &args.take.inputs,
            holdout: &args.holdout.holdout,
            pose: args.take.perception.pose,
            masks: args.take.perception.masks,
            solver: args.take.tracking.solver,
            appearance: args.appearance.mode,
            gaussians: args.body.gaussians,
            nodes: args.body.nodes,
            avatar: args.avatar.as_ref().map(|path| path.display().to_string()),
            adapter: replay.session.gpu().adapter_name(),
            frames: self.processed as usize,
            seconds,
            reference: self.sheet.reference(),
            mean: self.sheet.mean(),
            cameras: self.sheet.per_camera(),
            per_frame: self.sheet.frames(),
            counts: replay.session.counts.clone(),
            sync: replay.sync_summary(),
            stages: replay.session.stages.summary(),
        }
    }

    fn report(&self, metrics: &Metrics<'_>, contact: Vec<ContactRow>) -> Report {
        let args = self.args;
        let facts = [
            ("adapter", metrics.adapter.clone()),
            ("inputs, held out", format!("{} → {}", args.take.inputs.join(" "), args.holdout.holdout.join(" "))),
            (
                "pose, masks, deformation, appearance",
                format!("{:?}, {:?}, {:?}, {:?}", metrics.pose, metrics.masks, metrics.solver, metrics.appearance),
            ),
            ("Gaussians, nodes", format!("{}, {}", metrics.gaussians, metrics.nodes)),
            ("time offsets subtracted, ms", listed(&args.take.lags.by_camera)),
            ("frames", format!("{} in {:.1} s, writing and scoring included", self.processed, metrics.seconds)),
            ("scored against", metrics.reference.to_owned()),
        ];
        Report {
            title: format!("flyrig eval: {}", metrics.dataset),
            facts: facts.map(|(name, value)| (name.to_owned(), value)).to_vec(),
            scores: vec![(
                "Held-out cameras".to_owned(),
                metrics.cameras.iter().chain(&metrics.mean).cloned().collect(),
            )],
            stages: metrics.stages.clone(),
            curves: vec![Curve {
                title: "PSNR over frames".to_owned(),
                x_label: "frame".to_owned(),
                y_label: "dB".to_owned(),
                lines: self.sheet.curves(),
            }],
            contact,
            ..Report::default()
        }
    }
}

/// Writes a rendered view and scores it against the held-out image, if there is one.
fn write_and_score(
    out: &Path,
    number: u64,
    camera: &Camera,
    view: &RenderedView,
    truth: Option<&Frame>,
) -> Result<Option<FrameScore>> {
    png::write_view(&out.join(camera.id.as_str()).join(format!("{number:06}.png")), view)?;
    let Some(truth) = truth else { return Ok(None) };
    let mut score = score_view(&camera.id, number, view, &truth.image, truth.mask.as_ref())?;
    if let (Some(score), Some(mask)) = (&mut score, &truth.mask) {
        score.parts = error_parts(view, &truth.image, mask)?;
    }
    Ok(score)
}

/// Formats time offsets for the report, milliseconds.
fn listed(lags: &[(String, f64)]) -> String {
    let each: Vec<String> = lags.iter().map(|(camera, lag)| format!("{camera} {lag}")).collect();
    if each.is_empty() { "none".to_owned() } else { each.join(", ") }
}

/// Builds a row of the contact sheet from one of the held-out cameras, another one for every row.
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
        pictures.extend(contact_images(&holdout[shown].id, view, &truth.image, truth.mask.as_ref())?);
    }
    Ok(ContactRow { label: format!("frame {number}"), pictures })
}

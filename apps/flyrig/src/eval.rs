//! `flyrig eval`: replay a data set in order, as live, render the cameras that were held out, score them.

use std::{path::PathBuf, time::Instant};

use anyhow::{Context, Result, ensure};
use clap::Args;
use flyrig_body::write_mesh_ply;
use flyrig_fusion::{
    AppearanceMode, AppearanceOptions, BodySettings, BudgetSettings, Counts, Origin, Outcome, PersonId,
    SessionSettings, Solver, StageSummary,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, FrameScore, ScoreSheet, error_parts, score_view};
use flyrig_report::{
    ContactRow, Curve, Replay, ReplaySettings, Report, contact_images, frame_number, known_body, outlined_inputs, png,
    progress_bar, write_whole,
};
use flyrig_types::{Camera, Frame, RenderedView};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    arguments::{DatasetArgs, HoldoutArgs},
    recording,
};

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
    /// File that tracking and colours started from.
    avatar: Option<String>,
    adapter: String,
    frames: usize,
    seconds: f64,
    /// "mask": on black inside the held-out mask's box; "own silhouette": composited over the held-out image
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
    let body = BodySettings { avatar: args.avatar.clone().unwrap_or_default(), ..args.body.clone() };
    let settings = ReplaySettings {
        dataset: args.take.dataset.clone(),
        recorded: recording::rig_of_take(&args.take.dataset)?,
        inputs: args.take.inputs.clone(),
        holdout: args.holdout.holdout.clone(),
        session: SessionSettings {
            perception: args.take.perception.clone(),
            body: body.clone(),
            tracking: args.take.tracking.clone(),
            appearance: args.appearance.clone(),
            budget: args.budget,
        },
        fps: args.take.rate.fps,
        frames: args.take.range.frames.clone(),
        lags_nanos: args.take.lags.nanos(),
        true_masks: false,
        true_joints: Vec::new(),
        body: known_body(&body, false)?,
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
            Outcome::Updated | Outcome::Still => {}
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
    ensure!(processed > 0, "no frame of {} could be used; run with -v to see why", args.take.dataset.display());

    let cameras = sheet.per_camera();
    let seconds = started.elapsed().as_secs_f64();
    let metrics = Metrics {
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
            (
                "inputs, held out".to_owned(),
                format!("{} → {}", args.take.inputs.join(" "), args.holdout.holdout.join(" ")),
            ),
            (
                "pose, masks, deformation, appearance".to_owned(),
                format!("{:?}, {:?}, {:?}, {:?}", metrics.pose, metrics.masks, metrics.solver, metrics.appearance),
            ),
            ("Gaussians, nodes".to_owned(), format!("{}, {}", metrics.gaussians, metrics.nodes)),
            ("lags taken off, ms".to_owned(), listed(&args.take.lags.by_camera)),
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
        ..Report::default()
    };
    report.save(&args.out.join("index.html"))?;
    print!("{}", sheet.table());
    println!();
    print!("{}", replay.session.stages.table());
    println!("\n{processed} frames in {seconds:.1} s; images and report in {}", args.out.display());
    Ok(())
}

/// Cameras and their lags for the report.
fn listed(lags: &[(String, f64)]) -> String {
    let each: Vec<String> = lags.iter().map(|(camera, lag)| format!("{camera} {lag}")).collect();
    if each.is_empty() { "none".to_owned() } else { each.join(", ") }
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
        pictures.extend(contact_images(&holdout[shown].id, view, &truth.image, truth.mask.as_ref())?);
    }
    Ok(ContactRow { label: format!("frame {number}"), pictures })
}

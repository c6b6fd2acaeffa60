//! `flyrig-bench scale`: run time and error over pixels, input cameras and Gaussians, each by itself, and with the most pixels and
//! cameras.

use std::{fmt::Write as _, time::Instant};

use anyhow::{Context, Result};
use clap::{Args, builder::TypedValueParser as _};
use flyrig_body::{ShapeParams, default_template};
use flyrig_fusion::{
    BodySettings, EstimatedPerception, GivenPerception, Origin, PerceptionSettings, SHAPE_SETS, Session,
    SessionBuilder, SessionSettings,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_report::{
    arguments::OutputArgs,
    plot::{Line, Plot, Series},
    progress_bar, write_whole,
};
use serde::Serialize;

use crate::harness::{
    sequence::{SequenceConfig, SequenceMotion, SimulatedSequence},
    statistics::exponent,
};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-scale")))]
pub struct BenchScaleArgs {
    /// Pose and masks from the simulator, or from the images.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Seed of the person.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Frames of a sequence; the first twelve are neither timed nor scored.
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u16).range(13..=1000).map(usize::from))]
    pub frames: usize,
    /// Widths and heights of the images, pixels, comma separated. Rows that vary something else use the first.
    #[arg(long, value_delimiter = ',', default_value = "512,256,1024,1440", value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub sides: Vec<u32>,
    /// Numbers of input cameras, comma separated. Rows that vary something else use the first.
    #[arg(long, value_delimiter = ',', default_value = "3,2,4,6", value_parser = clap::value_parser!(u8).range(1..=6).map(usize::from))]
    pub views: Vec<usize>,
    /// Numbers of Gaussians on the person's surface, comma separated. Rows that vary something else use the first.
    #[arg(long, value_delimiter = ',', default_value = "115000,29000,58000,230000", value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: Vec<usize>,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Frame sets that are neither timed nor scored: the first ones get more work.
const WARM_UP: u64 = 12;
/// Stage of an estimated person: network, masks and fits, without mattes and backgrounds.
const POSE: &str = "pose from images";

/// Quantity that is varied.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum Axis {
    Pixels,
    Views,
    Gaussians,
}

/// Size of the input and of the person.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
struct Size {
    side: u32,
    views: usize,
    gaussians: usize,
}

/// Run times and scores of a size.
#[derive(Debug, Serialize)]
struct Row {
    /// Axes of which this size is a point; none with the most pixels and cameras.
    axes: Vec<Axis>,
    size: Size,
    /// Mean milliseconds of the estimated pose with its masks, of the rest of a frame set, and of a view with the size of the images.
    pose_ms: f64,
    rest_ms: f64,
    view_ms: f64,
    score: CameraScore,
}

/// Runs the command.
pub fn scale(args: &BenchScaleArgs, gpu: &GpuContext) -> Result<()> {
    args.output.create()?;
    let sizes = sizes(args)?;
    let bar = progress_bar(sizes.len() as u64, "bench scale");
    let mut sequence: Option<SimulatedSequence> = None;
    let mut rows = Vec::new();
    for (axes, size) in sizes {
        bar.set_message(format!("{}², {} cameras, {} Gaussians", size.side, size.views, size.gaussians));
        let config = SequenceConfig {
            motion: SequenceMotion::Turn,
            seed: args.seed,
            side: size.side,
            frames: args.frames,
            fps: 30.0,
        };
        let scene = match sequence.take().filter(|known| known.config() == config) {
            Some(known) => known,
            None => SimulatedSequence::simulate(gpu, config)?,
        };
        rows.push(run(args.pose, gpu, &scene, axes, size)?);
        sequence = Some(scene);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let table = table(&rows);
    write_whole(&args.output.out.join("scale.md"), table.as_bytes())?;
    write_whole(&args.output.out.join("scale.json"), &serde_json::to_vec_pretty(&rows)?)?;
    write_whole(&args.output.out.join("scale.svg"), plot(&rows).svg().as_bytes())?;
    print!("{table}");
    println!("{}; scale.md, .json and .svg in {}", gpu.fastest().adapter_name(), args.output.out.display());
    Ok(())
}

/// Returns the sizes, those of one image size in succession so that a sequence is simulated once.
fn sizes(args: &BenchScaleArgs) -> Result<Vec<(Vec<Axis>, Size)>> {
    let first = |known: Option<usize>, what| known.with_context(|| format!("--{what} needs a number"));
    let base = Size {
        side: *args.sides.first().context("--sides needs a number")?,
        views: first(args.views.first().copied(), "views")?,
        gaussians: first(args.gaussians.first().copied(), "gaussians")?,
    };
    let mut sizes: Vec<(Vec<Axis>, Size)> = Vec::new();
    let mut add = |axis, size| match sizes.iter_mut().find(|(_, known)| *known == size) {
        Some((axes, _)) => axes.push(axis),
        None => sizes.push((vec![axis], size)),
    };
    args.views.iter().for_each(|&views| add(Axis::Views, Size { views, ..base }));
    args.gaussians.iter().for_each(|&gaussians| add(Axis::Gaussians, Size { gaussians, ..base }));
    args.sides.iter().for_each(|&side| add(Axis::Pixels, Size { side, ..base }));
    let most = Size {
        side: args.sides.iter().copied().fold(base.side, u32::max),
        views: args.views.iter().copied().fold(base.views, usize::max),
        ..base
    };
    if !sizes.iter().any(|(_, known)| *known == most) {
        sizes.push((Vec::new(), most));
    }
    Ok(sizes)
}

fn session(pose: Origin, gpu: &GpuContext, sequence: &SimulatedSequence, size: Size) -> Result<Session> {
    let rig = sequence.inputs(size.views);
    let settings = SessionSettings { body: BodySettings::with_gaussians(size.gaussians), ..SessionSettings::default() };
    let builder = SessionBuilder::new(gpu.clone(), rig.clone()).settings(settings);
    if pose == Origin::Given {
        let perception = GivenPerception::repeating(&rig, sequence.template.clone(), sequence.track.clone());
        return Ok(builder.perception(perception).build()?);
    }
    let template = default_template(&ShapeParams::default())?;
    let settings = PerceptionSettings::default();
    let mut perception = EstimatedPerception::new(&rig, &template, &settings, &sequence.plates(size.views)?)?;
    let every = (sequence.config().frames / SHAPE_SETS).max(1);
    let sets: Vec<_> = sequence.sets(size.views).step_by(every).take(SHAPE_SETS).collect();
    perception.learn_shapes(&sets)?;
    Ok(builder.perception(perception).build()?)
}

fn run(pose: Origin, gpu: &GpuContext, sequence: &SimulatedSequence, axes: Vec<Axis>, size: Size) -> Result<Row> {
    let mut session = session(pose, gpu, sequence, size)?;
    let (mut set_ms, mut pose_ms, mut view_ms, mut count) = (0.0, 0.0, 0.0, 0.0);
    let mut sheet = ScoreSheet::default();
    for set in sequence.sets(size.views) {
        let (start, before) = (Instant::now(), session.stages.total_ms(POSE));
        session.process(&set)?;
        if set.index < WARM_UP {
            continue;
        }
        set_ms += 1e3 * start.elapsed().as_secs_f64();
        pose_ms += session.stages.total_ms(POSE) - before;
        count += 1.0;
        for (at, (camera, truth)) in sequence.held_out(set.index as usize)?.into_iter().enumerate() {
            let start = Instant::now();
            let view = session.render(camera)?;
            if at == 0 {
                view_ms += 1e3 * start.elapsed().as_secs_f64();
            }
            sheet.extend(score_view(&camera.id, set.index, &view, &truth.image, truth.mask.as_ref())?);
        }
    }
    anyhow::ensure!(session.has_people(), "no person was found with {} cameras of {} pixels", size.views, size.side);
    let score = sheet.mean().with_context(|| format!("nothing to compare: give more than {WARM_UP} frames"))?;
    let (pose_ms, set_ms) = (pose_ms / count, set_ms / count);
    let rest_ms = set_ms - pose_ms;
    Ok(Row { axes, size, pose_ms, rest_ms, view_ms: view_ms / count, score })
}

impl Row {
    /// Returns the milliseconds per frame set with one rendered view.
    fn all_ms(&self) -> f64 {
        self.pose_ms + self.rest_ms + self.view_ms
    }

    /// Returns the value along an axis.
    fn amount(&self, axis: Axis) -> f64 {
        match axis {
            Axis::Pixels => f64::from(self.size.side).powi(2),
            Axis::Views => self.size.views as f64,
            Axis::Gaussians => self.size.gaussians as f64,
        }
    }
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| image | cameras | Gaussians | pose ms | rest of the set ms | view ms | all ms | PSNR dB | SSIM | FLIP | mask IoU |\n\
         |---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for row in rows {
        let Row { size: Size { side, views, gaussians }, score, .. } = row;
        let _ = writeln!(
            text,
            "| {side}x{side} | {views} | {gaussians} | {:.0} | {:.0} | {:.0} | {:.0} | {:.2} | {:.4} | {:.4} | {:.4} |",
            row.pose_ms,
            row.rest_ms,
            row.view_ms,
            row.all_ms(),
            score.psnr_db,
            score.ssim,
            score.flip,
            score.iou.unwrap_or(f64::NAN),
        );
    }
    text += "\n| run time grows with | pose | rest of the set | a view | all |\n|---|---|---|---|---|\n";
    for (axis, name) in [(Axis::Pixels, "pixels"), (Axis::Views, "cameras"), (Axis::Gaussians, "Gaussians")] {
        let of = |ms: &dyn Fn(&Row) -> f64| {
            let along = rows.iter().filter(|row| row.axes.contains(&axis));
            let power = exponent(&along.map(|row| (row.amount(axis), ms(row))).collect::<Vec<_>>());
            if power.is_finite() { format!("{power:.2}") } else { "-".to_owned() }
        };
        let _ = writeln!(
            text,
            "| {name}, to the power of | {} | {} | {} | {} |",
            of(&|row| row.pose_ms),
            of(&|row| row.rest_ms),
            of(&|row| row.view_ms),
            of(&Row::all_ms),
        );
    }
    text
}

/// Plots run time over each quantity relative to that of the first row.
fn plot(rows: &[Row]) -> Plot {
    let base = rows.first();
    let of = |axis: Axis, name: &str| {
        let along = rows.iter().filter(|row| row.axes.contains(&axis));
        let mut points: Vec<(f64, f64, String)> = along
            .filter_map(|row| Some((row.amount(axis) / base?.amount(axis), row.all_ms(), String::new())))
            .collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        Series { name: name.to_owned(), points, line: Line::Through }
    };
    Plot {
        title: "Run time per frame set with one view".to_owned(),
        x_label: "times as many".to_owned(),
        y_label: "milliseconds".to_owned(),
        log_x: true,
        log_y: true,
        series: vec![of(Axis::Pixels, "pixels"), of(Axis::Views, "cameras"), of(Axis::Gaussians, "Gaussians")],
    }
}

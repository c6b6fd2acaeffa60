//! `flyrig-bench surfaces`: distance of meshes from the true surfaces, over what they are made from, beside their run time.

mod bounds;
mod depth;
mod score;
mod true_surface;
mod visibility;

use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_avatar::{Avatar, AvatarFitSettings, AvatarModel, TrainingFrame};
use flyrig_fit::{Fit, FitSettings};
use flyrig_fusion::{BudgetSettings, Origin, PersonId, resident_mib};
use flyrig_gpu::GpuContext;
use flyrig_mesh::{Fusion, MeshOptions, MeshedPerson, PersonOptions};
use flyrig_renderer::HarmonicOrder;
use flyrig_report::{arguments::OutputArgs, progress_bar, stop, write_whole};
use flyrig_takes::{AvatarTake, Replay, ReplaySettings, frame_number};
use flyrig_types::Camera;
use glam::Vec3;
use serde::Serialize;

use crate::harness::arguments::RecordedArgs;
use bounds::mesh_of_depths;
use depth::DepthImage;
use score::SurfaceScore;
use true_surface::{TrueSurface, read_surface};
use visibility::cameras_around;

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-surfaces")))]
pub struct BenchSurfacesArgs {
    /// Takes with truth/surface, as `flyrig sim export` writes it.
    #[arg(required = true)]
    pub takes: Vec<PathBuf>,
    #[command(flatten)]
    pub replay: RecordedArgs,
    /// Frames that are scored, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "10,20,30,40,50")]
    pub scored: Vec<u64>,
    /// Source of pose and masks.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Gaussians of the person, as in `flyrig mesh`.
    #[arg(long, default_value_t = 115_000, value_parser = clap::value_parser!(u32).range(1000..=1_000_000))]
    pub gaussians: u32,
    /// Steps of the fit, as in `flyrig mesh`.
    #[arg(long, default_value_t = 800, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub steps: u64,
    /// Triangles of the meshes.
    #[arg(long, default_value_t = 40_000, value_parser = clap::value_parser!(u32).range(500..=5_000_000))]
    pub triangles: u32,
    /// Voxels in place of the default, in parts of it, comma separated.
    #[arg(long, value_delimiter = ',', value_parser = parse_part)]
    pub voxels: Vec<f32>,
    /// Add the mesh of a fit that also compares the true depths of the input cameras: what perfect depth images are worth.
    #[arg(long)]
    pub true_depths: bool,
    /// Keep the tracked node translations, so that the fit moves the Gaussians alone.
    #[arg(long)]
    pub tracked_nodes: bool,
    /// Skip the meshes of the first scored instant alone and of the true depths.
    #[arg(long)]
    pub brief: bool,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Reason of an early end: scores of half a take or fit are no scores.
const STOPPED: &str = "stopped; the table holds the takes before this one";

/// Scores of one surface of one take.
#[derive(Debug, Serialize)]
struct Row {
    take: String,
    surface: String,
    score: SurfaceScore,
    triangles: usize,
    /// Seconds of the mesh, after tracking and fit; 0 for a surface that needs none.
    mesh_secs: f64,
}

/// Seconds before meshing, and memory.
#[derive(Debug, Serialize)]
struct Cost {
    take: String,
    frames: usize,
    track_secs: f64,
    fit_secs: f64,
    resident_mib: f64,
}

/// Tracked take with the truth.
struct Subject {
    name: String,
    take: AvatarTake,
    /// The take without what outlines of other frames show.
    tracked: AvatarTake,
    truths: Vec<(u64, TrueSurface)>,
    inputs: Vec<Camera>,
}

/// Runs the command.
pub fn surfaces(args: &BenchSurfacesArgs, gpu: &GpuContext) -> Result<()> {
    args.output.create()?;
    let gpu = &gpu.fastest();
    let (mut rows, mut costs) = (Vec::new(), Vec::new());
    for take in &args.takes {
        if stop::requested() {
            break;
        }
        let name = take.file_name().unwrap_or(take.as_os_str()).to_string_lossy().into_owned();
        let settings = args.replay.settings(take, args.pose, args.gaussians as usize, BudgetSettings::default());
        score_take(args, &name, &settings, gpu, &mut rows, &mut costs)?;
        write(args, &rows, &costs)?;
    }
    print!("{}", table(&rows, &costs));
    println!("{}; surfaces.md and .json in {}", gpu.adapter_name(), args.output.out.display());
    Ok(())
}

fn score_take(
    args: &BenchSurfacesArgs,
    name: &str,
    settings: &ReplaySettings,
    gpu: &GpuContext,
    rows: &mut Vec<Row>,
    costs: &mut Vec<Cost>,
) -> Result<()> {
    let started = Instant::now();
    let (subject, tracked) = track(args, name, settings, gpu)?;
    let track_secs = started.elapsed().as_secs_f64();
    rows.push(Row {
        take: name.to_owned(),
        surface: "tracked template".to_owned(),
        score: SurfaceScore::mean(&tracked),
        triangles: subject.take.avatar.template.triangles.len(),
        mesh_secs: 0.0,
    });
    let all = |(avatar, frames): (&Avatar, &[TrainingFrame]), surface: &str, options: MeshOptions<'_>| {
        meshed(args, &subject, (avatar, frames), (surface, options), &subject.truths)
    };
    let tracked = subject.take.frames.as_slice();
    rows.push(all((&subject.take.avatar, tracked), "not fitted", MeshOptions::default())?.0);
    let started = Instant::now();
    let fitted = fit(args, subject.take.clone(), gpu)?;
    let fit_secs = started.elapsed().as_secs_f64();
    let fitted = (&fitted.0, fitted.1.as_slice());
    rows.push(all(fitted, "naive fusion", MeshOptions { fusion: Fusion::Naive, ..MeshOptions::default() })?.0);
    let (row, voxel_m) = all(fitted, "Eq. 18", MeshOptions::default())?;
    rows.push(row);
    for part in &args.voxels {
        let options = MeshOptions { voxel_m: Some(voxel_m * part), ..MeshOptions::default() };
        rows.push(all(fitted, &format!("Eq. 18, voxels of {:.1} mm", 1e3 * voxel_m * part), options)?.0);
    }
    if args.true_depths {
        let take = with_true_depths(&settings.dataset, &subject)?;
        let (avatar, frames) = fit(args, take, gpu)?;
        rows.push(all((&avatar, &frames), "Eq. 18, true depths of the inputs in the fit", MeshOptions::default())?.0);
    }
    if !args.brief {
        let (number, truth) = subject.truths.first().context("no frame is scored")?;
        let (instant, own) = fit(args, subject.tracked.clone().only(*number)?, gpu)?;
        // Its only frame in the place of the tracked one.
        let mut frames = tracked.to_vec();
        if let Some(at) = subject.take.numbers.iter().position(|known| known == number) {
            frames.splice(at..=at, own);
        }
        for (fitted, surface) in [
            (fitted, format!("Eq. 18, frame {number}")),
            ((&instant, frames.as_slice()), format!("fitted to frame {number} alone, frame {number}")),
        ] {
            let what = (surface.as_str(), MeshOptions::default());
            rows.push(meshed(args, &subject, fitted, what, &subject.truths[..1])?.0);
        }
        for (cameras, what) in
            [(&subject.inputs, "inputs"), (&cameras_around(&truth.positions), "cameras on all sides")]
        {
            let started = Instant::now();
            let mesh = mesh_of_depths(truth, cameras)?;
            rows.push(Row {
                take: name.to_owned(),
                surface: format!("true depth, {} {what}, frame {number}", cameras.len()),
                score: SurfaceScore::of(&mesh.positions, &mesh.triangles, truth),
                triangles: mesh.triangles.len(),
                mesh_secs: started.elapsed().as_secs_f64(),
            });
        }
    }
    costs.push(Cost {
        take: name.to_owned(),
        frames: subject.take.frames.len(),
        track_secs,
        fit_secs,
        resident_mib: resident_mib().unwrap_or(f64::NAN),
    });
    Ok(())
}

/// Tracks the take, and scores the tracked template.
fn track(
    args: &BenchSurfacesArgs,
    name: &str,
    settings: &ReplaySettings,
    gpu: &GpuContext,
) -> Result<(Subject, Vec<SurfaceScore>)> {
    let mut replay = Replay::open(settings, gpu)?;
    let inputs = replay.session.rig().cameras.clone();
    let wanted: Vec<u64> = args
        .scored
        .iter()
        .copied()
        .filter(|number| settings.frames.as_ref().is_none_or(|range| range.contains(number)))
        .collect();
    ensure!(!wanted.is_empty(), "no frame of --scored is among --frames");
    let (mut truths, mut scores) = (Vec::new(), Vec::new());
    let take = AvatarTake::track(&mut replay, &settings.session.body, HarmonicOrder::Zero, |replay, set| {
        let number = frame_number(set);
        if !wanted.contains(&number) {
            return Ok(());
        }
        let truth = TrueSurface::read(&settings.dataset, number, &inputs)?;
        let subject = replay.session.subject(PersonId::default());
        let Some((subject, pose)) = subject.and_then(|subject| Some((subject, subject.pose()?))) else { return Ok(()) };
        let (positions, _) = subject.surface(pose);
        scores.push(SurfaceScore::of(&positions, &subject.template().triangles, &truth));
        truths.push((number, truth));
        Ok(())
    })
    .with_context(|| format!("no surface of {}", settings.dataset.display()))?;
    ensure!(!stop::requested(), STOPPED);
    ensure!(!truths.is_empty(), "{name}: the person was found in none of the frames {:?}", args.scored);
    let tracked = take.clone();
    Ok((Subject { name: name.to_owned(), take: take.with_outlines(), tracked, truths, inputs }, scores))
}

/// Returns the take with the true surface in each of its views.
fn with_true_depths(dataset: &Path, subject: &Subject) -> Result<AvatarTake> {
    let mut take = subject.take.clone();
    let mut views = Vec::with_capacity(take.views.len());
    for (at, number) in take.numbers.iter().enumerate() {
        let (positions, triangles) = read_surface(dataset, *number)?;
        views.extend(take.views.iter().filter(|view| view.frame() == at).map(|view| {
            let camera = subject.inputs.iter().find(|camera| camera.id == view.camera().id);
            let depths = camera.map(|camera| DepthImage::render(camera, &positions, &triangles).depths());
            view.clone().with_depths(&depths.unwrap_or_default())
        }));
    }
    take.views = views;
    Ok(take)
}

/// Fits the avatar of a take to its images.
fn fit(args: &BenchSurfacesArgs, take: AvatarTake, gpu: &GpuContext) -> Result<(Avatar, Vec<TrainingFrame>)> {
    let settings = AvatarFitSettings { refine_nodes: !args.tracked_nodes, ..AvatarFitSettings::default() };
    let model = AvatarModel::new(take.avatar, take.frames, settings);
    let mut fit = Fit::new(gpu, model, take.views, FitSettings::default())?;
    let bar = progress_bar(args.steps, "fit");
    for step in (0..args.steps).take_while(|_| !stop::requested()) {
        fit.step(step as f32 / args.steps as f32)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    ensure!(!stop::requested(), STOPPED);
    Ok(fit.into_model().into_parts())
}

/// Meshes an avatar and scores the mesh in some frames. Returns also the side of a voxel, metres.
fn meshed(
    args: &BenchSurfacesArgs,
    subject: &Subject,
    (avatar, frames): (&Avatar, &[TrainingFrame]),
    (surface, mesh): (&str, MeshOptions<'_>),
    truths: &[(u64, TrueSurface)],
) -> Result<(Row, f32)> {
    let started = Instant::now();
    let options = PersonOptions { mesh, triangles: args.triangles as usize, ..PersonOptions::default() };
    let (person, report) =
        MeshedPerson::of_avatar(avatar, &options).with_context(|| format!("no mesh of {}", subject.name))?;
    let mesh_secs = started.elapsed().as_secs_f64();
    let scores: Vec<SurfaceScore> = truths
        .iter()
        .filter_map(|(number, truth)| {
            let at = subject.take.numbers.iter().position(|known| known == number)?;
            let TrainingFrame { pose, translations } = &frames[at];
            let (positions, _): (Vec<Vec3>, _) = person.posed(pose, Some(translations));
            Some(SurfaceScore::of(&positions, &person.template.triangles, truth))
        })
        .collect();
    let row = Row {
        take: subject.name.clone(),
        surface: surface.to_owned(),
        score: SurfaceScore::mean(&scores),
        triangles: person.template.triangles.len(),
        mesh_secs,
    };
    Ok((row, report.mesh.settings.voxel_m))
}

fn write(args: &BenchSurfacesArgs, rows: &[Row], costs: &[Cost]) -> Result<()> {
    write_whole(&args.output.out.join("surfaces.md"), table(rows, costs).as_bytes())?;
    let all = serde_json::json!({ "surfaces": rows, "costs": costs });
    write_whole(&args.output.out.join("surfaces.json"), &serde_json::to_vec_pretty(&all)?)
}

fn table(rows: &[Row], costs: &[Cost]) -> String {
    let mut text = format!("| take | surface | {} | triangles | seconds |\n|---|---|", SurfaceScore::COLUMNS);
    text += &"---|".repeat(SurfaceScore::COLUMNS.split('|').count() + 2);
    text.push('\n');
    for Row { take, surface, score, triangles, mesh_secs } in rows {
        let _ = writeln!(text, "| {take} | {surface} | {} | {triangles} | {mesh_secs:.1} |", score.cells());
    }
    text += "\n| take | frames | tracking s | fit s | resident MiB |\n|---|---|---|---|---|\n";
    for Cost { take, frames, track_secs, fit_secs, resident_mib } in costs {
        let _ = writeln!(text, "| {take} | {frames} | {track_secs:.0} | {fit_secs:.0} | {resident_mib:.0} |");
    }
    text
}

fn parse_part(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(part) if (0.25..=4.0).contains(&part) => Ok(part),
        _ => Err(format!("'{text}' is not between 0.25 and 4")),
    }
}

//! `flyrig-bench avatar`: error of avatars over the time of their fit, for variants of the fit; run time and memory over the number of
//! Gaussians.

mod detail;
mod variant;

use std::{
    fmt::Write as _,
    ops::Range,
    path::PathBuf,
    time::{Duration, Instant},
};

use anyhow::{Context, Result};
use clap::{Args, builder::TypedValueParser as _};
use flyrig_avatar::{Avatar, AvatarFitSettings, AvatarModel, AvatarScene, Bones};
use flyrig_body::DEFAULT_GAUSSIAN_COUNT;
use flyrig_fit::Fit;
use flyrig_fusion::{BudgetSettings, Origin, Outcome, PersonId, resident_mib};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_renderer::HarmonicOrder;
use flyrig_report::{
    arguments::{OutputArgs, parse_range, parse_seconds},
    plot::{Line, Plot, Series},
    progress_bar, stop, write_whole,
};
use flyrig_takes::{AvatarTake, Replay, ReplaySettings, frame_number};
use flyrig_types::{Camera, FrameSet, Image, Mask, Pose, RenderedView};
use glam::DVec3;
use serde::Serialize;

use crate::harness::{arguments::RecordedArgs, images::copy, statistics::exponent};
use detail::{SmallViews, small_views};
use variant::Variant;

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-avatar")))]
pub struct BenchAvatarArgs {
    /// Data set in EasyMocap layout, as `flyrig eval` reads and `flyrig sim export` writes it.
    pub dataset: PathBuf,
    #[command(flatten)]
    pub replay: RecordedArgs,
    /// Frames with novel poses for the evaluation; avatars are fitted to --frames, by default the first 30.
    #[arg(long, default_value = "30..60", value_parser = parse_range)]
    pub novel: Range<u64>,
    /// Frames from one scored frame to the next.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub every: u32,
    /// Source of pose and masks.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Numbers of Gaussians, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "10000,41000,164000", value_parser = clap::value_parser!(u32).range(1000..=1_000_000).map(|n| n as usize))]
    pub gaussians: Vec<usize>,
    /// Seconds of fitting after which the avatars are scored, comma separated; the largest ends the fit.
    #[arg(long, value_delimiter = ',', default_value = "5,15,30,60,120", value_parser = parse_seconds)]
    pub seconds: Vec<f64>,
    /// Steps of fitting after which the avatars are scored, in place of seconds: the same steps give the same avatar.
    #[arg(long, value_delimiter = ',', conflicts_with = "seconds", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub steps: Vec<u64>,
    /// Rows of the ablation tables (docs/benchmarks/avatar.md), comma separated.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "direct")]
    pub variant: Vec<Variant>,
    /// Weight of the attraction between neighbouring Gaussians, as in `flyrig avatar build`.
    #[arg(long, default_value_t = 5.0)]
    pub pull: f32,
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Name of the person as it is rendered live, in the table of costs.
const LIVE: &str = "live";

/// Held-out images and the state of the person at one instant.
struct Held {
    number: u64,
    pose: Pose,
    translations: Vec<DVec3>,
    truths: Vec<Option<(Image, Option<Mask>)>>,
}

/// Scores at one time of the fit.
#[derive(Debug, Serialize)]
struct Row {
    variant: String,
    gaussians: usize,
    /// Seconds of fitting, without tracking and scoring; steps.
    seconds: f64,
    steps: u64,
    /// Scores in the frames of the fit, with the tracked deformation.
    view: CameraScore,
    /// Scores in other frames, driven by the pose alone.
    pose: CameraScore,
    /// Scores in other frames, with the tracked deformation.
    moved: CameraScore,
}

/// Run time and memory of an avatar, or of the person as it is rendered live.
#[derive(Debug, Serialize)]
struct Cost {
    name: String,
    gaussians: usize,
    track_secs: f64,
    /// Milliseconds per step of the fit.
    step_ms: f64,
    /// Milliseconds of posing, and of rendering a view and reading it back.
    pose_ms: f64,
    view_ms: f64,
    file_mb: f64,
    /// Resident memory of the process at the end of the fit.
    resident_mib: f64,
    /// PSNR of the held-out cameras in the frames of the fit, at its end.
    psnr_db: f64,
    /// Renderings in small images.
    small: Vec<SmallViews>,
}

/// Runs the command.
pub fn avatar(args: &BenchAvatarArgs, gpu: &GpuContext) -> Result<()> {
    args.output.create()?;
    let gpu = &gpu.fastest();
    let settings = |gaussians: usize, frames: &Range<u64>| {
        let mut settings = args.replay.settings(&args.dataset, args.pose, gaussians, BudgetSettings::default());
        settings.frames = Some(frames.clone());
        settings
    };
    let fitted = args.replay.frames.clone().unwrap_or(0..30);
    let live = live(args, &settings(DEFAULT_GAUSSIAN_COUNT, &fitted), gpu)?;
    let (mut rows, mut costs, mut others) = (Vec::new(), vec![live], None);
    for &gaussians in &args.gaussians {
        if stop::requested() {
            break;
        }
        let (take, held, cameras, track_secs) = track(args, &settings(gaussians, &fitted), gpu)?;
        if others.is_none() {
            let mut settings = settings(gaussians, &args.novel);
            settings.body = Some(take.avatar.template.clone().into());
            others = Some(track(args, &settings, gpu)?.1);
        }
        let novel = others.as_deref().unwrap_or_default();
        for &variant in &args.variant {
            costs.push(fit(args, gpu, &take, (&held, novel, &cameras), track_secs, variant, &mut rows)?);
            write(args, &rows, &costs)?;
        }
    }
    print!("{}", table(&rows, &costs));
    println!("{}; avatar.md, .json and .svg in {}", gpu.adapter_name(), args.output.out.display());
    Ok(())
}

fn write(args: &BenchAvatarArgs, rows: &[Row], costs: &[Cost]) -> Result<()> {
    write_whole(&args.output.out.join("avatar.md"), table(rows, costs).as_bytes())?;
    let all = serde_json::json!({ "scores": rows, "costs": costs });
    write_whole(&args.output.out.join("avatar.json"), &serde_json::to_vec_pretty(&all)?)?;
    write_whole(&args.output.out.join("avatar.svg"), plot(rows).svg().as_bytes())
}

/// Scores the person as it is rendered live.
fn live(args: &BenchAvatarArgs, settings: &ReplaySettings, gpu: &GpuContext) -> Result<Cost> {
    let mut replay = Replay::open(settings, gpu)?;
    let (mut sheet, mut spent, mut views, mut at) = (ScoreSheet::default(), Duration::ZERO, 0u32, 0u64);
    let started = Instant::now();
    while let Some(set) = replay.next_set()? {
        if matches!(replay.session.process(&set)?, Outcome::Held(_)) {
            continue;
        }
        at += 1;
        if (at - 1) % u64::from(args.every) != 0 {
            continue;
        }
        let held = hold(&mut replay, &set)?.context("no person was found in the first frame")?;
        for (camera, truth) in replay.holdout.clone().iter().zip(&held.truths) {
            let start = Instant::now();
            let view = replay.session.render(camera)?;
            spent += start.elapsed();
            views += 1;
            score(&mut sheet, held.number, camera, &view, truth.as_ref())?;
        }
    }
    let score = sheet.mean().context("nothing to compare: give --holdout")?;
    Ok(Cost {
        name: LIVE.to_owned(),
        gaussians: settings.session.body.gaussians,
        track_secs: started.elapsed().as_secs_f64(),
        step_ms: f64::NAN,
        pose_ms: f64::NAN,
        view_ms: 1e3 * spent.as_secs_f64() / f64::from(views.max(1)),
        file_mb: f64::NAN,
        resident_mib: resident_mib().unwrap_or(f64::NAN),
        psnr_db: score.psnr_db,
        small: Vec::new(),
    })
}

/// Tracks the person of a take and keeps the held-out images of some frames. Returns also the held-out cameras and the seconds.
fn track(
    args: &BenchAvatarArgs,
    settings: &ReplaySettings,
    gpu: &GpuContext,
) -> Result<(AvatarTake, Vec<Held>, Vec<Camera>, f64)> {
    let started = Instant::now();
    let mut replay = Replay::open(settings, gpu)?;
    let (mut held, mut at) = (Vec::new(), 0u64);
    let take = AvatarTake::track(&mut replay, &settings.session.body, HarmonicOrder::Zero, |replay, set| {
        if at % u64::from(args.every) == 0 {
            held.extend(hold(replay, set)?);
        }
        at += 1;
        Ok(())
    })?;
    Ok((take, held, replay.holdout, started.elapsed().as_secs_f64()))
}

fn hold(replay: &mut Replay, set: &FrameSet) -> Result<Option<Held>> {
    let subject = replay.session.subject(PersonId::default());
    let Some((pose, subject)) = subject.and_then(|subject| Some((subject.pose()?.clone(), subject))) else {
        return Ok(None);
    };
    let translations = subject.node_translations().to_vec();
    let truths = replay.truth.at(set.master_nanos)?;
    // The frame's own image is read anew with the next set.
    let truths = truths
        .into_iter()
        .map(|truth| truth.map(|frame| Ok((copy(&frame.image)?, frame.mask.clone()))).transpose())
        .collect::<Result<_>>()?;
    Ok(Some(Held { number: frame_number(set), pose, translations, truths }))
}

fn score(
    sheet: &mut ScoreSheet,
    number: u64,
    camera: &Camera,
    view: &RenderedView,
    truth: Option<&(Image, Option<Mask>)>,
) -> Result<()> {
    let Some((image, mask)) = truth else { return Ok(()) };
    sheet.extend(score_view(&camera.id, number, view, image, mask.as_ref())?);
    Ok(())
}

/// Scores an avatar in some frames. Returns also the mean milliseconds of posing and of a view.
fn scored(
    (avatar, scene): (&Avatar, &mut AvatarScene),
    frames: &[Held],
    cameras: &[Camera],
    is_deformed: bool,
) -> Result<(CameraScore, [f64; 2])> {
    let (mut sheet, mut posing, mut drawing, mut views) = (ScoreSheet::default(), Duration::ZERO, Duration::ZERO, 0u32);
    for held in frames {
        let start = Instant::now();
        if is_deformed && !held.translations.is_empty() {
            let bones = Bones::new(&avatar.template.skeleton, &held.pose);
            scene.pose(avatar, &bones, Some(&held.translations));
        } else {
            scene.drive(avatar, &held.pose);
        }
        posing += start.elapsed();
        for (camera, truth) in cameras.iter().zip(&held.truths) {
            let start = Instant::now();
            let view = scene.draw(camera)?;
            drawing += start.elapsed();
            views += 1;
            score(&mut sheet, held.number, camera, &view, truth.as_ref())?;
        }
    }
    let ms = |time: Duration, count: usize| 1e3 * time.as_secs_f64() / count.max(1) as f64;
    let score = sheet.mean().context("nothing to compare: give --holdout and frames that the person is in")?;
    Ok((score, [ms(posing, frames.len()), ms(drawing, views as usize)]))
}

/// Fits an avatar and scores it at each of the requested times or steps.
fn fit(
    args: &BenchAvatarArgs,
    gpu: &GpuContext,
    take: &AvatarTake,
    (held, novel, cameras): (&[Held], &[Held], &[Camera]),
    track_secs: f64,
    variant: Variant,
    rows: &mut Vec<Row>,
) -> Result<Cost> {
    let AvatarTake { frames, views, uvs, .. } = take;
    let gaussians = take.avatar.gaussians();
    let mut scene = AvatarScene::new(gpu, &take.avatar)?;
    let settings = variant.avatar_settings(AvatarFitSettings { pull: args.pull, ..AvatarFitSettings::default() });
    let mut model = AvatarModel::new(take.avatar.clone(), frames.clone(), settings);
    let settings = variant.fit_settings();
    if let Some(local) = variant.local_settings() {
        model.use_networks(uvs, &local, settings.seed)?;
    }
    let mut fit = Fit::new(gpu, model, views.clone(), settings)?;
    let by_steps = !args.steps.is_empty();
    let ends: Vec<f64> =
        if by_steps { args.steps.iter().map(|&steps| steps as f64).collect() } else { args.seconds.clone() };
    let end = ends.iter().copied().fold(0.0, f64::max);
    let bar = progress_bar(end as u64, "bench avatar");
    let (mut spent, mut steps) = (0.0, 0u64);
    let (mut times, mut psnr_db) = ([f64::NAN; 2], f64::NAN);
    for wanted in std::iter::once(0.0).chain(ends) {
        loop {
            let done = if by_steps { steps as f64 } else { spent };
            if done >= wanted || stop::requested() {
                break;
            }
            let start = Instant::now();
            fit.step((done / end) as f32)?;
            spent += start.elapsed().as_secs_f64();
            steps += 1;
            bar.set_position(done as u64);
        }
        let avatar = fit.model().avatar();
        let view = scored((avatar, &mut scene), held, cameras, true)?;
        let (pose, _) = scored((avatar, &mut scene), novel, cameras, false)?;
        let (moved, _) = scored((avatar, &mut scene), novel, cameras, true)?;
        bar.set_message(format!("{} {gaussians}: {:.2} and {:.2} dB", variant.name(), view.0.psnr_db, pose.psnr_db));
        (times, psnr_db) = (view.1, view.0.psnr_db);
        rows.push(Row { variant: variant.name(), gaussians, seconds: spent, steps, view: view.0, pose, moved });
    }
    bar.finish_and_clear();
    let avatar = fit.into_model().into_avatar();
    let poses: Vec<_> = held.iter().map(|held| (&held.pose, held.translations.as_slice())).collect();
    let small = small_views(gpu, &avatar, &poses, cameras)?;
    Ok(Cost {
        name: variant.name(),
        gaussians,
        track_secs,
        step_ms: 1e3 * spent / steps.max(1) as f64,
        pose_ms: times[0],
        view_ms: times[1],
        file_mb: avatar.to_bytes()?.len() as f64 / 1e6,
        resident_mib: resident_mib().unwrap_or(f64::NAN),
        psnr_db,
        small,
    })
}

fn table(rows: &[Row], costs: &[Cost]) -> String {
    let mut text = String::from(
        "| variant | Gaussians | seconds of fitting | steps | novel view: PSNR dB | SSIM | FLIP | IoU | novel pose: PSNR dB | SSIM | FLIP | IoU | novel pose, tracked: PSNR dB | SSIM | FLIP | IoU |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let of = |score: &CameraScore| {
        let CameraScore { psnr_db, ssim, flip, iou, .. } = score;
        format!("{psnr_db:.2} | {ssim:.4} | {flip:.4} | {:.4}", iou.unwrap_or(f64::NAN))
    };
    for Row { variant, gaussians, seconds, steps, view, pose, moved } in rows {
        let _ = writeln!(
            text,
            "| {variant} | {gaussians} | {seconds:.0} | {steps} | {} | {} | {} |",
            of(view),
            of(pose),
            of(moved)
        );
    }
    text += "\n| drawn | Gaussians | tracking s | ms per step | posing ms | view ms | file MB | resident MiB | novel view dB |\n|---|---|---|---|---|---|---|---|---|\n";
    let number =
        |value: f64, digits: usize| if value.is_finite() { format!("{value:.digits$}") } else { "-".to_owned() };
    for cost in costs {
        let _ = writeln!(
            text,
            "| {} | {} | {:.0} | {} | {} | {} | {} | {} | {:.2} |",
            cost.name,
            cost.gaussians,
            cost.track_secs,
            number(cost.step_ms, 0),
            number(cost.pose_ms, 1),
            number(cost.view_ms, 1),
            number(cost.file_mb, 1),
            number(cost.resident_mib, 0),
            cost.psnr_db,
        );
    }
    let avatars: Vec<&Cost> = costs.iter().filter(|cost| cost.name != LIVE).collect();
    for avatar in &avatars {
        let _ = write!(
            text,
            "\n{}, {} Gaussians, in small images:\n\n{}",
            avatar.name,
            avatar.gaussians,
            detail::table(&avatar.small)
        );
    }
    let is_one_variant = avatars.windows(2).all(|pair| pair[0].name == pair[1].name);
    if avatars.len() > 1 && is_one_variant {
        let power = |value: fn(&Cost) -> f64| {
            exponent(&avatars.iter().map(|cost| (cost.gaussians as f64, value(cost))).collect::<Vec<_>>())
        };
        let _ = writeln!(
            text,
            "\nWith the number of Gaussians to the power of: a step {:.2}, posing {:.2}, a view {:.2}, the file {:.2}, memory {:.2}.",
            power(|cost| cost.step_ms),
            power(|cost| cost.pose_ms),
            power(|cost| cost.view_ms),
            power(|cost| cost.file_mb),
            power(|cost| cost.resident_mib),
        );
    }
    text
}

/// Plots PSNR over the time of the fit.
fn plot(rows: &[Row]) -> Plot {
    let mut series: Vec<Series> = Vec::new();
    for row in rows.iter().filter(|row| row.steps > 0) {
        for (what, score) in [("novel view", &row.view), ("novel pose", &row.pose), ("novel pose, tracked", &row.moved)]
        {
            let name = format!("{}, {} Gaussians, {what}", row.variant, row.gaussians);
            let point = (row.seconds, score.psnr_db, String::new());
            match series.iter_mut().find(|series| series.name == name) {
                Some(series) => series.points.push(point),
                None => series.push(Series { name, points: vec![point], line: Line::Through }),
            }
        }
    }
    Plot {
        title: "Held-out cameras over the time of fitting".to_owned(),
        x_label: "seconds of fitting".to_owned(),
        y_label: "PSNR, dB".to_owned(),
        log_x: true,
        log_y: false,
        series,
    }
}

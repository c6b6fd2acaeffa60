//! `flyrig avatar build`: tracks the person of a take, then fits an avatar to its images.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use clap::{Args, ValueEnum};
use flyrig_avatar::{Avatar, AvatarScene, Bones, Card, Fit, FitSettings, LocalSettings};
use flyrig_body::DEFAULT_NODE_COUNT;
use flyrig_fusion::BodySettings;
use flyrig_gpu::GpuContext;
use flyrig_renderer::HarmonicOrder;
use flyrig_report::{AvatarTake, arguments::parse_minutes, png, progress_bar, stop};

use super::{checkpoint::Checkpoint, open_replay};
use crate::arguments::DatasetArgs;

/// Default number of Gaussians, about 7 mm apart on an adult.
const GAUSSIANS: u32 = 41_000;

/// Arguments of `flyrig avatar build`.
#[derive(Debug, Args)]
pub struct AvatarBuildArgs {
    #[command(flatten)]
    pub take: DatasetArgs,
    /// The avatar to write (*.flyavatar).
    #[arg(long)]
    pub out: PathBuf,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = GAUSSIANS, value_parser = clap::value_parser!(u32).range(1000..=1_000_000))]
    pub gaussians: u32,
    /// Nodes of the deformation graph.
    #[arg(long, default_value_t = DEFAULT_NODE_COUNT)]
    pub nodes: usize,
    /// Order of the spherical harmonics of the colours; higher orders depend more on the viewing direction.
    #[arg(long, value_enum, default_value = "0")]
    pub harmonics: Order,
    /// Minutes of fitting, after tracking. Longer fits reproduce the images of the take better, and other views worse.
    #[arg(long, default_value_t = 1.5, value_parser = parse_minutes, conflicts_with = "steps")]
    pub minutes: f64,
    /// Steps of fitting in place of minutes: the same steps and seed give the same bytes.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub steps: Option<u64>,
    /// Weight of the attraction between neighbouring Gaussians; 0 turns it off.
    #[arg(long, default_value_t = 5.0, value_parser = parse_pull)]
    pub pull: f32,
    /// Whether to learn the light of the room separately from the colours.
    #[arg(long, default_value_t = true, action = clap::ArgAction::Set)]
    pub light: bool,
    /// Parametrization of the avatar.
    #[arg(long, value_enum, default_value = "direct")]
    pub method: Method,
    /// Seed of the order of the images, and of networks.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// Order of the spherical harmonics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Order {
    #[value(name = "0")]
    Zero,
    #[value(name = "1")]
    One,
    #[value(name = "2")]
    Two,
}

/// Parametrization of an avatar while it is fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// Independent attributes of every Gaussian.
    Direct,
    /// Networks that neighbouring Gaussians share, and an atlas of colours (LoGAvatar).
    #[value(name = "logavatar")]
    LogAvatar,
}

fn parse_pull(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(pull) if (0.0..=1000.0).contains(&pull) => Ok(pull),
        _ => Err(format!("'{text}' is not between 0 and 1000")),
    }
}

/// Steps by which the time of one is measured.
const MEASURED_STEPS: u64 = 20;
/// Steps between updates of the progress.
const SHOW_EVERY: u64 = 20;
/// Steps, and time, between savings of the state.
const SAVE_STEPS: u64 = 500;
const SAVE_EVERY: Duration = Duration::from_secs(30);
/// Pictures that are written while it is fitted.
const PICTURES: u64 = 10;

/// Runs the command.
pub fn build(args: &AvatarBuildArgs, gpu: &GpuContext) -> Result<()> {
    let folder = args.out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    ensure!(folder.is_dir(), "the folder {} does not exist; make it, or choose another --out", folder.display());
    let started = Instant::now();
    let body = BodySettings { gaussians: args.gaussians as usize, nodes: args.nodes, ..BodySettings::default() };
    let mut replay = open_replay(&args.take, &[], (&body, None), gpu)?;
    let order = match args.harmonics {
        Order::Zero => HarmonicOrder::Zero,
        Order::One => HarmonicOrder::One,
        Order::Two => HarmonicOrder::Two,
    };
    let tracked = AvatarTake::track(&mut replay, &body, order, |_, _| Ok(()))
        .with_context(|| format!("no avatar of {}", args.take.dataset.display()))?;
    drop(replay);
    let AvatarTake { frames, views, mut avatar, uvs, numbers, camera, .. } = tracked;
    let tracked = started.elapsed();
    println!(
        "tracked {} frames in {:.0} s; fitting {} Gaussians to {} images on {}",
        frames.len(),
        tracked.as_secs_f64(),
        avatar.gaussians(),
        views.len(),
        gpu.adapter_name()
    );
    let first = frames.first().cloned().context("no frame")?;
    let mut scene = AvatarScene::new(gpu, &avatar)?;
    let picture_path = args.out.with_extension("png");
    let mut picture = |avatar: &Avatar| -> Result<()> {
        scene.pose(avatar, &Bones::new(&avatar.template.skeleton, &first.pose), Some(&first.translations));
        png::write_view(&picture_path, &scene.draw(&camera)?)
    };
    picture(&avatar)?;
    let mut fit = Fit::new(
        gpu,
        &avatar,
        frames,
        views,
        FitSettings { seed: args.seed, pull: args.pull, light: args.light, ..FitSettings::default() },
    )?;
    let local = LocalSettings::default();
    if args.method == Method::LogAvatar {
        let numbers = fit.use_networks(&mut avatar, &uvs, &local)?;
        println!("local networks of {numbers} numbers");
        picture(&avatar)?;
    }
    let state = Checkpoint::new(args, fit.images());
    let (mut done, mut total) = (0, args.steps);
    if let Some(progress) = state.resume(&mut fit, &mut avatar)? {
        (done, total) = (progress.done, Some(progress.total));
    }
    let before = fit.decibels(&avatar)?;
    let (fitting, resumed_at) = (Instant::now(), done);
    let mut saved = (Instant::now(), done);
    let bar = progress_bar(total.unwrap_or(MEASURED_STEPS), "avatar build");
    bar.set_position(done);
    let (mut sum, mut pictured) = (0.0, 0);
    while total.is_none_or(|total| done < total) && !stop::requested() {
        let progress = total.map_or(0.0, |total| done as f32 / total as f32);
        sum += fit.step(&mut avatar, progress)?.decibels;
        done += 1;
        if total.is_none() && done == MEASURED_STEPS {
            let step_secs = fitting.elapsed().as_secs_f64() / done as f64;
            let all = ((args.minutes * 60.0 / step_secs) as u64).max(done);
            bar.set_length(all);
            total = Some(all);
        }
        if let Some(total) = total.filter(|_| done >= saved.1 + SAVE_STEPS || saved.0.elapsed() > SAVE_EVERY) {
            state.save(&mut fit, &mut avatar, total)?;
            saved = (Instant::now(), done);
        }
        if done % SHOW_EVERY == 0 {
            bar.set_message(format!("{:.1} dB, {}", sum / SHOW_EVERY as f64, picture_path.display()));
            bar.set_position(done);
            sum = 0.0;
        }
        let tenth = total.map_or(0, |total| PICTURES * done / total);
        if tenth > pictured {
            pictured = tenth;
            picture(&avatar)?;
        }
    }
    bar.finish_and_clear();
    if let Some(total) = total.filter(|total| done < *total) {
        state.save(&mut fit, &mut avatar, total)?;
        println!("stopped after {done} of {total} steps; the same command goes on from there");
    }
    let seconds = fitting.elapsed().as_secs_f64();
    let training_db = fit.decibels(&avatar)?;
    avatar.card = Card {
        name: args.take.dataset.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
        method: method(args.method, &local),
        cameras: args.take.inputs.clone(),
        frames: numbers,
        pose: format!("{:?}", args.take.perception.pose).to_lowercase(),
        masks: format!("{:?}", args.take.perception.masks).to_lowercase(),
        steps: done,
        seed: args.seed,
        training_db,
        edits: Vec::new(),
    };
    avatar.save(&args.out)?;
    if total.is_none_or(|total| done >= total) {
        state.remove()?;
    }
    println!(
        "{done} steps in {seconds:.0} s ({:.1} ms each); training images {before:.2} -> {training_db:.2} dB; {} ({:.1} MB) and {}",
        1e3 * seconds / (done - resumed_at).max(1) as f64,
        args.out.display(),
        std::fs::metadata(&args.out).map_or(0.0, |file| file.len() as f64 / 1e6),
        picture_path.display()
    );
    Ok(())
}

/// Describes the method, for the card.
fn method(method: Method, local: &LocalSettings) -> String {
    match method {
        Method::Direct => "gaussians".to_owned(),
        Method::LogAvatar => {
            let LocalSettings { group, stages, side, .. } = local;
            format!("logavatar: {group} Gaussians an anchor, {stages} stages, atlas uv of {side} texels")
        }
    }
}

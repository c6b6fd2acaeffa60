//! `flyrig avatar build`: tracks the person of a take, then fits an avatar to its images.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use clap::{Args, ValueEnum};
use flyrig_avatar::{Avatar, AvatarScene, Bones, Card, Fit, FitSettings, LocalSettings, TrainingFrame};
use flyrig_body::DEFAULT_NODE_COUNT;
use flyrig_fusion::BodySettings;
use flyrig_gpu::GpuContext;
use flyrig_renderer::HarmonicOrder;
use flyrig_report::{arguments::parse_minutes, png, progress_bar, stop};
use flyrig_takes::AvatarTake;
use flyrig_types::Camera;

use super::{checkpoint::Checkpoint, inputs::open_replay};
use crate::arguments::DatasetArgs;

/// Default number of Gaussians, about 7 mm apart on an adult.
const GAUSSIANS: u32 = 41_000;

/// Arguments of `flyrig avatar build`.
#[derive(Debug, Clone, Args)]
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

/// Number of steps from which the time of a step is measured.
const MEASURED_STEPS: u64 = 20;
/// Steps between updates of the progress.
const SHOW_EVERY: u64 = 20;
/// Steps and time between two checkpoints.
const SAVE_STEPS: u64 = 500;
const SAVE_EVERY: Duration = Duration::from_secs(30);
/// Number of images written while the avatar is fitted.
const PICTURES: u64 = 10;

/// Runs the command.
pub fn build(args: &AvatarBuildArgs, gpu: &GpuContext) -> Result<()> {
    let folder = args.out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    ensure!(folder.is_dir(), "the folder {} does not exist; make it, or choose another --out", folder.display());
    let args = &AvatarBuildArgs { take: args.take.resolve("avatar build", &[], gpu)?, ..args.clone() };
    let AvatarTake { frames, views, mut avatar, uvs, numbers, camera } = track(args, gpu)?;
    let first = frames.first().cloned().context("no frame")?;
    let scene = AvatarScene::new(gpu, &avatar)?;
    let mut preview = Preview { scene, first, camera, path: args.out.with_extension("png") };
    preview.draw(&avatar)?;
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
        preview.draw(&avatar)?;
    }
    Building::start(args, fit, avatar, preview)?.run(numbers)
}

/// Tracks the person of the take.
fn track(args: &AvatarBuildArgs, gpu: &GpuContext) -> Result<AvatarTake> {
    let started = Instant::now();
    let body = BodySettings { gaussians: args.gaussians as usize, nodes: args.nodes, ..BodySettings::default() };
    let mut replay = open_replay(&args.take, &[], (&body, None), gpu)?;
    let order = match args.harmonics {
        Order::Zero => HarmonicOrder::Zero,
        Order::One => HarmonicOrder::One,
        Order::Two => HarmonicOrder::Two,
    };
    let take = AvatarTake::track(&mut replay, &body, order, |_, _| Ok(()))
        .with_context(|| format!("no avatar of {}", args.take.dataset.display()))?;
    println!(
        "tracked {} frames in {:.0} s; fitting {} Gaussians to {} images on {}",
        take.frames.len(),
        started.elapsed().as_secs_f64(),
        take.avatar.gaussians(),
        take.views.len(),
        gpu.adapter_name()
    );
    Ok(take)
}

/// Image of the avatar in the first pose, written while it is fitted.
struct Preview {
    scene: AvatarScene,
    first: TrainingFrame,
    camera: Camera,
    path: PathBuf,
}

impl Preview {
    fn draw(&mut self, avatar: &Avatar) -> Result<()> {
        let bones = Bones::new(&avatar.template.skeleton, &self.first.pose);
        self.scene.pose(avatar, &bones, Some(&self.first.translations));
        png::write_view(&self.path, &self.scene.draw(&self.camera)?)
    }
}

/// Avatar that is being fitted.
struct Building<'a> {
    args: &'a AvatarBuildArgs,
    fit: Fit,
    avatar: Avatar,
    preview: Preview,
    state: Checkpoint,
    /// Number of steps so far.
    done: u64,
    /// Number of all steps; `None` until the time of a step has been measured.
    total: Option<u64>,
    started: Instant,
    /// Number of steps before this run.
    resumed_at: u64,
    /// Mean PSNR of the training images before this run, dB.
    before_db: f64,
}

impl<'a> Building<'a> {
    /// Starts the fit, or resumes it from its checkpoint.
    fn start(args: &'a AvatarBuildArgs, mut fit: Fit, mut avatar: Avatar, preview: Preview) -> Result<Self> {
        let state = Checkpoint::new(&args.out, format!("{} images, {args:?}", fit.images()));
        let (done, total) = match state.resume(&mut fit, &mut avatar)? {
            Some(progress) => (progress.done, Some(progress.total)),
            None => (0, args.steps),
        };
        let before_db = fit.decibels(&avatar)?;
        let started = Instant::now();
        Ok(Self { args, fit, avatar, preview, state, done, total, started, resumed_at: done, before_db })
    }

    /// Fits until the last step or Ctrl-C, and writes the avatar. `numbers` are the take's first frame, and its last one plus 1.
    fn run(mut self, numbers: [u64; 2]) -> Result<()> {
        self.fit_until_end()?;
        if let Some(total) = self.total.filter(|total| self.done < *total) {
            self.state.save(&mut self.fit, &mut self.avatar, total)?;
            println!("stopped after {} of {total} steps; the same command goes on from there", self.done);
        }
        let seconds = self.started.elapsed().as_secs_f64();
        let training_db = self.fit.decibels(&self.avatar)?;
        self.avatar.card = self.card(numbers, training_db);
        self.avatar.save(&self.args.out)?;
        if self.total.is_none_or(|total| self.done >= total) {
            self.state.remove()?;
        }
        println!(
            "{} steps in {seconds:.0} s ({:.1} ms each); training images {:.2} -> {training_db:.2} dB; {} ({:.1} MB) and {}",
            self.done,
            1e3 * seconds / (self.done - self.resumed_at).max(1) as f64,
            self.before_db,
            self.args.out.display(),
            std::fs::metadata(&self.args.out).map_or(0.0, |file| file.len() as f64 / 1e6),
            self.preview.path.display()
        );
        Ok(())
    }

    fn fit_until_end(&mut self) -> Result<()> {
        let mut saved = (Instant::now(), self.done);
        let bar = progress_bar(self.total.unwrap_or(MEASURED_STEPS), "avatar build");
        bar.set_position(self.done);
        let (mut sum, mut pictured) = (0.0, 0);
        while self.total.is_none_or(|total| self.done < total) && !stop::requested() {
            let progress = self.total.map_or(0.0, |total| self.done as f32 / total as f32);
            sum += self.fit.step(&mut self.avatar, progress)?.decibels;
            self.done += 1;
            if self.total.is_none() && self.done == MEASURED_STEPS {
                let all = self.measured_total();
                bar.set_length(all);
                self.total = Some(all);
            }
            let is_due = self.done >= saved.1 + SAVE_STEPS || saved.0.elapsed() > SAVE_EVERY;
            if let Some(total) = self.total.filter(|_| is_due) {
                self.state.save(&mut self.fit, &mut self.avatar, total)?;
                saved = (Instant::now(), self.done);
            }
            if self.done.is_multiple_of(SHOW_EVERY) {
                bar.set_message(format!("{:.1} dB, {}", sum / SHOW_EVERY as f64, self.preview.path.display()));
                bar.set_position(self.done);
                sum = 0.0;
            }
            let tenth = self.total.map_or(0, |total| PICTURES * self.done / total);
            if tenth > pictured {
                pictured = tenth;
                self.preview.draw(&self.avatar)?;
            }
        }
        bar.finish_and_clear();
        Ok(())
    }

    /// Returns the number of steps that fit into the minutes of the arguments.
    fn measured_total(&self) -> u64 {
        let step_secs = self.started.elapsed().as_secs_f64() / self.done as f64;
        ((self.args.minutes * 60.0 / step_secs) as u64).max(self.done)
    }

    fn card(&self, frames: [u64; 2], training_db: f64) -> Card {
        let take = &self.args.take;
        Card {
            name: take.dataset.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
            method: method(self.args.method, &LocalSettings::default()),
            cameras: take.inputs.clone(),
            frames,
            pose: format!("{:?}", take.perception.settings.pose).to_lowercase(),
            masks: format!("{:?}", take.perception.settings.masks).to_lowercase(),
            steps: self.done,
            seed: self.args.seed,
            training_db,
            edits: Vec::new(),
        }
    }
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

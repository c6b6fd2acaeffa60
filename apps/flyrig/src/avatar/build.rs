//! `flyrig avatar build`: tracks the person of a take, then fits an avatar to its images; or takes the avatar that a rig has learnt.

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context as _, Result, ensure};
use clap::{Args, ValueEnum};
use flyrig_avatar::{Avatar, AvatarFitSettings, AvatarModel, AvatarScene, Bones, Card, LocalSettings, TrainingFrame};
use flyrig_body::DEFAULT_NODE_COUNT;
use flyrig_fit::{Fit, FitSettings, Length, Run};
use flyrig_fusion::{BodySettings, PersonMemory};
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

/// Runs the command.
pub fn build(args: &AvatarBuildArgs, gpu: &GpuContext) -> Result<()> {
    let folder = args.out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    ensure!(folder.is_dir(), "the folder {} does not exist; make it, or choose another --out", folder.display());
    if args.take.dataset.extension().is_some_and(|extension| extension == "person") {
        ensure!(
            args.steps.is_none() && args.take.inputs.is_empty(),
            "{} holds a finished avatar: leave out --steps and --inputs",
            args.take.dataset.display()
        );
        return save_learnt(&args.take.dataset, &args.out);
    }
    let args = &AvatarBuildArgs { take: args.take.resolve("avatar build", &[], gpu)?, ..args.clone() };
    let AvatarTake { frames, views, avatar, uvs, numbers, camera, .. } = track(args, gpu)?;
    let first = frames.first().cloned().context("no frame")?;
    let scene = AvatarScene::new(gpu, &avatar)?;
    let mut preview = Preview { scene, first, camera, path: args.out.with_extension("png") };
    preview.draw(&avatar)?;
    let settings = AvatarFitSettings { pull: args.pull, light: args.light, ..AvatarFitSettings::default() };
    let mut model = AvatarModel::new(avatar, frames, settings);
    if args.method == Method::LogAvatar {
        let numbers = model.use_networks(&uvs, &LocalSettings::default(), args.seed)?;
        println!("local networks of {numbers} numbers");
        preview.draw(model.avatar())?;
    }
    let fit = Fit::new(gpu, model, views, FitSettings { seed: args.seed, ..FitSettings::default() })?;
    let range = [numbers.first(), numbers.last()].map(|number| number.copied().unwrap_or_default());
    Building::start(args, fit, preview)?.run([range[0], range[1] + 1])
}

/// Writes the avatar in a file of `body.person`.
fn save_learnt(person: &Path, out: &Path) -> Result<()> {
    let memory = PersonMemory::load(person)?;
    let avatar = memory.avatar().with_context(|| {
        format!(
            "{} holds no avatar yet; let `flyrig run` go on with body.learn = true until it adopts one",
            person.display()
        )
    })?;
    avatar.save(out)?;
    println!("{} holds the avatar that the rig has learnt: {} Gaussians", out.display(), avatar.gaussians());
    Ok(())
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
    fit: Fit<AvatarModel>,
    preview: Preview,
    state: Checkpoint,
    course: Run,
    /// Mean PSNR of the training images before this run, dB.
    before_db: f64,
}

impl<'a> Building<'a> {
    /// Starts the fit, or resumes it from its checkpoint.
    fn start(args: &'a AvatarBuildArgs, mut fit: Fit<AvatarModel>, preview: Preview) -> Result<Self> {
        let state = Checkpoint::new(&args.out, format!("{} images, {args:?}", fit.images()));
        let resumed = state.resume(&mut fit)?;
        let before_db = fit.decibels()?;
        let length = args.steps.map_or(Length::Minutes(args.minutes), Length::Steps);
        Ok(Self { args, fit, preview, state, course: Run::new(length, resumed.as_ref()), before_db })
    }

    /// Fits until the last step or Ctrl-C, and writes the avatar. `numbers` are the take's first frame, and its last one plus 1.
    fn run(mut self, numbers: [u64; 2]) -> Result<()> {
        self.fit_until_end()?;
        let (done, seconds, step_seconds) = (self.course.done(), self.course.seconds(), self.course.step_seconds());
        if let Some(total) = self.course.total().filter(|total| done < *total) {
            self.state.save(&mut self.fit, total)?;
            println!("stopped after {done} of {total} steps; the same command goes on from there");
        }
        let training_db = self.fit.decibels()?;
        let card = self.card(numbers, training_db);
        let mut avatar = self.fit.into_model().into_avatar();
        avatar.card = card;
        avatar.save(&self.args.out)?;
        if self.course.total().is_none_or(|total| done >= total) {
            self.state.remove()?;
        }
        println!(
            "{done} steps in {seconds:.0} s ({:.1} ms each); training images {:.2} -> {training_db:.2} dB; {} ({:.1} MB) and {}",
            1e3 * step_seconds,
            self.before_db,
            self.args.out.display(),
            std::fs::metadata(&self.args.out).map_or(0.0, |file| file.len() as f64 / 1e6),
            self.preview.path.display()
        );
        Ok(())
    }

    fn fit_until_end(&mut self) -> Result<()> {
        let bar = progress_bar(self.course.total().unwrap_or_default(), "avatar build");
        bar.set_position(self.course.done());
        while !self.course.is_done() && !stop::requested() {
            let due = self.course.step(&mut self.fit)?;
            if let Some(total) = self.course.total() {
                bar.set_length(total);
                if due.checkpoint {
                    self.state.save(&mut self.fit, total)?;
                }
            }
            if let Some(decibels) = due.decibels {
                bar.set_message(format!("{decibels:.1} dB, {}", self.preview.path.display()));
                bar.set_position(self.course.done());
            }
            if due.picture {
                self.preview.draw(self.fit.model().avatar())?;
            }
        }
        bar.finish_and_clear();
        Ok(())
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
            steps: self.course.done(),
            seed: self.args.seed,
            // So few digits are the same number after they were read as JSON.
            training_db: (training_db * 1e3).round() / 1e3,
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use flyrig_body::{ShapeParams, default_template, sample_surface};

    use super::*;

    #[test]
    fn the_avatar_that_a_rig_has_learnt_is_taken_from_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let [person, out] = ["anna.person", "anna.flyavatar"].map(|name| folder.path().join(name));
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 300, 1).unwrap();
        let avatar = Avatar::new(&template, &surface, None, &[], HarmonicOrder::Zero).unwrap();
        PersonMemory::of_avatar(Arc::new(avatar.clone())).save(&person).unwrap();
        save_learnt(&person, &out).unwrap();
        assert_eq!(Avatar::load(&out).unwrap(), avatar);
        std::fs::remove_file(&out).unwrap();

        std::fs::write(&person, b"nothing").unwrap();
        assert!(save_learnt(&person, &out).unwrap_err().to_string().contains("anna.person"));
        assert!(!out.exists());
    }
}

//! `flyrig avatar eval`: scores an avatar against held-out cameras.

use std::{
    path::PathBuf,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_avatar::{Avatar, DetailedScene};
use flyrig_fusion::{BodySettings, Outcome, PersonId, Solver};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, FrameScore, ScoreSheet, error_parts, score_view};
use flyrig_report::{png, progress_bar, write_whole};
use flyrig_takes::{Replay, frame_number};
use flyrig_types::{Camera, Frame, RenderedView};
use serde::Serialize;

use super::{
    inputs::{load, open_replay, print_far},
    parts::score_parts,
};
use crate::arguments::{DatasetArgs, HoldoutArgs};

/// Arguments of `flyrig avatar eval`.
#[derive(Debug, Clone, Args)]
pub struct AvatarEvalArgs {
    /// The avatar (*.flyavatar).
    pub avatar: PathBuf,
    #[command(flatten)]
    pub take: DatasetArgs,
    /// Folder of the images and scores.
    #[arg(long)]
    pub out: PathBuf,
    /// Deform the clothes as tracked in the images, instead of driving the avatar by the pose alone.
    #[arg(long)]
    pub deformed: bool,
    #[command(flatten)]
    pub holdout: HoldoutArgs,
}

#[derive(Debug, Serialize)]
struct Metrics<'a> {
    avatar: String,
    inputs: &'a [String],
    holdout: &'a [String],
    deformed: bool,
    gaussians: usize,
    /// Mean number of Gaussians per view, after merging those that pixels do not resolve.
    mean_drawn: f64,
    adapter: String,
    mean: Option<CameraScore>,
    cameras: Vec<CameraScore>,
    per_frame: &'a [FrameScore],
    /// Scores of the boxes around head and hands.
    parts: Vec<CameraScore>,
    /// Mean fraction of the Gaussians in poses unlike those of the take.
    far_share: f64,
    /// Mean time to pose and render a view, read-back included, milliseconds.
    view_ms: f64,
}

/// Runs the command.
pub fn eval(args: &AvatarEvalArgs, gpu: &GpuContext) -> Result<()> {
    let avatar = load(&args.avatar)?;
    let nodes = avatar.hanging.as_ref().map_or(1, |hanging| hanging.nodes.len());
    let body = BodySettings { gaussians: avatar.gaussians(), nodes, ..BodySettings::default() };
    let take = args.take.resolve("avatar eval", &args.holdout.holdout, gpu)?;
    let args = &AvatarEvalArgs { take, ..args.clone() };
    let mut take = args.take.clone();
    if !args.deformed {
        take.tracking.solver = Solver::None;
    }
    let mut replay = open_replay(&take, &args.holdout.holdout, (&body, Some(&avatar.template)), gpu)?;
    for camera in &replay.holdout {
        let folder = args.out.join(camera.id.as_str());
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    }
    let scene = DetailedScene::new(gpu, avatar, true)?;
    let mut evaluation =
        Evaluation { args, scene, scores: ScoreSheet::default(), parts: ScoreSheet::default(), cost: Cost::default() };
    evaluation.run(&mut replay)?;
    evaluation.write(gpu)
}

/// Scores and cost of an avatar's views, collected frame by frame.
struct Evaluation<'a> {
    args: &'a AvatarEvalArgs,
    scene: DetailedScene,
    scores: ScoreSheet,
    /// Scores of head and hands.
    parts: ScoreSheet,
    cost: Cost,
}

/// Sums over all frames.
#[derive(Default)]
struct Cost {
    frames: u32,
    views: u32,
    /// Time to pose and render the views.
    time: Duration,
    /// Gaussians of all views, and those among them that face away.
    gaussians: usize,
    hidden: usize,
    /// Fractions of the Gaussians in poses unlike those of the take.
    far: f64,
}

impl Evaluation<'_> {
    /// Renders and scores the avatar in the poses of all frame sets.
    fn run(&mut self, replay: &mut Replay) -> Result<()> {
        let bar = progress_bar(replay.count as u64, "avatar eval");
        while let Some(set) = replay.next_set()? {
            bar.inc(1);
            let number = frame_number(&set);
            if let Outcome::Held(reason) = replay.session.process(&set)? {
                tracing::warn!(frame = number, %reason, "frame not used");
            }
            let Some(views) = self.render(replay)? else { continue };
            let truths = replay.truth.at(set.master_nanos)?;
            for ((camera, view), truth) in replay.holdout.iter().zip(&views).zip(&truths) {
                self.score(number, camera, view, *truth)?;
            }
            bar.set_message(self.scores.progress());
        }
        bar.finish_and_clear();
        let dataset = self.args.take.dataset.display();
        ensure!(self.cost.views > 0, "no person was found in {dataset}; run with -v to see why");
        Ok(())
    }

    /// Renders the held-out views in the pose of the last update; `None` without a person.
    fn render(&mut self, replay: &Replay) -> Result<Option<Vec<RenderedView>>> {
        let subject = replay.session.subject(PersonId::default());
        let Some((subject, pose)) = subject.and_then(|subject| Some((subject, subject.pose()?))) else {
            return Ok(None);
        };
        fits(self.scene.avatar(), &subject.template().skeleton, pose)?;
        let start = Instant::now();
        let deformed = Some(subject.node_translations()).filter(|all| self.args.deformed && !all.is_empty());
        self.scene.pose(pose, deformed);
        self.cost.far += self.scene.avatar().far_share(pose);
        self.cost.frames += 1;
        let mut views = Vec::new();
        for camera in &replay.holdout {
            views.push(self.scene.draw(camera)?);
            let (gaussians, hidden) = self.scene.drawn();
            self.cost.gaussians += gaussians;
            self.cost.hidden += hidden;
        }
        self.cost.time += start.elapsed();
        self.cost.views += views.len() as u32;
        Ok(Some(views))
    }

    /// Writes a view and scores it against the held-out image, if there is one.
    fn score(&mut self, number: u64, camera: &Camera, view: &RenderedView, truth: Option<&Frame>) -> Result<()> {
        png::write_view(&self.args.out.join(camera.id.as_str()).join(format!("{number:06}.png")), view)?;
        let Some(truth) = truth else { return Ok(()) };
        if let Some(mask) = &truth.mask {
            self.parts.extend(score_parts((&self.scene, camera), number, view, &truth.image, mask)?);
        }
        let mut score = score_view(&camera.id, number, view, &truth.image, truth.mask.as_ref())?;
        if let (Some(score), Some(mask)) = (&mut score, &truth.mask) {
            score.parts = error_parts(view, &truth.image, mask)?;
        }
        self.scores.extend(score);
        Ok(())
    }

    /// Writes `metrics.json` and prints the scores.
    fn write(&self, gpu: &GpuContext) -> Result<()> {
        let Self { args, scores, parts, cost, .. } = self;
        let metrics = Metrics {
            avatar: args.avatar.display().to_string(),
            inputs: &args.take.inputs,
            holdout: &args.holdout.holdout,
            deformed: args.deformed,
            gaussians: self.scene.avatar().gaussians(),
            mean_drawn: cost.gaussians as f64 / f64::from(cost.views),
            adapter: gpu.adapter_name(),
            mean: scores.mean(),
            cameras: scores.per_camera(),
            per_frame: scores.frames(),
            parts: parts.per_camera(),
            far_share: cost.far / f64::from(cost.frames.max(1)),
            view_ms: 1e3 * cost.time.as_secs_f64() / f64::from(cost.views),
        };
        write_whole(&args.out.join("metrics.json"), &serde_json::to_vec_pretty(&metrics)?)?;
        print!("{}", scores.table());
        for CameraScore { camera: part, frames, psnr_db, ssim, flip, .. } in parts.per_camera() {
            println!("{part:<8} {frames:>6} {psnr_db:>9.2} {ssim:>8.4} {flip:>8.4}");
        }
        println!(
            "\n{} views of {:.0} of {} Gaussians, {:.0} % of them left out as they face away, {:.1} ms each; images in {}",
            cost.views,
            metrics.mean_drawn,
            metrics.gaussians,
            100.0 * cost.hidden as f64 / cost.gaussians.max(1) as f64,
            metrics.view_ms,
            args.out.display()
        );
        print_far(metrics.far_share);
        Ok(())
    }
}

/// Checks that a pose fits the avatar's skeleton.
fn fits(avatar: &Avatar, skeleton: &flyrig_body::Skeleton, pose: &flyrig_types::Pose) -> Result<()> {
    let names = |skeleton: &flyrig_body::Skeleton| -> Vec<String> {
        skeleton.joints().iter().map(|joint| joint.name.clone()).collect()
    };
    let (own, found) = (names(&avatar.template.skeleton), names(skeleton));
    ensure!(
        own == found,
        "the avatar has {} joints, the take's person {}, or others; use the take it was built from, or one with the same body",
        own.len(),
        found.len()
    );
    Ok(avatar.template.skeleton.check_pose(pose)?)
}

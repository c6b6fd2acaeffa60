//! `flyrig avatar eval`: scores an avatar against held-out cameras.

use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use flyrig_avatar::{Avatar, DetailedScene};
use flyrig_fusion::{BodySettings, Outcome, PersonId, Solver};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, FrameScore, ScoreSheet, error_parts, score_view};
use flyrig_report::{png, progress_bar, write_whole};
use flyrig_takes::frame_number;
use serde::Serialize;

use super::{
    arguments::EvalArgs,
    inputs::{load, open_replay, print_far},
    parts::score_parts,
};

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
pub fn eval(args: &EvalArgs, gpu: &GpuContext) -> Result<()> {
    let avatar = load(&args.avatar)?;
    let nodes = avatar.hanging.as_ref().map_or(1, |hanging| hanging.nodes.len());
    let body = BodySettings { gaussians: avatar.gaussians(), nodes, ..BodySettings::default() };
    let mut take = args.take.clone();
    if !args.deformed {
        take.tracking.solver = Solver::None;
    }
    let mut replay = open_replay(&take, &args.holdout, (&body, Some(&avatar.template)), gpu)?;
    let holdout = replay.holdout.clone();
    for camera in &holdout {
        let folder = args.out.join(camera.id.as_str());
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    }
    let mut scene = DetailedScene::new(gpu, avatar, args.level_of_detail)?;
    let gaussians = scene.avatar().gaussians();
    let bar = progress_bar(replay.count as u64, "avatar eval");
    let (mut sheet, mut spent, mut views_drawn) = (ScoreSheet::default(), Duration::ZERO, 0u32);
    // Numbers of Gaussians of all views, and of those that face away.
    let (mut drawn, mut hidden) = (0, 0);
    let (mut parts, mut far, mut frames) = (ScoreSheet::default(), 0.0, 0u32);
    while let Some(set) = replay.next_set()? {
        bar.inc(1);
        let number = frame_number(&set);
        if let Outcome::Held(reason) = replay.session.process(&set)? {
            tracing::warn!(frame = number, %reason, "frame not used");
        }
        let subject = replay.session.subject(PersonId::default());
        let Some((subject, pose)) = subject.and_then(|subject| Some((subject, subject.pose()?))) else { continue };
        fits(scene.avatar(), &subject.template().skeleton, pose)?;
        let start = Instant::now();
        let deformed = Some(subject.node_translations()).filter(|all| args.deformed && !all.is_empty());
        scene.pose(pose, deformed);
        far += scene.avatar().far_share(pose);
        frames += 1;
        let mut views = Vec::new();
        for camera in &holdout {
            views.push(scene.draw(camera)?);
            let (seen, away) = scene.drawn();
            (drawn, hidden) = (drawn + seen, hidden + away);
        }
        spent += start.elapsed();
        views_drawn += views.len() as u32;
        let truths = replay.truth.at(set.master_nanos)?;
        for ((camera, view), truth) in holdout.iter().zip(&views).zip(&truths) {
            png::write_view(&args.out.join(camera.id.as_str()).join(format!("{number:06}.png")), view)?;
            let Some(truth) = truth else { continue };
            if let Some(mask) = &truth.mask {
                parts.extend(score_parts((&scene, camera), number, view, &truth.image, mask)?);
            }
            let mut score = score_view(&camera.id, number, view, &truth.image, truth.mask.as_ref())?;
            if let (Some(score), Some(mask)) = (&mut score, &truth.mask) {
                score.parts = error_parts(view, &truth.image, mask)?;
            }
            sheet.extend(score);
        }
        bar.set_message(sheet.progress());
    }
    bar.finish_and_clear();
    ensure!(views_drawn > 0, "nobody was found in {}; run with -v to see why", args.take.dataset.display());
    let far_share = far / f64::from(frames.max(1));
    let view_ms = 1e3 * spent.as_secs_f64() / f64::from(views_drawn);
    let mean_drawn = drawn as f64 / f64::from(views_drawn);
    let metrics = Metrics {
        avatar: args.avatar.display().to_string(),
        inputs: &args.take.inputs,
        holdout: &args.holdout,
        deformed: args.deformed,
        gaussians,
        mean_drawn,
        adapter: gpu.adapter_name(),
        mean: sheet.mean(),
        cameras: sheet.per_camera(),
        per_frame: sheet.frames(),
        parts: parts.per_camera(),
        far_share,
        view_ms,
    };
    write_whole(&args.out.join("metrics.json"), &serde_json::to_vec_pretty(&metrics)?)?;
    print!("{}", sheet.table());
    for CameraScore { camera: part, frames, psnr_db, ssim, flip, .. } in parts.per_camera() {
        println!("{part:<8} {frames:>6} {psnr_db:>9.2} {ssim:>8.4} {flip:>8.4}");
    }
    println!(
        "\n{views_drawn} views of {mean_drawn:.0} of {gaussians} Gaussians, {:.0} % of them left out as they face away, {view_ms:.1} ms \
         each; images in {}",
        100.0 * hidden as f64 / drawn.max(1) as f64,
        args.out.display()
    );
    print_far(far_share);
    Ok(())
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

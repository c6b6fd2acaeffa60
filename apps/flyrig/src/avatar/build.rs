//! `flyrig avatar build`: tracks the person of a take, then fits an avatar to its images.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use flyrig_avatar::{AtlasLayout, Avatar, AvatarScene, Bones, Card, ErrorWeights, Fit, FitSettings, LocalSettings};
use flyrig_fusion::BodySettings;
use flyrig_gpu::GpuContext;
use flyrig_renderer::HarmonicOrder;
use flyrig_report::{AvatarTake, png, progress_bar, stop};

use super::{
    arguments::{Atlas, BuildArgs, LocalArgs, Method, Order},
    checkpoint::Checkpoint,
    open_replay,
};

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
pub fn build(args: &BuildArgs, gpu: &GpuContext) -> Result<()> {
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
        FitSettings {
            seed: args.seed,
            pull: args.pull,
            light: args.light,
            refine_poses: args.refine_poses,
            skin_correction: args.skin_correction,
            weights: ErrorWeights { sharpness: args.sharpen, ..ErrorWeights::default() },
            ..FitSettings::default()
        },
    )?;
    if args.method != Method::Direct {
        let numbers = fit.use_networks(&mut avatar, &uvs, &local_settings(args.method, &args.local))?;
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
        method: method(args),
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

fn local_settings(method: Method, args: &LocalArgs) -> LocalSettings {
    LocalSettings {
        geometry: method != Method::LocalColors,
        colors: method != Method::LocalGeometry,
        group: args.group.into(),
        stages: args.stages.into(),
        layout: match args.atlas {
            Atlas::Uv => AtlasLayout::Uv,
            Atlas::FrontBack => AtlasLayout::FrontBack,
        },
        side: args.texels.into(),
        ..LocalSettings::default()
    }
}

/// The method, for the card.
fn method(args: &BuildArgs) -> String {
    let LocalArgs { group, stages, atlas, texels } = &args.local;
    let geometry = format!("{group} Gaussians an anchor, {stages} stages");
    let atlas = if *atlas == Atlas::Uv { "uv" } else { "front-back" };
    let colors = format!("atlas {atlas} of {texels} texels");
    match args.method {
        Method::Direct => "gaussians".to_owned(),
        Method::LogAvatar => format!("logavatar: {geometry}, {colors}"),
        Method::LocalGeometry => format!("local geometry: {geometry}"),
        Method::LocalColors => format!("local colors: {colors}"),
    }
}

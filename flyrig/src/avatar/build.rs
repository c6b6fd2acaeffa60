//! `flyrig avatar build`: tracks the person of a take, then fits an avatar to its images.

use std::{path::Path, time::Instant};

use anyhow::{Context as _, Result, ensure};
use flyrig_avatar::{
    AtlasLayout, Avatar, AvatarScene, Bones, Card, ErrorWeights, Fit, FitSettings, LocalSettings, TrainingFrame,
    TrainingView,
};
use flyrig_fusion::{BodySettings, Outcome, PersonId, person_surface};
use flyrig_gpu::GpuContext;
use flyrig_renderer::HarmonicOrder;
use flyrig_report::{frame_number, png, progress_bar, stop};
use flyrig_types::Camera;
use glam::{DVec3, Vec2};

use super::{
    arguments::{Atlas, BuildArgs, LocalArgs, Method, Order},
    open_replay,
};

/// Steps by which the time of one is measured.
const MEASURED_STEPS: u64 = 20;
/// Steps between updates of the progress.
const SHOW_EVERY: u64 = 20;
/// Pictures that are written while it is fitted.
const PICTURES: u64 = 10;

/// Results of tracking.
struct Tracked {
    frames: Vec<TrainingFrame>,
    views: Vec<TrainingView>,
    avatar: Avatar,
    /// Texture coordinates of its Gaussians.
    uvs: Vec<Vec2>,
    numbers: [u64; 2],
    /// First camera, for pictures.
    camera: Camera,
}

/// Runs the command.
pub fn build(args: &BuildArgs, gpu: &GpuContext) -> Result<()> {
    let folder = args.out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    ensure!(folder.is_dir(), "the folder {} does not exist; make it, or choose another --out", folder.display());
    let started = Instant::now();
    let Tracked { frames, views, mut avatar, uvs, numbers, camera } = track(args, gpu)?;
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
        scene.pose(avatar, &first.bones, Some(&first.translations));
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
            weights: ErrorWeights { sharpness: args.sharpen, ..ErrorWeights::default() },
            ..FitSettings::default()
        },
    )?;
    if args.method == Method::LogAvatar {
        let numbers = fit.use_networks(&mut avatar, &uvs, &local_settings(&args.local))?;
        println!("local networks of {numbers} numbers");
        picture(&avatar)?;
    }
    let before = fit.decibels(&avatar)?;
    let fitting = Instant::now();
    let mut total = args.steps;
    let bar = progress_bar(total.unwrap_or(MEASURED_STEPS), "avatar build");
    let mut done = 0;
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
    println!(
        "{done} steps in {seconds:.0} s ({:.1} ms each); training images {before:.2} -> {training_db:.2} dB; {} ({:.1} MB) and {}",
        1e3 * seconds / done.max(1) as f64,
        args.out.display(),
        std::fs::metadata(&args.out).map_or(0.0, |file| file.len() as f64 / 1e6),
        picture_path.display()
    );
    Ok(())
}

fn local_settings(args: &LocalArgs) -> LocalSettings {
    LocalSettings {
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
    match args.method {
        Method::Direct => "gaussians".to_owned(),
        Method::LogAvatar => {
            let atlas = if *atlas == Atlas::Uv { "uv" } else { "front-back" };
            format!("logavatar: {group} Gaussians an anchor, {stages} stages, atlas {atlas} of {texels} texels")
        }
    }
}

/// Tracks the person, as live.
fn track(args: &BuildArgs, gpu: &GpuContext) -> Result<Tracked> {
    let body = BodySettings { gaussians: args.gaussians as usize, nodes: args.nodes, ..BodySettings::default() };
    let mut replay = open_replay(&args.take, &[], (&body, None), gpu)?;
    let person = PersonId::default();
    let (mut frames, mut views, mut numbers) = (Vec::new(), Vec::new(), Vec::new());
    let bar = progress_bar(replay.count as u64, "track");
    while let Some(set) = replay.next_set()?.filter(|_| !stop::requested()) {
        bar.inc(1);
        if let Outcome::Held(reason) = replay.session.process(&set)? {
            tracing::warn!(frame = frame_number(&set), %reason, "frame not used");
            continue;
        }
        let Some((subject, pose)) = replay.session.subject(person).and_then(|subject| Some((subject, subject.pose()?)))
        else {
            continue;
        };
        let cameras = replay.session.viewed(person);
        views.extend(
            cameras
                .iter()
                .enumerate()
                .filter_map(|(k, camera)| TrainingView::cut(frames.len(), camera, subject.input(k))),
        );
        frames.push(TrainingFrame {
            bones: Bones::new(&subject.template().skeleton, pose),
            translations: subject.node_translations().to_vec(),
        });
        numbers.push(frame_number(&set));
    }
    bar.finish_and_clear();
    let subject = replay.session.subject(person);
    let (Some(subject), Some(first), Some(last)) = (subject, numbers.first(), numbers.last()) else {
        anyhow::bail!("nobody was found in {}; run with -v to see why", args.take.dataset.display());
    };
    let (surface, graph) = person_surface(subject.template(), &body)?;
    let deforms = frames.iter().any(|frame| !frame.translations.is_empty());
    let surface = if deforms { surface.inset() } else { surface };
    let colors: Vec<[f32; 3]> = replay.session.splats(person)?.iter().map(|splat| splat.color).collect();
    let order = match args.harmonics {
        Order::Zero => HarmonicOrder::Zero,
        Order::One => HarmonicOrder::One,
        Order::Two => HarmonicOrder::Two,
    };
    let mut avatar = Avatar::new(subject.template(), &surface, deforms.then_some(&graph), &colors, order)?;
    avatar.set_mean(frames.iter().map(|frame: &TrainingFrame| frame.translations.as_slice() as &[DVec3]));
    let camera = replay.session.rig().cameras.first().cloned().context("no camera")?;
    Ok(Tracked { frames, views, avatar, uvs: surface.uvs, numbers: [*first, last + 1], camera })
}

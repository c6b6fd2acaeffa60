//! `flyrig-bench perception`: errors of pose, shape and masks from images, and what each costs in the views.
//!
//! Every part of the input (pose, shape, masks) is given or estimated by itself, so that the table shows where the error of
//! the whole comes from.

use std::{collections::BTreeMap, path::Path, time::Instant};

use anyhow::{Context, Result, ensure};
use flyrig_body::{ShapeParams, Skeleton, Template, default_template, load_gltf};
use flyrig_fusion::{BodySettings, Origin, Outcome, PerceptionSettings, PersonId, SessionSettings};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_report::{progress_bar, write_whole};
use flyrig_takes::{Replay, ReplaySettings, dataset};
use flyrig_types::{Frame, FrameSet, Mask, Pose};
use glam::{DQuat, DVec3};
use serde::Serialize;

use crate::{
    cli::BenchPerceptionArgs,
    mask_errors::{MaskErrors, write_errors},
    rest,
};

/// Joints that are compared, by the names of the CMU skeleton.
pub(crate) const JOINTS: [&str; 14] = [
    "Hips",
    "Head",
    "LeftArm",
    "RightArm",
    "LeftForeArm",
    "RightForeArm",
    "LeftHand",
    "RightHand",
    "LeftUpLeg",
    "RightUpLeg",
    "LeftLeg",
    "RightLeg",
    "LeftFoot",
    "RightFoot",
];

/// Sources of the pose, the shape and the masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
struct Inputs {
    pose: Origin,
    shape: Origin,
    masks: Origin,
}

const ROWS: [Inputs; 6] = {
    use Origin::{Estimated, Given};
    [
        Inputs { pose: Given, shape: Given, masks: Given },
        Inputs { pose: Given, shape: Given, masks: Estimated },
        Inputs { pose: Estimated, shape: Given, masks: Given },
        Inputs { pose: Estimated, shape: Given, masks: Estimated },
        Inputs { pose: Estimated, shape: Estimated, masks: Given },
        Inputs { pose: Estimated, shape: Estimated, masks: Estimated },
    ]
};

/// One row of the table.
#[derive(Debug, Serialize)]
struct Row {
    dataset: String,
    inputs: Inputs,
    frames: usize,
    lost: u64,
    joint_mean_mm: f64,
    joint_p95_mm: f64,
    /// Mean change of a joint's error from frame to frame.
    jitter_mm: f64,
    /// Mean over the frames, by joint.
    joints_mm: BTreeMap<String, f64>,
    /// Mean angle between our parts and the true ones, by joint.
    turns_deg: BTreeMap<String, f64>,
    /// Distance of our body without clothes in its bind pose from the true one, and of the average body from it, millimetres.
    shape_mm: Option<f64>,
    average_shape_mm: Option<f64>,
    masks: MaskErrors,
    view: Option<CameraScore>,
    set_ms: f64,
    stages_ms: Vec<(String, f64)>,
}

/// Runs the command.
pub fn perception(args: &BenchPerceptionArgs, gpu: &GpuContext) -> Result<()> {
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    let chosen: Vec<Inputs> =
        ROWS.into_iter().filter(|row| args.only.is_empty() || args.only.contains(&code(*row))).collect();
    ensure!(!chosen.is_empty(), "--only names none of: {}", ROWS.map(code).join(", "));
    let mut rows = Vec::new();
    for folder in &args.datasets {
        for inputs in &chosen {
            rows.push(run(args, folder, *inputs, gpu)?);
            // After every row, so that a run that is stopped leaves what it has.
            write_whole(&args.out.join("perception.json"), &serde_json::to_vec_pretty(&rows)?)?;
            write_whole(&args.out.join("perception.md"), table(&rows).as_bytes())?;
        }
    }
    print!("{}", table(&rows));
    println!("{}; perception.md and perception.json in {}", gpu.fastest().adapter_name(), args.out.display());
    Ok(())
}

/// Letters of the sources, pose first: "gee" is a given pose with estimated shape and masks.
fn code(inputs: Inputs) -> String {
    let letter = |origin| if origin == Origin::Given { 'g' } else { 'e' };
    [inputs.pose, inputs.shape, inputs.masks].map(letter).iter().collect()
}

fn run(args: &BenchPerceptionArgs, folder: &Path, inputs: Inputs, gpu: &GpuContext) -> Result<Row> {
    let name = folder.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let truth = load_gltf(&dataset::gltf_file(folder)?)?;
    let track = truth.track.with_context(|| format!("the glTF file of {name} holds no animation"))?;
    let perception = PerceptionSettings {
        pose: inputs.pose,
        shape: (inputs.pose == Origin::Estimated).then_some(inputs.shape),
        masks: inputs.masks,
        look_after_m: args.look_after_m.unwrap_or(PerceptionSettings::default().look_after_m),
        plates: args.plates.clone().unwrap_or_default(),
        network: args.network.clone().unwrap_or_default(),
        ..PerceptionSettings::default()
    };
    let body = BodySettings::with_gaussians(args.gaussians);
    let settings = ReplaySettings {
        dataset: folder.to_owned(),
        inputs: args.inputs.clone(),
        holdout: if args.no_views { Vec::new() } else { args.holdout.clone() },
        session: SessionSettings { perception, body, ..SessionSettings::default() },
        fps: args.fps,
        frames: args.frames.clone(),
        lags_nanos: BTreeMap::new(),
        true_masks: true,
        true_joints: args.true_joints.clone(),
        body: None,
    };
    let mut replay = Replay::open(&settings, gpu)?;
    let holdout = replay.holdout.clone();
    let bar = progress_bar(replay.count as u64, format!("{name} {}", code(inputs)));
    let (mut sheet, mut joints, mut masks) = (ScoreSheet::default(), JointErrors::default(), MaskErrors::default());
    let (mut frames, mut seconds) = (0, 0.0);
    let person = PersonId::default();
    replay.session.hold_shape(args.no_views);
    while let Some(set) = replay.next_set()? {
        let start = Instant::now();
        let outcome = replay.session.process(&set)?;
        seconds += start.elapsed().as_secs_f64();
        bar.inc(1);
        frames += 1;
        let Some(subject) = replay.session.subject(person).filter(|_| outcome == Outcome::Updated) else { continue };
        if let Some(pose) = subject.pose() {
            joints.add(subject.template(), pose, &truth.template, &track.at(set.master_nanos));
        }
        for (view, camera) in replay.session.viewed(person).iter().enumerate() {
            let Some(frame) = frame_of(&set, camera.id.as_str()) else { continue };
            let (Some(subject), Some(truth)) = (replay.session.subject(person), &frame.mask) else { continue };
            masks.add(subject.input(view), truth);
            if args.mask_pictures.is_some_and(|every| set.index.is_multiple_of(every)) {
                let file = format!("{name}-{}-{}-{:06}.png", code(inputs), camera.id, set.index);
                write_errors(&args.out.join(file), subject.input(view), truth)?;
            }
        }
        if holdout.is_empty() {
            continue;
        }
        for (camera, truth) in holdout.iter().zip(replay.truth.at(set.master_nanos)?) {
            let Some(truth) = truth else { continue };
            let view = replay.session.render(camera)?;
            sheet.extend(score_view(&camera.id, set.index, &view, &truth.image, truth.mask.as_ref())?);
        }
    }
    bar.finish_and_clear();
    let average = default_template(&ShapeParams::default())?;
    let subject = replay.session.subject(person);
    let stages = replay.session.stages.summary();
    eprintln!("  {:?}", replay.session.stages.counts().collect::<Vec<_>>());
    let row = Row {
        dataset: name,
        inputs,
        frames,
        lost: replay.session.counts.lost,
        joint_mean_mm: joints.mean_mm(),
        joint_p95_mm: joints.percentile_mm(0.95),
        jitter_mm: joints.jitter_mm(),
        joints_mm: joints.by_joint_mm(),
        turns_deg: joints.turns_deg(),
        shape_mm: subject.and_then(|subject| rest::surface_mm(subject.body(), &truth.template)),
        average_shape_mm: rest::surface_mm(&average, &truth.template),
        masks: masks.mean(),
        view: sheet.mean(),
        set_ms: 1e3 * seconds / f64::from(frames.max(1) as u32),
        stages_ms: stages.into_iter().map(|s| (s.name.trim().to_owned(), f64::from(s.mean_ms))).collect(),
    };
    eprint!("{}", table(std::slice::from_ref(&row)).lines().skip(2).map(|l| format!("{l}\n")).collect::<String>());
    let list = |values: &BTreeMap<String, f64>| {
        values.iter().map(|(n, v)| format!("{n} {v:.0}")).collect::<Vec<_>>().join(", ")
    };
    if let (Some(ours), Some(average), Some(subject)) = (row.shape_mm, row.average_shape_mm, subject) {
        let [height, true_height] = [subject.body(), &truth.template].map(rest::height_m);
        eprintln!(
            "  body at rest: {ours:.1} mm from the true one, the average body's {average:.1} mm; {height:.3} m tall, \
             truth {true_height:.3} m"
        );
    }
    eprintln!("  mm: {}\n  degrees: {}", list(&row.joints_mm), list(&row.turns_deg));
    Ok(row)
}

fn frame_of<'a>(set: &'a FrameSet, camera: &str) -> Option<&'a Frame> {
    set.present().map(|(_, frame)| frame.as_ref()).find(|frame| frame.camera.as_str() == camera)
}

/// Distances of joints from the true ones.
#[derive(Debug, Default)]
struct JointErrors {
    /// World vectors, millimetres, by joint and frame.
    by_joint: BTreeMap<String, Vec<DVec3>>,
    /// Angle between our part and the true one, degrees.
    turns: BTreeMap<String, Vec<f64>>,
}

impl JointErrors {
    fn add(&mut self, template: &Template, pose: &Pose, truth: &Template, true_pose: &Pose) {
        let (ours, theirs) = (places(&template.skeleton, pose), places(&truth.skeleton, true_pose));
        for name in JOINTS {
            if let (Some(ours), Some(theirs)) = (ours.get(name), theirs.get(name)) {
                self.by_joint.entry(name.to_owned()).or_default().push(1e3 * (ours.0 - theirs.0));
                let angle = ours.1.angle_between(theirs.1).to_degrees();
                self.turns.entry(name.to_owned()).or_default().push(angle.min(360.0 - angle));
            }
        }
    }

    fn all(&self) -> Vec<f64> {
        self.by_joint.values().flatten().map(|e| e.length()).collect()
    }

    fn mean_mm(&self) -> f64 {
        mean(&self.all())
    }

    fn percentile_mm(&self, share: f64) -> f64 {
        let mut all = self.all();
        all.sort_by(f64::total_cmp);
        all.get(((all.len().max(1) - 1) as f64 * share) as usize).copied().unwrap_or(f64::NAN)
    }

    fn by_joint_mm(&self) -> BTreeMap<String, f64> {
        self.by_joint.iter().map(|(name, errors)| (name.clone(), mean(&lengths(errors)))).collect()
    }

    fn turns_deg(&self) -> BTreeMap<String, f64> {
        self.turns.iter().map(|(name, errors)| (name.clone(), mean(errors))).collect()
    }

    /// Mean change of an error from frame to frame.
    fn jitter_mm(&self) -> f64 {
        let changes = |errors: &Vec<DVec3>| errors.windows(2).map(|w| w[1].distance(w[0])).collect::<Vec<_>>();
        mean(&self.by_joint.values().flat_map(changes).collect::<Vec<_>>())
    }
}

fn lengths(vectors: &[DVec3]) -> Vec<f64> {
    vectors.iter().map(|v| v.length()).collect()
}

pub(crate) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// World places of the joints, and the rotations of the parts that they carry from the bind pose, by name.
pub(crate) fn places(skeleton: &Skeleton, pose: &Pose) -> BTreeMap<String, (DVec3, DQuat)> {
    let world = skeleton.world_from_canonical(pose);
    let place = |(joint, world): (&flyrig_body::Joint, &glam::DMat4)| {
        let origin = joint.joint_from_canonical.inverse().w_axis.truncate();
        let rotation = world.to_scale_rotation_translation().1.normalize();
        (joint.name.clone(), (world.transform_point3(origin), rotation))
    };
    skeleton.joints().iter().zip(&world).map(place).collect()
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| data | pose | shape | masks | joints mm | p95 | jitter | shape mm | mask IoU | boundary F | alpha in band | PSNR dB | SSIM | FLIP | \
         IoU | lost | ms a set |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for row in rows {
        let name = |origin| if origin == Origin::Given { "given" } else { "estimated" };
        let view = row.view.as_ref().map_or_else(
            || "- | - | - | -".to_owned(),
            |v| format!("{:.2} | {:.4} | {:.4} | {:.4}", v.psnr_db, v.ssim, v.flip, v.iou.unwrap_or(f64::NAN)),
        );
        let MaskErrors { iou, boundary_f, band_alpha, .. } = row.masks;
        text += &format!(
            "| {} | {} | {} | {} | {:.1} | {:.1} | {:.1} | {} | {iou:.4} | {boundary_f:.3} | {band_alpha:.3} | {view} | {} | {:.0} |\n",
            row.dataset,
            name(row.inputs.pose),
            name(row.inputs.shape),
            name(row.inputs.masks),
            row.joint_mean_mm,
            row.joint_p95_mm,
            row.jitter_mm,
            row.shape_mm.map_or_else(|| "-".to_owned(), |mm| format!("{mm:.1}")),
            row.lost,
            row.set_ms,
        );
    }
    text
}

/// Coverage of an input as the session took it in.
pub(crate) fn coverage(rgba: &[u8], like: &Mask) -> Option<Mask> {
    Mask::new(like.width(), like.height(), rgba.chunks_exact(4).map(|p| p[3]).collect()).ok()
}

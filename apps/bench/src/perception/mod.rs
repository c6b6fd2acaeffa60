//! `flyrig-bench perception`: errors of pose, shape and masks from images, and the error in the views that each causes.
//!
//! Pose, shape and masks are each given or estimated, so that the table attributes the total error to them.

mod bind_pose;
#[cfg(test)]
mod first_sets_tests;
pub mod hands;
#[cfg(test)]
mod hands_tests;
pub mod landmarks;
mod mask_errors;
pub mod masks;
pub mod stress;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context, Result, ensure};
use clap::Args;
use flyrig_body::{ShapeParams, Template, default_template, load_gltf};
use flyrig_fusion::{BodySettings, Origin, Outcome, PerceptionSettings, PersonId, SessionSettings};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_report::{
    arguments::{GaussiansArgs, OutputArgs},
    progress_bar, write_whole,
};
use flyrig_takes::{Replay, ReplaySettings, dataset};
use flyrig_tracker::PoseSettings;
use flyrig_types::{Camera, Frame, FrameSet, Pose};
use glam::DVec3;
use serde::Serialize;

use crate::harness::{
    arguments::RecordedArgs,
    joints::{JOINTS, places},
    statistics::{mean, percentile},
};
use mask_errors::{MaskErrors, write_errors};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-perception")))]
pub struct BenchPerceptionArgs {
    /// Data sets with true masks and an animated glTF body, as `flyrig sim export` writes them.
    #[arg(required = true)]
    pub datasets: Vec<PathBuf>,
    /// Run only these rows: letters of pose, shape and masks, g for given and e for estimated, comma separated.
    #[arg(long, value_delimiter = ',')]
    pub only: Vec<String>,
    /// Joints, by parts of their names, whose orientations are replaced by the true ones, or "place" for the true position, comma
    /// separated. For rows with an estimated pose and the given shape.
    #[arg(long, value_delimiter = ',')]
    pub true_joints: Vec<String>,
    /// Skip the deformation and the views: poses, shapes and masks alone, in a fraction of the time.
    #[arg(long)]
    pub no_views: bool,
    /// Value of `perception.look_after_m`: motion of the body in a view before the network runs on that view again, metres.
    #[arg(long)]
    pub look_after_m: Option<f64>,
    /// Folder of the plates CAM.png, by default that of the data set; an empty folder measures without plates.
    #[arg(long, value_name = "FOLDER")]
    pub plates: Option<PathBuf>,
    /// Interval of the frame sets whose masks are written as images: red where the mask is too small, blue where it is too large.
    #[arg(long, value_name = "SETS", value_parser = clap::value_parser!(u64).range(1..))]
    pub mask_pictures: Option<u64>,
    /// Landmark network, as `--network` of `flyrig run` names it.
    #[arg(long, value_name = "NETWORK")]
    pub network: Option<PathBuf>,
    #[command(flatten)]
    pub replay: RecordedArgs,
    #[command(flatten)]
    pub output: OutputArgs,
    #[command(flatten)]
    pub surface: GaussiansArgs,
}

/// Joint that the others hang from.
const HIPS: &str = "Hips";

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
    /// Mean error of the joints relative to the hips, and of the hips along the line of sight of the first input: a single camera does not
    /// measure how far away a person is.
    from_hips_mm: f64,
    hips_depth_mm: f64,
    /// Mean change of the error of a joint from frame to frame.
    jitter_mm: f64,
    /// Mean error by joint.
    joints_mm: BTreeMap<String, f64>,
    /// Mean angle between the estimated and the true orientation, by joint.
    turns_deg: BTreeMap<String, f64>,
    /// Distances from the true body in the bind pose, millimetres: of the estimated body without clothes, and of the average body.
    shape_mm: Option<f64>,
    average_shape_mm: Option<f64>,
    masks: MaskErrors,
    view: Option<CameraScore>,
    set_ms: f64,
    stages_ms: Vec<(String, f64)>,
}

/// Runs the command.
pub fn perception(args: &BenchPerceptionArgs, gpu: &GpuContext) -> Result<()> {
    args.output.create()?;
    let chosen: Vec<Inputs> =
        ROWS.into_iter().filter(|row| args.only.is_empty() || args.only.contains(&code(*row))).collect();
    ensure!(!chosen.is_empty(), "--only names none of: {}", ROWS.map(code).join(", "));
    let mut rows = Vec::new();
    for folder in &args.datasets {
        for inputs in &chosen {
            rows.push(run(args, folder, *inputs, gpu)?);
            // After every row, so that a run that is stopped leaves what it has.
            write_whole(&args.output.out.join("perception.json"), &serde_json::to_vec_pretty(&rows)?)?;
            write_whole(&args.output.out.join("perception.md"), table(&rows).as_bytes())?;
        }
    }
    print!("{}", table(&rows));
    println!("{}; perception.md and perception.json in {}", gpu.fastest().adapter_name(), args.output.out.display());
    Ok(())
}

/// Returns the letters of the sources of pose, shape and masks: "gee" is a given pose with estimated shape and masks.
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
        tracker: PoseSettings {
            look_after_m: args.look_after_m.unwrap_or(PoseSettings::default().look_after_m),
            ..PoseSettings::default()
        },
        plates: args.plates.clone().unwrap_or_default(),
        network: args.network.clone().unwrap_or_default(),
        ..PerceptionSettings::default()
    };
    let body = BodySettings::with_gaussians(args.surface.gaussians);
    let settings = ReplaySettings {
        dataset: folder.to_owned(),
        inputs: args.replay.inputs.clone(),
        holdout: if args.no_views { Vec::new() } else { args.replay.holdout.clone() },
        session: SessionSettings { perception, body, ..SessionSettings::default() },
        fps: args.replay.rate.fps,
        frames: args.replay.frames.clone(),
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
            let eye = replay.session.rig().cameras.first().map(Camera::position);
            joints.add((subject.template(), pose), (&truth.template, &track.at(set.master_nanos)), eye);
        }
        for (view, camera) in replay.session.viewed(person).iter().enumerate() {
            let Some(frame) = frame_of(&set, camera.id.as_str()) else { continue };
            let (Some(subject), Some(truth)) = (replay.session.subject(person), &frame.mask) else { continue };
            masks.add(subject.input(view), truth);
            if args.mask_pictures.is_some_and(|every| set.index.is_multiple_of(every)) {
                let file = format!("{name}-{}-{}-{:06}.png", code(inputs), camera.id, set.index);
                write_errors(&args.output.out.join(file), subject.input(view), truth)?;
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
        from_hips_mm: joints.mean_from_hips_mm(),
        hips_depth_mm: mean(&joints.hips_depth_mm),
        jitter_mm: joints.jitter_mm(),
        joints_mm: joints.by_joint_mm(),
        turns_deg: joints.turns_deg(),
        shape_mm: subject.and_then(|subject| bind_pose::surface_mm(subject.body(), &truth.template)),
        average_shape_mm: bind_pose::surface_mm(&average, &truth.template),
        masks: masks.mean(),
        view: sheet.mean(),
        set_ms: 1e3 * seconds / f64::from(frames.max(1) as u32),
        stages_ms: stages.into_iter().map(|s| (s.name.trim().to_owned(), f64::from(s.mean_ms))).collect(),
    };
    eprint!("{}", table(std::slice::from_ref(&row)).lines().skip(2).map(|l| format!("{l}\n")).collect::<String>());
    let list = |values: &BTreeMap<String, f64>| {
        values.iter().map(|(n, v)| format!("{n} {v:.0}")).collect::<Vec<_>>().join(", ")
    };
    if let Some(subject) = subject {
        print_body(&row, subject.body(), &truth.template);
    }
    eprintln!("  mm: {}\n  degrees: {}", list(&row.joints_mm), list(&row.turns_deg));
    Ok(row)
}

/// Prints how far the estimated body at rest is from the true one.
fn print_body(row: &Row, body: &Template, truth: &Template) {
    let (Some(ours), Some(average)) = (row.shape_mm, row.average_shape_mm) else { return };
    let [height, true_height] = [body, truth].map(bind_pose::height_m);
    eprintln!(
        "  body at rest: {ours:.1} mm from the true one, the average body's {average:.1} mm; {height:.3} m tall, \
         truth {true_height:.3} m"
    );
}

fn frame_of<'a>(set: &'a FrameSet, camera: &str) -> Option<&'a Frame> {
    set.present().map(|(_, frame)| frame.as_ref()).find(|frame| frame.camera.as_str() == camera)
}

/// Errors of joints.
#[derive(Debug, Default)]
struct JointErrors {
    /// Error vectors by joint and frame, world axes, millimetres.
    by_joint: BTreeMap<String, Vec<DVec3>>,
    /// Angles to the true orientation by joint and frame, degrees.
    turns: BTreeMap<String, Vec<f64>>,
    /// Absolute error of the hips along the line of sight of a camera, by frame, millimetres.
    hips_depth_mm: Vec<f64>,
}

impl JointErrors {
    /// Adds a pose and the true one, of a body each. `eye` is the place of a camera, world metres.
    fn add(
        &mut self,
        (template, pose): (&Template, &Pose),
        (truth, true_pose): (&Template, &Pose),
        eye: Option<DVec3>,
    ) {
        let (ours, theirs) = (places(&template.skeleton, pose), places(&truth.skeleton, true_pose));
        if let (Some(ours), Some(theirs), Some(eye)) = (ours.get(HIPS), theirs.get(HIPS), eye) {
            self.hips_depth_mm.push(1e3 * (ours.0 - theirs.0).dot((theirs.0 - eye).normalize_or_zero()).abs());
        }
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
        percentile(&self.all(), share)
    }

    fn mean_from_hips_mm(&self) -> f64 {
        let Some(hips) = self.by_joint.get(HIPS) else { return f64::NAN };
        let others = self.by_joint.iter().filter(|(name, _)| *name != HIPS);
        mean(
            &others
                .flat_map(|(_, errors)| errors.iter().zip(hips).map(|(e, hips)| e.distance(*hips)))
                .collect::<Vec<_>>(),
        )
    }

    fn by_joint_mm(&self) -> BTreeMap<String, f64> {
        self.by_joint.iter().map(|(name, errors)| (name.clone(), mean(&lengths(errors)))).collect()
    }

    fn turns_deg(&self) -> BTreeMap<String, f64> {
        self.turns.iter().map(|(name, errors)| (name.clone(), mean(errors))).collect()
    }

    /// Returns the mean change of an error from frame to frame, millimetres.
    fn jitter_mm(&self) -> f64 {
        let changes = |errors: &Vec<DVec3>| errors.windows(2).map(|w| w[1].distance(w[0])).collect::<Vec<_>>();
        mean(&self.by_joint.values().flat_map(changes).collect::<Vec<_>>())
    }
}

fn lengths(vectors: &[DVec3]) -> Vec<f64> {
    vectors.iter().map(|v| v.length()).collect()
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| data | pose | shape | masks | joints mm | p95 | from hips | hips depth | jitter | shape mm | mask IoU | boundary F | alpha in band | PSNR dB | SSIM | FLIP | \
         IoU | lost | ms per frame set |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for row in rows {
        let name = |origin| if origin == Origin::Given { "given" } else { "estimated" };
        let view = row.view.as_ref().map_or_else(
            || "- | - | - | -".to_owned(),
            |v| format!("{:.2} | {:.4} | {:.4} | {:.4}", v.psnr_db, v.ssim, v.flip, v.iou.unwrap_or(f64::NAN)),
        );
        let MaskErrors { iou, boundary_f, band_alpha, .. } = row.masks;
        text += &format!(
            "| {} | {} | {} | {} | {:.1} | {:.1} | {:.1} | {:.1} | {:.1} | {} | {iou:.4} | {boundary_f:.3} | {band_alpha:.3} | {view} | {} | {:.0} |\n",
            row.dataset,
            name(row.inputs.pose),
            name(row.inputs.shape),
            name(row.inputs.masks),
            row.joint_mean_mm,
            row.joint_p95_mm,
            row.from_hips_mm,
            row.hips_depth_mm,
            row.jitter_mm,
            row.shape_mm.map_or_else(|| "-".to_owned(), |mm| format!("{mm:.1}")),
            row.lost,
            row.set_ms,
        );
    }
    text
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_body_that_is_too_far_away_is_right_relative_to_its_hips() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let truth = body.skeleton.rest_pose();
        let mut pose = truth.clone();
        pose.root_translation += DVec3::new(0.03, 0.0, 0.1);
        let hips = places(&body.skeleton, &truth)[HIPS].0;
        let mut errors = JointErrors::default();
        errors.add((&body, &pose), (&body, &truth), Some(hips - 3.0 * DVec3::Z));
        assert!(errors.mean_from_hips_mm() < 1e-6 && (errors.mean_mm() - 10900.0f64.sqrt()).abs() < 1e-6, "{errors:?}");
        assert!((mean(&errors.hips_depth_mm) - 100.0).abs() < 1e-6, "{errors:?}");
        assert!(JointErrors::default().mean_from_hips_mm().is_nan());
        // Without a camera there is no line of sight.
        errors.add((&body, &pose), (&body, &truth), None);
        assert_eq!(errors.hips_depth_mm.len(), 1);
    }
}

//! `flyrig-bench hands`: fingertips and the head's rotation on simulated people, and the cost of a crop.

use std::{path::PathBuf, sync::Arc, time::Instant};

use anyhow::{Context, Result};
use clap::{Args, builder::TypedValueParser as _};
use flyrig_gpu::GpuContext;
use flyrig_report::{png, progress_bar, write_whole};
use flyrig_sim::{MotionConfig, MotionKind, PersonConfig, RingConfig, SimConfig, Simulator};
use flyrig_tracker::{
    FACE_SIDE, FaceNet, FaceStudy, HAND_LANDMARKS, HAND_SIDE, HandConfig, HandNet, HandTracker, HandsQuality,
    PoseConfig, PoseEstimator, PoseNet,
};
use flyrig_types::{Frame, FrameSet, Image, Mask, Pose};
use glam::DVec3;

use crate::harness::statistics::{mean, percentile};

/// Arguments of the command.
#[derive(Debug, Args)]
pub struct BenchHandsArgs {
    /// Lengths of the hands in the images, pixels, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "20,40,80")]
    pub px: Vec<f64>,
    /// Seed of the first person; further people have the following seeds.
    #[arg(long, default_value_t = 401)]
    pub seed: u64,
    /// Number of people.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub people: u64,
    /// Frame sets of each person, 0.2 seconds apart.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub frames: u64,
    /// Number of cameras on a ring of 3 m radius.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=32).map(usize::from))]
    pub cameras: usize,
    /// ONNX file of another hand network with the same outputs.
    #[arg(long)]
    pub hand_net: Option<PathBuf>,
    /// Folder for the images of the first frame set of each person.
    #[arg(long)]
    pub images: Option<PathBuf>,
    /// Estimate the positions of the face's landmarks instead and print their table, at the largest of the lengths.
    #[arg(long)]
    pub learn_face: bool,
}

/// Length of a hand, from which image sizes are computed, metres.
const HAND_M: f64 = 0.18;
/// Distance of the cameras, metres, and their focal length in image heights.
const RADIUS_M: f64 = 3.0;
const FOCAL_HEIGHTS: f64 = 1.36;
/// Seconds between measured frame sets: each shows other fingers.
const SET_SECS: f64 = 0.2;
/// Motions, by person.
const MOTIONS: [MotionKind; 4] = [MotionKind::Wave, MotionKind::Turn, MotionKind::Reach, MotionKind::Dance];
/// Joints of the body without fingers.
const BODY_JOINTS: usize = 31;
/// Fingertips among the landmarks.
const TIPS: [usize; 5] = [4, 8, 12, 16, 20];

/// Errors of one way to estimate hands and head.
#[derive(Debug, Clone, Default)]
struct Errors {
    /// Distances of fingertips relative to their wrists, millimetres.
    tips_mm: Vec<f64>,
    /// Distances of hands whose fingers were fitted, millimetres.
    fitted_mm: Vec<f64>,
    head_deg: Vec<f64>,
    head_fitted_deg: Vec<f64>,
    hands: usize,
    fitted: usize,
    heads_fitted: usize,
    sets: usize,
    crops: [usize; 2],
    secs: [f64; 2],
}

/// Runs the command.
pub fn hands(args: &BenchHandsArgs, gpu: &GpuContext) -> Result<()> {
    if args.learn_face {
        return learn_face(args, gpu);
    }
    let hand_net = match &args.hand_net {
        Some(file) => HandNet::from_onnx(&std::fs::read(file).with_context(|| file.display().to_string())?)?,
        None => HandNet::embedded()?,
    };
    cost(&hand_net)?;
    println!(
        "{:>4} {:>7} {:<26} {:>8} {:>8} {:>8} {:>9} {:>9} {:>9} {:>9} {:>8} {:>8}",
        "px",
        "cameras",
        "body, hands",
        "tips mm",
        "median",
        "95 %",
        "fitted",
        "fitted mm",
        "head deg",
        "seen deg",
        "crops",
        "ms per frame set"
    );
    for &px in &args.px {
        let names = ["true, rest", "true, relaxed", "true, estimated", "estimated, relaxed", "estimated, estimated"];
        let mut all: Vec<Errors> = vec![Errors::default(); names.len()];
        for person in 0..args.people {
            measure(args, gpu, px, person, &hand_net, &mut all)?;
        }
        for (name, errors) in names.iter().zip(&all) {
            print_row(px, args.cameras, name, errors);
        }
    }
    Ok(())
}

/// Simulates a person whose hands are `px` pixels long.
fn person(args: &BenchHandsArgs, gpu: &GpuContext, px: f64, person: u64) -> Result<Simulator> {
    let height = (px * RADIUS_M / (HAND_M * FOCAL_HEIGHTS)).round().clamp(16.0, 4096.0) as u32;
    let kind = MOTIONS[person as usize % MOTIONS.len()];
    let config = SimConfig {
        seed: args.seed + person,
        person: PersonConfig { fingers: true, ..PersonConfig::default() },
        motion: MotionConfig { kind, ..MotionConfig::default() },
        cameras: RingConfig {
            count: args.cameras,
            radius_m: RADIUS_M,
            focal_heights: FOCAL_HEIGHTS,
            ..RingConfig::default()
        },
        width: height,
        height,
        ..SimConfig::default()
    };
    Ok(Simulator::new(gpu, &config)?)
}

fn frame_set(simulator: &mut Simulator, index: u64) -> Result<FrameSet> {
    let nanos = (index as f64 * SET_SECS * 1e9) as i64;
    let slots: Vec<usize> = (0..simulator.rig().cameras.len()).collect();
    let pictures = simulator.capture_all(nanos, &slots)?;
    let frame = |(slot, (image, mask)): (usize, (Image, Mask))| {
        let camera = simulator.rig().cameras[slot].id.clone();
        let frame =
            Frame { camera, sequence: index, capture_nanos: nanos, exposure_nanos: None, image, mask: Some(mask) };
        Some(Arc::new(frame))
    };
    Ok(FrameSet { index, master_nanos: nanos, frames: pictures.into_iter().enumerate().map(frame).collect() })
}

/// Returns the pose without its fingers.
fn body_of(pose: &Pose) -> Pose {
    Pose { joint_rotations: pose.joint_rotations.iter().copied().take(BODY_JOINTS).collect(), ..pose.clone() }
}

fn measure(
    args: &BenchHandsArgs,
    gpu: &GpuContext,
    px: f64,
    index: u64,
    hand_net: &HandNet,
    all: &mut [Errors],
) -> Result<()> {
    let mut simulator = person(args, gpu, px, index)?;
    let (rig, template) = (simulator.rig().clone(), simulator.template().clone());
    let config = HandConfig { min_hand_px: 0.0, min_face_px: 0.0, crops: 0, ..HandConfig::default() };
    let tracker = |config| HandTracker::with_nets(hand_net.clone(), FaceNet::embedded()?, &template, &rig, config);
    let off = HandConfig { fingers: false, head: false, ..config };
    let [mut on_true, mut on_estimate] = [tracker(config)?, tracker(config)?];
    let [mut relaxed_true, mut relaxed_estimate] = [tracker(off)?, tracker(off)?];
    let body_config = PoseConfig { masks: false, ..PoseConfig::default() };
    let mut body = PoseEstimator::new(PoseNet::embedded()?, &template, &rig, body_config)?;
    let bar = progress_bar(args.frames, format!("{px} px, person {}", args.seed + index));
    for number in 0..args.frames {
        let set = frame_set(&mut simulator, number)?;
        let truth = simulator.pose(set.master_nanos);
        let given = body_of(&truth);
        let mut add = |row: usize, tracker: &HandTracker, pose: &Pose, quality: Option<HandsQuality>| {
            all[row].add(tracker, pose, &truth, quality).context("a pose that does not fit its template")
        };
        let mut rest = given.clone();
        rest.joint_rotations.extend(template.skeleton.joints()[BODY_JOINTS..].iter().map(|joint| joint.rest_rotation));
        add(0, &on_true, &rest, None)?;
        let (pose, _) = relaxed_true.estimate(&set, &given)?;
        add(1, &relaxed_true, &pose, None)?;
        let (pose, quality) = on_true.estimate(&set, &given)?;
        add(2, &on_true, &pose, Some(quality))?;
        if number == 0
            && let Some(folder) = &args.images
        {
            pictures(folder, &format!("{px}px-{}", args.seed + index), &on_true, &set, &rig, &pose)?;
        }
        if let Ok(estimate) = body.estimate(&set) {
            let (pose, _) = relaxed_estimate.estimate(&set, &body_of(&estimate.pose))?;
            add(3, &relaxed_estimate, &pose, None)?;
            let (pose, quality) = on_estimate.estimate(&set, &body_of(&estimate.pose))?;
            add(4, &on_estimate, &pose, Some(quality))?;
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(())
}

impl Errors {
    fn add(&mut self, tracker: &HandTracker, pose: &Pose, truth: &Pose, quality: Option<HandsQuality>) -> Option<()> {
        let (found, real) = (tracker.hand_landmarks(pose)?, tracker.hand_landmarks(truth)?);
        let from_wrist = |hand: &[DVec3; HAND_LANDMARKS], tip: usize| hand[tip] - hand[0];
        for side in 0..2 {
            let is_fitted = quality.is_some_and(|q| q.hands[side].views > 0);
            self.hands += 1;
            self.fitted += usize::from(is_fitted);
            for tip in TIPS {
                let mm = from_wrist(&found[side], tip).distance(from_wrist(&real[side], tip)) * 1e3;
                self.tips_mm.push(mm);
                if is_fitted {
                    self.fitted_mm.push(mm);
                }
            }
        }
        let deg = tracker.head_rotation(pose)?.angle_between(tracker.head_rotation(truth)?).to_degrees();
        self.head_deg.push(deg);
        self.sets += 1;
        if let Some(quality) = quality {
            if quality.head.views > 0 {
                self.head_fitted_deg.push(deg);
                self.heads_fitted += 1;
            }
            for k in 0..2 {
                self.crops[k] += quality.crops[k];
                self.secs[k] += quality.seconds[k];
            }
        }
        Some(())
    }
}

fn print_row(px: f64, cameras: usize, name: &str, errors: &Errors) {
    let number = |value: f64| if value.is_finite() { format!("{value:.1}") } else { "-".to_owned() };
    let sets = errors.sets.max(1) as f64;
    let fitted = format!("{}/{}", errors.fitted, errors.hands);
    let crops = format!("{:.1}", (errors.crops[0] + errors.crops[1]) as f64 / sets);
    println!(
        "{px:>4} {cameras:>7} {name:<26} {:>8} {:>8} {:>8} {fitted:>9} {:>9} {:>9} {:>9} {crops:>8} {:>8.1}",
        number(mean(&errors.tips_mm)),
        number(percentile(&errors.tips_mm, 0.5)),
        number(percentile(&errors.tips_mm, 0.95)),
        number(mean(&errors.fitted_mm)),
        number(mean(&errors.head_deg)),
        number(mean(&errors.head_fitted_deg)),
        (errors.secs[0] + errors.secs[1]) * 1e3 / sets,
    );
}

/// Measures and prints the run time of each network per crop, on one thread.
fn cost(hand_net: &HandNet) -> Result<()> {
    const RUNS: u32 = 20;
    let face_net = FaceNet::embedded()?;
    let (hand, face) = (vec![0.4; HAND_SIDE * HAND_SIDE * 3], vec![0.4; FACE_SIDE * FACE_SIDE * 3]);
    let start = Instant::now();
    for _ in 0..RUNS {
        hand_net.run(&hand)?;
    }
    let hand_ms = start.elapsed().as_secs_f64() * 1e3 / f64::from(RUNS);
    let start = Instant::now();
    for _ in 0..RUNS {
        face_net.run(&face)?;
    }
    let face_ms = start.elapsed().as_secs_f64() * 1e3 / f64::from(RUNS);
    println!("hand network {hand_ms:.1} ms per crop, face network {face_ms:.1} ms per crop, one thread each");
    Ok(())
}

/// Writes the images of a frame set with the landmarks of the estimated hands as green dots.
fn pictures(
    folder: &std::path::Path,
    name: &str,
    tracker: &HandTracker,
    set: &FrameSet,
    rig: &flyrig_types::Rig,
    pose: &Pose,
) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let hands = tracker.hand_landmarks(pose).context("a pose that does not fit its template")?;
    for (slot, frame) in set.present() {
        let (image, camera) = (&frame.image, &rig.cameras[slot]);
        let (width, height) = (image.width() as usize, image.height() as usize);
        let mut bytes = image.bytes().to_vec();
        for pixel in hands.iter().flatten().filter_map(|point| camera.project(*point)) {
            let (x, y) = (pixel.x.round(), pixel.y.round());
            if x >= 0.0 && y >= 0.0 && (x as usize) < width && (y as usize) < height {
                let at = (y as usize * width + x as usize) * 3;
                bytes[at..at + 3].copy_from_slice(&[0, 255, 0]);
            }
        }
        let plain = png::encode_rgb(image.bytes(), image.width(), image.height())?;
        write_whole(&folder.join(format!("{name}-{}.png", camera.id)), &plain)?;
        let marked = png::encode_rgb(&bytes, image.width(), image.height())?;
        write_whole(&folder.join(format!("{name}-{}-landmarks.png", camera.id)), &marked)?;
    }
    Ok(())
}

/// Estimates and prints the table of the face's landmarks in `tracker/src/hands/face_points.rs`.
fn learn_face(args: &BenchHandsArgs, gpu: &GpuContext) -> Result<()> {
    let mut study = FaceStudy::new(FaceNet::embedded()?);
    let px = args.px.iter().copied().fold(0.0, f64::max);
    let (mut seen, mut looked) = (0, 0);
    for index in 0..args.people {
        let mut simulator = person(args, gpu, px, index)?;
        let (rig, template) = (simulator.rig().clone(), simulator.template().clone());
        let bar = progress_bar(args.frames, format!("face of person {}", args.seed + index));
        for number in 0..args.frames {
            let set = frame_set(&mut simulator, number)?;
            let pose = simulator.pose(set.master_nanos);
            for (slot, frame) in set.present() {
                looked += 1;
                seen += u32::from(study.add(&rig.cameras[slot], &frame.image, &template, &pose)?);
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
    }
    println!("// {seen} faces in {looked} images; median distance of each landmark in mm");
    for (landmark, place, off) in study.places() {
        let [x, y, z] = (place * 1e3).to_array();
        println!("    FacePoint {{ landmark: {landmark}, place_mm: [{x:.1}, {y:.1}, {z:.1}] }}, // {:.1}", off * 1e3);
    }
    Ok(())
}

//! `flyrig-bench stress`: disturbances of perception, one at a time, with everything estimated from images.
//!
//! Every case is one simulated person in front of a rig: undisturbed, disturbed, and undisturbed again. Joints are compared with the true
//! ones; the recovery is the time from the end of the disturbance until their error is as small as before.

use std::{collections::BTreeMap, path::Path, sync::Arc};

use anyhow::Result;
use clap::{Args, builder::TypedValueParser as _};
use flyrig_body::{ShapeParams, default_template};
use flyrig_fusion::{
    EstimatedPerception, Perception as _, PerceptionSettings, PersonObservation, SeenPerson, StageTimes,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::mask_iou;
use flyrig_report::{arguments::FpsArgs, paint_outline, png, progress_bar, write_whole};
use flyrig_sim::{
    Build, LightConfig, LightSwitch, MotionConfig, MotionKind, PersonConfig, RingConfig, SceneConfig, SceneKind,
    SimConfig, Simulator,
};
use flyrig_types::{Frame, FrameSet, Image, Mask, PixelFormat};
use glam::{DQuat, DVec3};

use crate::harness::{
    arguments::SimulationArgs,
    images::copy,
    joints::{JOINTS, places},
    statistics::{mean, percentile},
};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-stress")), mut_arg("seed", |arg| arg.default_value("501")), mut_arg("side", |arg| arg.default_value("384").value_parser(clap::value_parser!(u32).range(96..=2048))), mut_arg("fps", |arg| arg.default_value("10")))]
pub struct BenchStressArgs {
    /// Run only cases whose names contain one of these texts, comma separated.
    #[arg(long, value_delimiter = ',')]
    pub only: Vec<String>,
    /// Number of cameras on a ring of 3 m radius.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u8).range(1..=16).map(usize::from))]
    pub cameras: usize,
    #[command(flatten)]
    pub simulation: SimulationArgs,
    #[command(flatten)]
    pub rate: FpsArgs,
}

/// Colour of a mask's outline.
const OUTLINE: [u8; 3] = [0, 255, 80];
/// Measured time after the disturbance, seconds.
const AFTER_SECS: f64 = 2.0;
/// Time before the disturbance, seconds; a person is measured for 1.5 s first.
const BEFORE_SECS: f64 = 3.0;
/// Threshold of the recovery: multiple of the joint error before, and smallest threshold, millimetres.
const RECOVERED: (f64, f64) = (1.5, 30.0);

/// Disturbance between two undisturbed periods.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Disturbance {
    /// The motion itself.
    Motion,
    /// Distance of the person from the middle, metres: parts leave the images.
    OffCentre(f64),
    /// Black images of one camera.
    Covered,
    /// No frames of one camera.
    Missing,
    /// Black images of all cameras.
    Dark,
    /// Factor on the light of the lamps.
    Lights(f64),
    /// Factor on the exposure of one camera.
    Exposure(f64),
    /// A second person who walks past.
    PasserBy,
    /// Fraction of the difference between person and background that is left below the neck.
    Camouflaged(f64),
    /// An empty room.
    Away,
    /// An empty room, then a person of another build.
    Replaced,
}

struct Case {
    name: &'static str,
    motion: MotionKind,
    speed: f64,
    secs: f64,
    what: Disturbance,
}

const fn case(name: &'static str, motion: MotionKind, secs: f64, what: Disturbance) -> Case {
    Case { name, motion, speed: 1.0, secs, what }
}

const CASES: [Case; 18] = [
    Case { name: "turn by 360 degrees", motion: MotionKind::Turn, speed: 2.0, secs: 5.0, what: Disturbance::Motion },
    case("crossed arms", MotionKind::CrossArms, 4.0, Disturbance::Motion),
    case("sitting", MotionKind::Sit, 4.0, Disturbance::Motion),
    case("lying", MotionKind::Lie, 8.0, Disturbance::Motion),
    case("dance", MotionKind::Dance, 4.0, Disturbance::Motion),
    case("jump", MotionKind::Jump, 4.0, Disturbance::Motion),
    case("0.7 m from the middle", MotionKind::Wave, 3.0, Disturbance::OffCentre(0.7)),
    case("1.1 m from the middle", MotionKind::Wave, 3.0, Disturbance::OffCentre(1.1)),
    case("one camera covered", MotionKind::Wave, 5.0, Disturbance::Covered),
    case("one camera missing", MotionKind::Wave, 5.0, Disturbance::Missing),
    case("all cameras dark", MotionKind::Wave, 1.0, Disturbance::Dark),
    case("lights to a third", MotionKind::Wave, 4.0, Disturbance::Lights(0.33)),
    case("lights to double", MotionKind::Wave, 4.0, Disturbance::Lights(2.0)),
    case("exposure of one camera halved", MotionKind::Wave, 4.0, Disturbance::Exposure(0.5)),
    case("somebody walks past", MotionKind::Wave, 5.0, Disturbance::PasserBy),
    case("clothes like the background", MotionKind::Wave, 4.0, Disturbance::Camouflaged(0.2)),
    case("gone for 4 s", MotionKind::Wave, 4.0, Disturbance::Away),
    case("replaced by a taller person", MotionKind::Wave, 4.0, Disturbance::Replaced),
];

/// Result of one case.
#[derive(Debug, Default)]
struct Row {
    name: &'static str,
    /// Mean joint errors before, during and after, millimetres; NaN without a pose.
    mm: [f64; 3],
    p95_mm: [f64; 3],
    /// Frame sets, and those in which the person was not found, before, during and after.
    sets: [usize; 3],
    lost: [usize; 3],
    /// Seconds from the end of the disturbance to the recovery; `None` without one.
    recovery_secs: Option<f64>,
    /// Mean mask IoU before, during and after.
    iou: [f64; 3],
    set_ms: f64,
}

/// Runs the command.
pub fn stress(args: &BenchStressArgs, gpu: &GpuContext) -> Result<()> {
    args.simulation.output.create()?;
    let mut table = String::from(
        "| disturbance | joints mm (95 %) before | during | after | mask IoU before | during | after | not found before | during | \
         after | recovery s | ms per frame set |\n|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for (index, case) in CASES.iter().enumerate() {
        if !args.only.is_empty() && !args.only.iter().any(|part| case.name.contains(part.as_str())) {
            continue;
        }
        let row = run(args, gpu, case, index)?;
        let line = format_row(&row);
        eprint!("{line}");
        table += &line;
        write_whole(&args.simulation.output.out.join("stress.md"), table.as_bytes())?;
    }
    print!("{table}");
    println!("stress.md and images in {}", args.simulation.output.out.display());
    Ok(())
}

fn format_row(row: &Row) -> String {
    // Nobody is there to compare with while the room is empty or dark.
    let known = |value: f64, text: String| if value.is_finite() { text } else { "-".to_owned() };
    let joints = |k: usize| known(row.mm[k], format!("{:.0} ({:.0})", row.mm[k], row.p95_mm[k]));
    let iou = |k: usize| known(row.iou[k], format!("{:.3}", row.iou[k]));
    let lost = |k: usize| format!("{} of {}", row.lost[k], row.sets[k]);
    let recovery = row.recovery_secs.map_or_else(|| "never".to_owned(), |secs| format!("{secs:.2}"));
    format!(
        "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {recovery} | {:.0} |\n",
        row.name,
        joints(0),
        joints(1),
        joints(2),
        iou(0),
        iou(1),
        iou(2),
        lost(0),
        lost(1),
        lost(2),
        row.set_ms
    )
}

fn simulator(
    args: &BenchStressArgs,
    gpu: &GpuContext,
    case: &Case,
    build: Build,
    (at_m, passer_by): (f64, bool),
) -> Result<Simulator> {
    let lights = match case.what {
        Disturbance::Lights(level) => vec![LightConfig {
            switch: vec![
                LightSwitch { secs: BEFORE_SECS, level },
                LightSwitch { secs: BEFORE_SECS + case.secs, level: 1.0 },
            ],
            ..LightConfig::default()
        }],
        _ => Vec::new(),
    };
    let config = SimConfig {
        seed: args.simulation.seed,
        person: PersonConfig { build, ..PersonConfig::default() },
        motion: MotionConfig { kind: case.motion, speed: case.speed, at_m: [at_m, 0.0], ..MotionConfig::default() },
        cameras: RingConfig { count: args.cameras, ..RingConfig::default() },
        width: args.simulation.side,
        height: args.simulation.side,
        scene: SceneConfig {
            kind: SceneKind::Office,
            seed: Some(args.simulation.seed),
            passer_by,
            ..SceneConfig::default()
        },
        lights,
        ..SimConfig::default()
    };
    Ok(Simulator::new(gpu, &config)?)
}

/// Multiplies every sRGB value of an image.
fn scaled(image: &Image, factor: f64) -> Result<Image> {
    let bytes: Vec<u8> =
        image.bytes().iter().map(|&byte| (f64::from(byte) * factor).round().min(255.0) as u8).collect();
    Ok(Image::new(image.width(), image.height(), image.format(), bytes)?)
}

/// Blends the masked part of an image below row `top` with the plate, so that `share` of their difference is left.
fn camouflaged(image: &Image, plate: &Image, mask: &Mask, top: usize, share: f64) -> Result<Image> {
    let width = image.width() as usize;
    let mut bytes = image.bytes().to_vec();
    for (at, alpha) in mask.coverage().iter().enumerate().skip(top * width) {
        let keep = 1.0 - (1.0 - share) * f64::from(*alpha) / 255.0;
        for (now, plate) in bytes[3 * at..3 * at + 3].iter_mut().zip(&plate.bytes()[3 * at..3 * at + 3]) {
            let difference = f64::from(*now) - f64::from(*plate);
            *now = (f64::from(*plate) + keep * difference).round() as u8;
        }
    }
    Ok(Image::new(image.width(), image.height(), image.format(), bytes)?)
}

/// The simulated scenes of a case.
struct Scenes<'a> {
    case: &'a Case,
    usual: Simulator,
    /// Scene during or after the disturbance, where it differs.
    other: Option<Simulator>,
    slots: Vec<usize>,
}

/// A frame set with its true pose and masks.
struct Shown {
    set: FrameSet,
    /// True masks by camera; `None` while the room is empty.
    truths: Vec<Option<Mask>>,
    joints: BTreeMap<String, (DVec3, DQuat)>,
    is_empty: bool,
}

impl<'a> Scenes<'a> {
    fn new(args: &BenchStressArgs, gpu: &GpuContext, case: &'a Case) -> Result<Self> {
        let usual = simulator(args, gpu, case, Build::SlimWoman, (0.0, false))?;
        let other = match case.what {
            Disturbance::OffCentre(at_m) => Some(simulator(args, gpu, case, Build::SlimWoman, (at_m, false))?),
            Disturbance::PasserBy => Some(simulator(args, gpu, case, Build::SlimWoman, (0.0, true))?),
            Disturbance::Replaced => Some(simulator(args, gpu, case, Build::HeavyMan, (0.0, false))?),
            _ => None,
        };
        let slots = (0..usual.rig().cameras.len()).collect();
        Ok(Self { case, usual, other, slots })
    }

    fn plates(&mut self) -> Result<Vec<Option<Image>>> {
        self.slots.iter().map(|&slot| Ok(Some(copy(self.usual.plate(slot)?)?))).collect()
    }

    /// Renders the frame set of an instant in a phase: 0 before, 1 during, 2 after the disturbance.
    fn show(&mut self, index: u64, nanos: i64, phase: usize) -> Result<Shown> {
        let (shows_other, is_empty) = match self.case.what {
            Disturbance::OffCentre(_) | Disturbance::PasserBy => (phase == 1, false),
            Disturbance::Away => (false, phase == 1),
            Disturbance::Replaced => (phase == 2, phase == 1),
            _ => (false, false),
        };
        let shown = match &mut self.other {
            Some(other) if shows_other => other,
            _ => &mut self.usual,
        };
        let taken = shown.capture_all(nanos, &self.slots)?;
        let joints = places(&shown.template().skeleton, &shown.track().at_repeated(nanos));
        let mut frames = Vec::new();
        let mut truths = Vec::new();
        for (slot, (image, mask)) in taken.into_iter().enumerate() {
            let hit = phase == 1 && slot == 1;
            let camera = shown.rig().cameras[slot].clone();
            let image = match self.case.what {
                _ if is_empty => copy(shown.plate(slot)?)?,
                Disturbance::Covered if hit => scaled(&image, 0.0)?,
                Disturbance::Dark if phase == 1 => scaled(&image, 0.0)?,
                Disturbance::Camouflaged(share) if phase == 1 => {
                    let neck = joints.get("Neck").map(|(place, _)| *place);
                    let top = neck.and_then(|neck| camera.project(neck)).map_or(0.0, |pixel| pixel.y);
                    camouflaged(&image, shown.plate(slot)?, &mask, top.max(0.0) as usize, share)?
                }
                Disturbance::Exposure(factor) if hit => scaled(&image, factor)?,
                _ => image,
            };
            truths.push((!is_empty).then_some(mask));
            let is_missing = self.case.what == Disturbance::Missing && hit;
            let frame = Frame {
                camera: camera.id,
                sequence: index,
                capture_nanos: nanos,
                exposure_nanos: None,
                image,
                mask: None,
            };
            frames.push((!is_missing).then(|| Arc::new(frame)));
        }
        Ok(Shown { set: FrameSet { index, master_nanos: nanos, frames }, truths, joints, is_empty })
    }
}

/// Errors of a case by phase.
#[derive(Default)]
struct Tally {
    row: Row,
    mm: [Vec<f64>; 3],
    iou: [Vec<f64>; 3],
}

impl Tally {
    /// Adds a frame set. `joints` are the estimated ones, `None` when the person was not found.
    fn add(
        &mut self,
        shown: &Shown,
        (phase, secs_after): (usize, f64),
        seen: Option<&SeenPerson>,
        joints: Option<BTreeMap<String, (DVec3, DQuat)>>,
    ) -> Result<()> {
        self.row.sets[phase] += usize::from(!shown.is_empty);
        let error = joints.map(|joints| joint_error_mm(&joints, &shown.joints));
        if !shown.is_empty {
            self.row.lost[phase] += usize::from(error.is_none());
            self.mm[phase].extend(error.iter().flatten().copied());
            for (view, truth) in seen.iter().flat_map(|seen| present_masks(seen, &shown.set, &shown.truths)) {
                self.iou[phase].push(mask_iou(view, truth)?);
            }
        }
        if phase == 2 && self.row.recovery_secs.is_none() {
            let limit = (RECOVERED.0 * mean(&self.mm[0])).max(RECOVERED.1);
            if error.is_some_and(|error| mean(&error) < limit) {
                self.row.recovery_secs = Some(secs_after);
            }
        }
        Ok(())
    }

    fn into_row(self, name: &'static str, set_ms: f64) -> Row {
        let Self { mut row, mm, iou } = self;
        (row.name, row.set_ms) = (name, set_ms);
        row.mm = [0, 1, 2].map(|k| mean(&mm[k]));
        row.p95_mm = [0, 1, 2].map(|k| percentile(&mm[k], 0.95));
        row.iou = [0, 1, 2].map(|k| mean(&iou[k]));
        row
    }
}

fn run(args: &BenchStressArgs, gpu: &GpuContext, case: &Case, index: usize) -> Result<Row> {
    let mut scenes = Scenes::new(args, gpu, case)?;
    let rig = scenes.usual.rig().clone();
    let plates = scenes.plates()?;
    let template = default_template(&ShapeParams::default())?;
    let mut perception = EstimatedPerception::new(&rig, &template, &PerceptionSettings::default(), &plates)?;
    let total = ((BEFORE_SECS + case.secs + AFTER_SECS) * args.rate.fps) as u64;
    let bar = progress_bar(total, case.name);
    let mut tally = Tally::default();
    let mut sheet: BTreeMap<usize, Vec<Image>> = BTreeMap::new();
    let mut seconds = 0.0;
    for set_index in 0..total {
        let secs = set_index as f64 / args.rate.fps;
        let phase = if secs < BEFORE_SECS { 0 } else { 1 + usize::from(secs >= BEFORE_SECS + case.secs) };
        let shown = scenes.show(set_index, (secs * 1e9) as i64, phase)?;
        let start = std::time::Instant::now();
        let observations = perception.observe(&shown.set, &mut StageTimes::default())?;
        seconds += start.elapsed().as_secs_f64();
        bar.inc(1);
        let seen = observations.into_iter().find_map(|observation| match observation {
            PersonObservation::Seen(seen) => Some(seen),
            PersonObservation::Lost { .. } => None,
        });
        let known = perception.people();
        let Some(known) = known.first() else { continue };
        let joints = seen.as_ref().map(|seen| places(&known.template.skeleton, &seen.pose));
        tally.add(&shown, (phase, secs - BEFORE_SECS - case.secs), seen.as_ref(), joints)?;
        // One image of the middle of each phase, and of the recovery.
        let middles = [0.75 * BEFORE_SECS, BEFORE_SECS + 0.5 * case.secs, BEFORE_SECS + case.secs + 0.5];
        for (place, middle) in middles.into_iter().enumerate() {
            if (secs - middle).abs() < 0.5 / args.rate.fps {
                sheet.insert(place, outlined(&shown.set, seen.as_ref())?);
            }
        }
    }
    bar.finish_and_clear();
    let name = format!("{index:02}-{}.png", case.name.replace([' ', '.'], "-"));
    write_sheet(&args.simulation.output.out.join(name), &sheet.into_values().collect::<Vec<_>>())?;
    Ok(tally.into_row(case.name, 1e3 * seconds / total.max(1) as f64))
}

/// Pairs the masks of the views with the true ones.
fn present_masks<'a>(
    seen: &'a SeenPerson,
    set: &'a FrameSet,
    truths: &'a [Option<Mask>],
) -> impl Iterator<Item = (&'a Mask, &'a Mask)> {
    let views = seen.views.iter().zip(set.present());
    views.filter_map(|(view, (slot, _))| view.mask.as_ref().zip(truths.get(slot)?.as_ref()))
}

/// Returns the distances of the joints that both bodies have, millimetres.
fn joint_error_mm(ours: &BTreeMap<String, (DVec3, DQuat)>, truth: &BTreeMap<String, (DVec3, DQuat)>) -> Vec<f64> {
    JOINTS.iter().filter_map(|name| Some(1e3 * ours.get(*name)?.0.distance(truth.get(*name)?.0))).collect()
}

/// Renders the outlines of the masks into the images of a frame set.
fn outlined(set: &FrameSet, seen: Option<&SeenPerson>) -> Result<Vec<Image>> {
    let mut images = Vec::new();
    for (at, (_, frame)) in set.present().enumerate() {
        let (image, mut rgb) = (&frame.image, frame.image.bytes().to_vec());
        if let Some(mask) = seen.and_then(|seen| seen.views.get(at)?.mask.as_ref()) {
            let rgba: Vec<u8> = mask.coverage().iter().flat_map(|&alpha| [0, 0, 0, alpha]).collect();
            paint_outline(&mut rgb, &rgba, image.width() as usize, image.height() as usize, OUTLINE);
        }
        images.push(Image::new(image.width(), image.height(), PixelFormat::Rgb8, rgb)?);
    }
    Ok(images)
}

/// Writes images side by side, one row per phase.
fn write_sheet(path: &Path, rows: &[Vec<Image>]) -> Result<()> {
    let Some(first) = rows.first().and_then(|row| row.first()) else { return Ok(()) };
    let (width, height) = (first.width() as usize, first.height() as usize);
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let mut rgb = vec![0; 3 * width * columns * height * rows.len()];
    for (y, row) in rows.iter().enumerate() {
        for (x, image) in row.iter().enumerate() {
            for (line, bytes) in image.bytes().chunks_exact(3 * width).enumerate() {
                let start = 3 * ((y * height + line) * width * columns + x * width);
                rgb[start..start + 3 * width].copy_from_slice(bytes);
            }
        }
    }
    let png = png::encode_rgb(&rgb, (width * columns) as u32, (height * rows.len()) as u32)?;
    write_whole(path, &png)?;
    Ok(())
}

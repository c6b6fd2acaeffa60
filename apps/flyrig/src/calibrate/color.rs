//! `flyrig calibrate color`: matches the cameras' colours on people whom several of them see.

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_body::{ShapeParams, default_template};
use flyrig_calib::{CameraColors, ColorFit, ColorPoint, ColorSample, match_colors, save_calibration};
use flyrig_fusion::{
    EstimatedPerception, Observed, Origin, PerceptionSettings, SHAPE_SECS, SHAPE_SETS, Session, SessionBuilder,
    SessionSettings, Subject, TrackState,
};
use flyrig_gpu::GpuContext;
use flyrig_report::{stop, write_whole};
use flyrig_takes::{Calibration, Take, TakeSpan};
use flyrig_types::{CameraId, ColorMatch, FrameSet, Rig};
use glam::DVec2;
use serde_json::json;

use super::output::{FILES, refuse_existing};
use crate::arguments::{CalibratedInputArgs, TargetArgs};

/// Arguments of `flyrig calibrate color`.
#[derive(Debug, Args)]
#[command(mut_arg("secs", |arg| arg.default_value("10")))]
pub struct CalibrateColorArgs {
    /// Largest number of tracked people.
    #[arg(long, default_value_t = 1)]
    pub people: usize,
    #[command(flatten)]
    pub input: CalibratedInputArgs,
    #[command(flatten)]
    pub target: TargetArgs,
}

/// Number of Gaussians per person: enough for colours, in a quarter of the time.
const GAUSSIANS: usize = 30_000;
/// Number of points per person and frame set.
const POINTS: usize = 2000;
/// Frame sets from one whose colours are sampled to the next.
const EVERY: u64 = 4;
/// Least weight of the viewing angle (Eq. 7) and least proximity exp(-k d) to the rendered surface of a point in a view.
const LEAST_WEIGHT: f32 = 0.1;
const LEAST_NEARNESS: f32 = 0.85;
/// Image width over half the side of the square that a colour is averaged in.
const REACH: u32 = 200;
/// Range of sRGB values in the square, relative to their mean, at which a sample's weight is halved, and beyond which it is 0.
const EVEN: (f64, f64) = (0.05, 0.5);
/// Largest relative difference between cameras that needs no correction.
const MATCHED: f64 = 0.02;
/// Largest relative difference between the gains of the halves of a take.
const MOST_HALVES: f64 = 0.03;

/// Runs the command.
pub fn color(args: &CalibrateColorArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    refuse_existing(&args.target.out, &FILES, args.target.force)?;
    let open = || args.input.open(gpu);
    let mut take = open()?;
    ensure!(
        !take.is_live,
        "live cameras cannot be processed frame by frame; record them first (flyrig record) and give the recording"
    );
    let Calibration { mut rig, plates } = take
        .calibration
        .take()
        .context("no calibration: name its folder with --calibration; flyrig calibrate rig makes one from a board")?;
    ensure!(rig.cameras.len() > 1, "one camera alone has nothing to match");
    // An earlier correction is replaced.
    rig.cameras.iter_mut().for_each(|camera| camera.color = ColorMatch::NONE);
    let perception = PerceptionSettings {
        masks: if take.given_masks { Origin::Given } else { Origin::Estimated },
        people: args.people,
        ..PerceptionSettings::default()
    };
    let template = default_template(&ShapeParams::default())?;
    let mut settings = SessionSettings { perception, ..SessionSettings::default() };
    settings.body.gaussians = GAUSSIANS;
    settings.validate()?;
    let mut estimated = EstimatedPerception::new(&rig, &template, &settings.perception, &plates)?;
    // People who come later are measured then.
    if let Err(error) = estimated.learn_shapes(&first_sets(args, &rig, open()?)?) {
        tracing::debug!(%error, "no person in the first frame sets");
    }
    let mut session = SessionBuilder::new(gpu()?, rig.clone()).settings(settings).perception(estimated).build()?;
    session.keep_observations()?;
    let points = sample_colors(args, &rig, &mut session, take)?;
    ensure!(!points.is_empty(), "no person is tracked; let one person walk where all cameras see them whole");
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let fit = match_colors(&ids, &points)?;
    for (camera, solved) in rig.cameras.iter_mut().zip(&fit.cameras) {
        camera.color = solved.color;
    }
    rig.validate().context("the colours cannot be matched; are the exposures of the cameras alike?")?;
    print(&ids, &fit);
    std::fs::create_dir_all(&args.target.out)
        .with_context(|| format!("cannot create {}", args.target.out.display()))?;
    save_calibration(&args.target.out, &rig, &[])?;
    write_whole(&args.target.out.join("calibration.json"), &serde_json::to_vec_pretty(&report(&ids, &fit))?)?;
    println!("{}: {}", args.target.out.display(), FILES.join(", "));
    println!("next: set path (of a folder: calibration) = \"{}\" in [source]", args.target.out.display());
    Ok(())
}

/// Reads frame sets of the first seconds, from which shapes are estimated.
fn first_sets(args: &CalibrateColorArgs, rig: &Rig, take: Take) -> Result<Vec<FrameSet>> {
    let secs = [args.input.span.from_secs, args.input.span.from_secs + SHAPE_SECS];
    let (mut sets, mut first): (Vec<FrameSet>, _) = (Vec::new(), None);
    take.for_each_set(rig, TakeSpan { secs, spread_nanos: 0 }, "the person's shape, ms of the take", |set| {
        let from = *first.get_or_insert(set.master_nanos);
        let due = SHAPE_SECS * sets.len() as f64 / SHAPE_SETS as f64;
        if set.master_nanos.saturating_sub(from) as f64 * 1e-9 >= due - 1e-3 {
            sets.push(set.clone());
        }
        Ok(())
    })?;
    Ok(sets)
}

/// Tracks people through the take and samples the colours of their surfaces.
fn sample_colors(args: &CalibrateColorArgs, rig: &Rig, session: &mut Session, take: Take) -> Result<Vec<ColorPoint>> {
    let secs = [args.input.span.from_secs, args.input.span.from_secs + args.input.span.secs];
    let (mut points, mut sets) = (Vec::new(), 0u64);
    let errors = take.for_each_set(rig, TakeSpan { secs, spread_nanos: 0 }, "colours, ms of the take", |set| {
        session.process(set)?;
        sets += 1;
        if !sets.is_multiple_of(EVERY) {
            return Ok(());
        }
        let people: Vec<_> = session.subjects().iter().map(Subject::id).collect();
        for person in people {
            if session.subject(person).is_some_and(|subject| subject.watch().state() == TrackState::Steady) {
                points.extend(seen(rig, &session.observed(person)?, sets / EVERY));
            }
        }
        Ok(())
    })?;
    for (slot, camera) in rig.cameras.iter().enumerate() {
        if let Some(error) = errors.get(slot) {
            eprintln!("warning: not every image of camera {} could be used; the last: {error}", camera.id);
        }
    }
    Ok(points)
}

/// Samples the points that at least two views see well.
fn seen(rig: &Rig, observed: &Observed, instant: u64) -> Vec<ColorPoint> {
    let views = &observed.observations.views;
    let count = observed.center_scale.len();
    let sample = |view: usize, gaussian: usize| {
        let [x, y, weight, nearness] = *views.get(view)?.get(gaussian)?;
        if weight < LEAST_WEIGHT || nearness < LEAST_NEARNESS {
            return None;
        }
        let (camera, (width, height, rgba)) = (*observed.slots.get(view)?, observed.pictures.get(view)?);
        let (srgb, evenness) = srgb_at([*width, *height], rgba, [x, y])?;
        let intrinsics = &rig.cameras.get(camera)?.intrinsics;
        let diagonal = DVec2::new(f64::from(*width), f64::from(*height)).length();
        let r = DVec2::new(x.into(), y.into()).distance(intrinsics.center_px) / (0.5 * diagonal);
        Some(ColorSample { camera, srgb, r2: r * r, weight: evenness * f64::from(weight) })
    };
    let point = |gaussian| {
        let samples: Vec<ColorSample> = (0..views.len()).filter_map(|view| sample(view, gaussian)).collect();
        (samples.len() > 1).then_some(ColorPoint { instant, samples })
    };
    let all: Vec<ColorPoint> = (0..count).filter_map(point).collect();
    let step = all.len().div_ceil(POINTS).max(1);
    // Different points each time.
    all.into_iter().skip(instant as usize % step).step_by(step).collect()
}

/// Returns the mean sRGB values around a pixel of an image with the mask as alpha, and their weight, 0 to 1: on a patterned surface,
/// a small position error is a colour error. `None` at the mask's edge and outside.
fn srgb_at([width, height]: [u32; 2], rgba: &[u8], [x, y]: [f32; 2]) -> Option<([f64; 3], f64)> {
    let reach = i64::from(width / REACH).max(1);
    let (x, y) = (x.round() as i64, y.round() as i64);
    if x < reach || y < reach || x + reach >= i64::from(width) || y + reach >= i64::from(height) {
        return None;
    }
    let (mut sums, mut least, mut most) = ([0u32; 3], [u8::MAX; 3], [0u8; 3]);
    for row in y - reach..=y + reach {
        let from = 4 * (row as usize * width as usize + (x - reach) as usize);
        for pixel in rgba.get(from..from + 4 * (2 * reach as usize + 1))?.chunks_exact(4) {
            if pixel[3] < 255 {
                return None;
            }
            for k in 0..3 {
                sums[k] += u32::from(pixel[k]);
                (least[k], most[k]) = (least[k].min(pixel[k]), most[k].max(pixel[k]));
            }
        }
    }
    let count = (2 * reach + 1).pow(2) as f64;
    let mean: [f64; 3] = sums.map(|sum| f64::from(sum) / (255.0 * count));
    let range = (0..3).map(|k| f64::from(most[k] - least[k]) / (255.0 * mean[k])).fold(0.0, f64::max);
    // Black gives NaN, which does not compare below.
    (range < EVEN.1).then(|| (mean, 1.0 / (1.0 + (range / EVEN.0).powi(2))))
}

fn print(ids: &[CameraId], fit: &ColorFit) {
    println!(
        "{:<14} {:>8} {:>20} {:>9} {:>9} {:>9} {:>16}",
        "camera", "points", "gain r g b", "exponent", "corner", "halves %", "difference %"
    );
    for (id, camera) in ids.iter().zip(&fit.cameras) {
        let CameraColors { color: ColorMatch { gain: [r, g, b], exponent, falloff }, points, halves, difference } =
            camera;
        println!(
            "{id:<14} {points:>8} {:>20} {exponent:>9.3} {:>9.3} {:>9.2} {:>16}",
            format!("{r:.3} {g:.3} {b:.3}"),
            (falloff[0] + falloff[1]).exp(),
            100.0 * halves,
            format!("{:.1} -> {:.1}", 100.0 * difference.0, 100.0 * difference.1),
        );
    }
    let sought = match (fit.model.response, fit.model.falloff) {
        (false, false) => "gains alone: exponents and corners explain no more",
        (true, false) => "gains and exponents: corners explain no more",
        (false, true) => "gains and corners: exponents explain no more",
        (true, true) => "gains, exponents and corners",
    };
    println!("{sought}");
    if fit.cameras.iter().all(|camera| (0..3).all(|k| (camera.color.gain[k] - 1.0).abs() < MATCHED)) {
        println!("the cameras are matched already: no gain is off by more than {:.0} %", 100.0 * MATCHED);
    }
    for (id, _) in ids.iter().zip(&fit.cameras).filter(|(_, camera)| camera.halves > MOST_HALVES) {
        println!(
            "warning: camera {id}: the two halves of the take disagree by more than {:.0} %: its exposure or white balance may be \
             automatic (fix them in [[source.cameras]]), or the light changed",
            100.0 * MOST_HALVES
        );
    }
}

/// `calibration.json`.
fn report(ids: &[CameraId], fit: &ColorFit) -> serde_json::Value {
    let of = |(id, camera): (&CameraId, &CameraColors)| {
        json!({
            "camera": id,
            "color": camera.color,
            "points": camera.points,
            "halves": camera.halves,
            "difference_before": camera.difference.0,
            "difference": camera.difference.1,
        })
    };
    json!({ "cameras": ids.iter().zip(&fit.cameras).map(of).collect::<Vec<_>>() })
}

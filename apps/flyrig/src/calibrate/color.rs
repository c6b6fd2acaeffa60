//! `flyrig calibrate color`: matches the cameras' colours on people whom several of them see.

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_calib::{CameraColors, ColorFit, ColorPoint, match_colors, save_calibration};
use flyrig_fusion::{SHAPE_SECS, SHAPE_SETS};
use flyrig_gpu::GpuContext;
use flyrig_report::{stop, write_whole};
use flyrig_takes::{Calibration, ColorSampler, Take, TakeSpan};
use flyrig_types::{CameraId, ColorMatch, FrameSet, Rig};
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

/// Frame sets from one whose colours are sampled to the next.
const EVERY: u64 = 4;
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
    let first = first_sets(args, &rig, open()?)?;
    let sampler = ColorSampler::new(&rig, &plates, take.given_masks, args.people, &first, gpu()?)?;
    let points = sample_colors(args, &rig, sampler, take)?;
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
fn sample_colors(
    args: &CalibrateColorArgs,
    rig: &Rig,
    mut sampler: ColorSampler,
    take: Take,
) -> Result<Vec<ColorPoint>> {
    let secs = [args.input.span.from_secs, args.input.span.from_secs + args.input.span.secs];
    let mut sets = 0u64;
    let errors = take.for_each_set(rig, TakeSpan { secs, spread_nanos: 0 }, "colours, ms of the take", |set| {
        sets += 1;
        sampler.add(set, sets.is_multiple_of(EVERY))
    })?;
    for (slot, camera) in rig.cameras.iter().enumerate() {
        if let Some(error) = errors.get(slot) {
            eprintln!("warning: not every image of camera {} could be used; the last: {error}", camera.id);
        }
    }
    Ok(sampler.into_points())
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

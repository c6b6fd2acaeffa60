//! `flyrig calibrate person`: refines poses and time offsets of cameras from one moving person.

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_calib::{Deviation, PersonCamera, PersonFit, PersonOptions, PersonTracks, save_calibration};
use flyrig_gpu::GpuContext;
use flyrig_report::{stop, write_whole};
use flyrig_takes::{Calibration, PersonFinder, Take, TakeSpan, ensure_same_person, fit_person};
use flyrig_types::{Camera, Image, Rig};
use serde_json::json;

use super::output::{FILES, refuse_existing};
use crate::arguments::{CalibratedInputArgs, TargetArgs};

/// Arguments of `flyrig calibrate person`.
#[derive(Debug, Args)]
pub struct CalibratePersonArgs {
    /// Take the cameras' stamps as they are.
    #[arg(long)]
    pub no_offsets: bool,
    #[command(flatten)]
    pub input: CalibratedInputArgs,
    #[command(flatten)]
    pub target: TargetArgs,
}

/// Displacement of the person in a camera's image beyond which its pose was wrong, pixels, and as a multiple of the halves' difference.
const LEAST_MOVED_PX: f64 = 2.0;
const CLEARLY: f64 = 2.0;
/// Largest acceptable difference between the halves of a take, pixels.
const MOST_HALVES_PX: f64 = 4.0;
/// Least reported time offset, and largest standard deviation of a useful one, seconds.
const LEAST_LAG_S: f64 = 0.003;
const MOST_LAG_SIGMA_S: f64 = 0.008;

/// Runs the command.
pub fn person(args: &CalibratePersonArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    refuse_existing(&args.target.out, &FILES, args.target.force)?;
    let mut take = args.input.open(gpu)?;
    ensure!(
        !take.is_live,
        "live cameras cannot be processed frame by frame; record them first (flyrig record) and give the recording"
    );
    let Calibration { rig, plates } = take
        .calibration
        .take()
        .context("no calibration: name its folder with --calibration; flyrig calibrate rig makes one from a board")?;
    ensure!(rig.cameras.len() > 1, "one camera alone has nothing to agree with");
    let known_nanos = take.sync.lags_nanos.clone();
    let tracks = track_landmarks(args, &rig, plates, take)?;
    let options = PersonOptions { lags: !args.no_offsets, ..PersonOptions::default() };
    let fit = fit_person(&rig, &tracks, options)?;
    ensure_same_person(&rig, &fit)?;
    print(&rig, &tracks, &fit);
    advise(&rig, &fit, options.lags);
    // The total of the already subtracted offset and the residual one.
    let mut better = fit.rig.clone();
    for (camera, solved) in better.cameras.iter_mut().zip(&fit.cameras) {
        let known = known_nanos.get(&camera.id).copied().unwrap_or_default();
        if options.lags {
            camera.time_offset_nanos = known + (1e9 * solved.lag_s.0).round() as i64;
        }
        if known != rig.cameras.iter().find(|old| old.id == camera.id).map_or(0, |old| old.time_offset_nanos) {
            println!("take camera {} out of [sync] lags_ms: that replaces the offset of calibration.toml", camera.id);
        }
    }
    std::fs::create_dir_all(&args.target.out)
        .with_context(|| format!("cannot create {}", args.target.out.display()))?;
    let deviation = |camera: &PersonCamera| {
        let (rotation_deg, position_mm) = camera.deviation;
        let time_offset_ms = options.lags.then_some(1e3 * camera.lag_s.1);
        Some(Deviation { rotation_deg, position_mm, time_offset_ms })
    };
    save_calibration(&args.target.out, &better, &fit.cameras.iter().map(deviation).collect::<Vec<_>>())?;
    write_whole(&args.target.out.join("calibration.json"), &serde_json::to_vec_pretty(&report(&rig, &fit))?)?;
    println!("{}: {}", args.target.out.display(), FILES.join(", "));
    Ok(())
}

/// Finds landmarks and silhouettes of the person in all images.
fn track_landmarks(
    args: &CalibratePersonArgs,
    rig: &Rig,
    plates: Vec<Option<Image>>,
    take: Take,
) -> Result<PersonTracks> {
    let mut finder = PersonFinder::new(std::slice::from_ref(rig), plates)?;
    let secs = [args.input.span.from_secs, args.input.span.from_secs + args.input.span.secs];
    let errors = take
        .for_each_set(rig, TakeSpan { secs, spread_nanos: 0 }, "the person, ms of the take", |set| finder.add(set))?;
    for (slot, camera) in rig.cameras.iter().enumerate() {
        if let Some(error) = errors.get(slot) {
            eprintln!("warning: not every image of camera {} could be used; the last: {error}", camera.id);
        }
    }
    let (_, tracks) = finder.into_tracks()?.pop().context("no calibration")?;
    Ok(tracks)
}

fn print(rig: &Rig, tracks: &PersonTracks, fit: &PersonFit) {
    println!(
        "{:<14} {:>6} {:>16} {:>18} {:>14} {:>9} {:>10} {:>16} {:>10}",
        "camera",
        "images",
        "error px",
        "moved deg, mm",
        "+- deg, mm",
        "moved px",
        "halves px",
        "offset ms",
        "halves ms"
    );
    for (slot, (camera, solved)) in rig.cameras.iter().zip(&fit.cameras).enumerate() {
        println!(
            "{:<14} {:>6} {:>16} {:>18} {:>14} {:>9.2} {:>10} {:>16} {:>10}",
            camera.id,
            tracks.images(slot),
            format!("{:.2} -> {:.2}", solved.error_px.0, solved.error_px.1),
            format!("{:.3} {:.1}", solved.moved.0, solved.moved.1),
            format!("{:.3} {:.1}", solved.deviation.0, solved.deviation.1),
            solved.moved_px,
            solved.halves_px.map_or_else(|| "?".to_owned(), |px| format!("{px:.2}")),
            format!("{:.1} +-{:.1}", 1e3 * solved.lag_s.0, 1e3 * solved.lag_s.1),
            solved.lag_halves_s.map_or_else(|| "?".to_owned(), |secs| format!("{:.1}", 1e3 * secs)),
        );
    }
    println!(
        "{} instants; landmarks spread by {:.2} px; left and right were confused in {} groups of limbs",
        fit.instants, fit.sigma_px, fit.corrections
    );
    if let Some((before, after)) = fit.planes_rad {
        println!(
            "planes that touch the silhouettes of two cameras disagree by {:.1} -> {:.1} mrad",
            1e3 * before,
            1e3 * after
        );
    }
}

/// Prints the cameras that were wrong, the use of the time offsets, and missing movements.
fn advise(rig: &Rig, fit: &PersonFit, with_lags: bool) {
    let cameras = || rig.cameras.iter().map(|camera| &camera.id).zip(&fit.cameras);
    for (id, camera) in cameras() {
        let doubt = camera.halves_px.unwrap_or(f64::INFINITY);
        let (deg, mm) = camera.moved;
        if camera.moved_px > LEAST_MOVED_PX.max(CLEARLY * doubt) {
            println!(
                "camera {id} was off: the person lies {:.1} px beside where it was, {deg:.2} degrees and {mm:.0} mm of the camera",
                camera.moved_px
            );
        } else if camera.moved_px > LEAST_MOVED_PX && doubt > LEAST_MOVED_PX {
            println!(
                "camera {id} may be off by {:.1} px, but the two halves of the take differ by {doubt:.1} px: show more of the volume",
                camera.moved_px
            );
        }
    }
    let lags: Vec<String> = cameras()
        .filter(|(_, camera)| with_lags && camera.lag_s.0.abs() > (3.0 * camera.lag_s.1).max(LEAST_LAG_S))
        .map(|(id, camera)| format!("{id} {:.1}", 1e3 * camera.lag_s.0))
        .collect();
    if !lags.is_empty() {
        println!(
            "the stamps are off by so many milliseconds: {}. calibration.toml holds the offsets, and they are applied wherever it is read",
            lags.join(", ")
        );
    }
    if cameras().any(|(_, camera)| camera.halves_px.is_none_or(|px| px > MOST_HALVES_PX)) {
        println!(
            "the two halves of the take disagree: let one person walk through the whole volume, near to every camera and far, with raised \
             and lowered arms, for 20 s"
        );
    }
    if with_lags && cameras().any(|(_, camera)| camera.lag_s.1 > MOST_LAG_SIGMA_S) {
        println!("the offsets are vague: jump, squat and wave; slow movements do not show time");
    }
}

/// `calibration.json`.
fn report(rig: &Rig, fit: &PersonFit) -> serde_json::Value {
    let of = |(camera, solved): (&Camera, &PersonCamera)| {
        json!({
            "camera": camera.id,
            "error_px_before": solved.error_px.0,
            "error_px": solved.error_px.1,
            "moved_deg_mm": solved.moved,
            "deviation_deg_mm": solved.deviation,
            "moved_px": solved.moved_px,
            "halves_px": solved.halves_px,
            "offset_secs": solved.lag_s.0,
            "offset_deviation_secs": solved.lag_s.1,
            "halves_secs": solved.lag_halves_s,
        })
    };
    let cameras: Vec<_> = rig.cameras.iter().zip(&fit.cameras).map(of).collect();
    json!({ "cameras": cameras, "instants": fit.instants, "landmarks_px": fit.sigma_px, "planes_rad": fit.planes_rad })
}

//! `flyrig calibrate rig`: poses of all cameras from a board that they see together.

use std::path::Path;

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use flyrig_calib::{Board, Deviation, LensModel, RigFit, RigOptions, calibrate_rig, save_calibration};
use flyrig_gpu::GpuContext;
use flyrig_report::{stop, write_whole};
use glam::DVec3;
use serde_json::json;

use super::{
    lens::Lenses,
    output::{FILES, LENSES, PAGE, refuse_existing},
    page, unjoined,
    views::{BoardTakeArgs, SeenBoards, load_board},
};
use crate::arguments::{SolveArgs, TargetArgs};

/// Arguments of `flyrig calibrate rig`.
#[derive(Debug, Args)]
pub struct CalibrateRigArgs {
    #[command(flatten)]
    pub take: BoardTakeArgs,
    /// Optimize the lenses together with the poses.
    #[arg(long)]
    pub refine_lenses: bool,
    #[command(flatten)]
    pub solve: SolveArgs,
    #[command(flatten)]
    pub target: TargetArgs,
}

/// Ratio of the noise with and without time offsets below which they are kept.
const OFFSETS_PAY: f64 = 0.95;
/// Ratio of the noise with and without a bent board below which the bend is kept, and its least multiple of the standard deviation.
const BEND_PAYS: f64 = 0.95;
const BEND_SIGMAS: f64 = 5.0;
/// Time within which a take with `--floor` must show the board, seconds.
const FLOOR_WITHIN_SECS: f64 = 2.0;
/// Largest angle between cameras and a floor that they look down on, degrees.
const MOST_TILT_DEG: f64 = 70.0;
/// Largest difference between the halves of the shots, as a multiple of the noise.
const MOST_DISAGREEMENT: f64 = 1.5;

/// Runs the command.
pub fn rig(args: &CalibrateRigArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let board = load_board(&args.solve.board.board, &args.take)?;
    refuse_calibrated(&args.target, &args.solve)?;
    let seen = SeenBoards::find(&args.take, &board, gpu)?;
    ensure!(seen.ids.len() > 1, "one camera alone is no rig; flyrig calibrate lens calibrates it");
    check_floor(args.solve.floor, &seen)?;
    let refine = args.refine_lenses.then_some(LensModel::RadialTangential);
    calibrate((&args.target.out, &args.solve), &board, &seen, refine)
}

/// Refuses to replace a calibration, or lenses that a failed attempt would write, unless forced. The page of a failed attempt alone is
/// replaced.
pub(super) fn refuse_calibrated(target: &TargetArgs, solve: &SolveArgs) -> Result<()> {
    refuse_existing(&target.out, &FILES, target.force)?;
    match solve.lenses {
        Some(_) => Ok(()),
        None => refuse_existing(&target.out.join(LENSES), &FILES[..1], target.force),
    }
}

/// Checks that a take with `--floor` begins with the board.
pub(super) fn check_floor(floor: bool, seen: &SeenBoards) -> Result<()> {
    if floor {
        let first = seen.shots.first().map_or(i64::MAX, |shot| shot.nanos);
        let late_secs = first.saturating_sub(seen.begin_nanos) as f64 * 1e-9;
        ensure!(
            late_secs <= FLOOR_WITHIN_SECS,
            "--floor: no camera saw the board in the first {FLOOR_WITHIN_SECS} s; begin the take with the board on the floor, in view of a \
             camera that looks down on it"
        );
    }
    Ok(())
}

/// Calibrates lenses, where they are not known, and poses, and writes all files. Where the boards do not join all cameras, writes the
/// lenses and a page about what is missing, and returns the error.
pub(super) fn calibrate(
    (out, args): (&Path, &SolveArgs),
    board: &Board,
    seen: &SeenBoards,
    refine: Option<LensModel>,
) -> Result<()> {
    if seen.shots.is_empty() {
        seen.check(0, board)?;
    }
    let lenses = Lenses::load_or_solve(args.lenses.as_deref(), board, seen)?;
    match solve(args, board, seen, &lenses, refine) {
        Ok(solved) => write(out, args.floor, seen, &solved),
        Err(error) => {
            let written = unjoined::write(out, seen, &lenses, &error)?;
            bail!("{error:#}. {written}")
        }
    }
}

/// Solved rig.
struct Solved {
    fit: RigFit,
    has_offsets: bool,
    /// Noise without time offsets, pixels.
    plain_px: f64,
}

/// Calibrates the poses.
fn solve(
    args: &SolveArgs,
    board: &Board,
    seen: &SeenBoards,
    lenses: &Lenses,
    refine: Option<LensModel>,
) -> Result<Solved> {
    let lenses = lenses.all()?;
    let solve = |lags, bend| {
        let options = RigOptions { lens: refine, lags, bend, floor_first: args.floor };
        calibrate_rig(board, &seen.ids, &lenses, &seen.shots, options)
    };
    let plain = solve(false, false)?;
    // Offsets are kept only if the board moved and they lower the noise.
    let with_offsets = if args.no_offsets { None } else { solve(true, false).ok() };
    let better = |fit: &RigFit| {
        fit.sigma_px < OFFSETS_PAY * plain.sigma_px && fit.cameras.iter().all(|camera| camera.deviation.is_some())
    };
    let plain_px = plain.sigma_px;
    let (fit, has_offsets) = match with_offsets.filter(better) {
        Some(fit) => (fit, true),
        None => (plain, false),
    };
    let is_bent = |bent: &RigFit| {
        bent.sigma_px < BEND_PAYS * fit.sigma_px && bent.bend_mm.is_some_and(|(mm, sigma)| mm > BEND_SIGMAS * sigma)
    };
    let fit = solve(has_offsets, true).ok().filter(is_bent).unwrap_or(fit);
    Ok(Solved { fit, has_offsets, plain_px })
}

/// Prints the poses and writes all files.
fn write(out: &Path, floor: bool, seen: &SeenBoards, solved: &Solved) -> Result<()> {
    let Solved { fit, has_offsets, plain_px } = solved;
    let above =
        fit.rig.cameras.iter().map(|camera| camera.camera_from_world.rotation.inverse() * DVec3::NEG_Y).sum::<DVec3>();
    let tilt_deg = above.angle_between(fit.rig.world_up).to_degrees();
    ensure!(
        !floor || tilt_deg < MOST_TILT_DEG,
        "--floor: the first board stands {tilt_deg:.0} degrees off what the cameras have above them; begin the take with the board on \
         the floor, face up"
    );
    print(seen, fit, *has_offsets);
    let sentences = sentences(seen, fit, has_offsets.then_some(*plain_px));
    sentences.iter().for_each(|sentence| println!("{sentence}"));
    std::fs::create_dir_all(out).with_context(|| format!("cannot create {}", out.display()))?;
    let mut rig = fit.rig.clone();
    let mut deviations = Vec::new();
    for (camera, solved) in rig.cameras.iter_mut().zip(&fit.cameras) {
        let (lag_s, sigma_s) = solved.lag_s;
        if *has_offsets {
            camera.time_offset_nanos = (1e9 * lag_s).round() as i64;
        }
        deviations.push(solved.deviation.map(|(rotation_deg, position_mm)| Deviation {
            rotation_deg,
            position_mm,
            time_offset_ms: has_offsets.then_some(1e3 * sigma_s),
        }));
    }
    save_calibration(out, &rig, &deviations)?;
    write_whole(&out.join("calibration.json"), &serde_json::to_vec_pretty(&report(seen, fit))?)?;
    page::page(&seen.ids, fit, sentences).save(&out.join(PAGE))?;
    println!("{}: {}, {PAGE}", out.display(), FILES.join(", "));
    println!(
        "next: look at {}, set source.path = \"{}\" in the configuration, then flyrig doctor",
        out.join(PAGE).display(),
        out.display()
    );
    Ok(())
}

fn print(seen: &SeenBoards, fit: &RigFit, has_offsets: bool) {
    let pair =
        |values: Option<(f64, f64)>| values.map_or_else(|| "open".to_owned(), |(deg, mm)| format!("{deg:.3} {mm:.1}"));
    println!(
        "{:<14} {:>6} {:>7} {:>14} {:>16} {:>14}",
        "camera", "boards", "rms px", "+- deg, mm", "halves deg, mm", "offset ms"
    );
    for (id, camera) in seen.ids.iter().zip(&fit.cameras) {
        let (lag, sigma) = camera.lag_s;
        println!(
            "{:<14} {:>6} {:>7.3} {:>14} {:>16} {:>14}",
            id,
            camera.views,
            camera.rms_px,
            pair(camera.deviation),
            pair(camera.halves),
            if has_offsets { format!("{:.1} +-{:.1}", 1e3 * lag, 1e3 * sigma) } else { "-".to_owned() }
        );
    }
    for pair in &fit.pairs {
        let (a, b) = pair.cameras;
        let apart_mm = 1e3 * fit.rig.cameras[a].position().distance(fit.rig.cameras[b].position());
        println!(
            "{} and {} share {} boards, {} agree; {apart_mm:.2} mm apart",
            seen.ids[a], seen.ids[b], pair.shots, pair.agreeing
        );
    }
}

/// Formats the results of the solve as sentences, for the terminal and the page.
fn sentences(seen: &SeenBoards, fit: &RigFit, noise_without_offsets: Option<f64>) -> Vec<String> {
    let mut lines = vec![format!(
        "rms {:.3} px, noise {:.3} px a coordinate, {} boards",
        fit.rms_px,
        fit.sigma_px,
        fit.shots.len()
    )];
    if let Some(before) = noise_without_offsets {
        lines.push(format!(
            "the cameras' stamps are off: without offsets the noise is {before:.3} px. calibration.toml holds the offsets, and they are \
             applied wherever it is read"
        ));
    }
    if let Some((mm, sigma)) = fit.bend_mm {
        lines.push(format!(
            "the board is bent by {mm:.2} +-{sigma:.2} mm, which the poses heed; glue it to something flat and stiff, and calibrate the lenses \
             with it again"
        ));
    }
    lines.push(match fit.worst_disagreement() {
        Some((slot, ratio)) if ratio > MOST_DISAGREEMENT => format!(
            "warning: two solves from either half of the boards differ by {ratio:.1} times what noise explains, most for camera {}: \
             a time offset that changes, blur, a bent board, or a lens that needs calibrating by itself (flyrig calibrate lens)",
            seen.ids[slot]
        ),
        Some((_, ratio)) => {
            format!("two solves from either half of the boards agree ({ratio:.1} times what noise explains, at worst)")
        }
        None => "warning: too few boards to solve twice; show more".to_owned(),
    });
    let deviations =
        seen.ids.iter().zip(&fit.cameras).filter_map(|(id, camera)| Some((id, camera.uncertainty.as_ref()?)));
    if let Some((id, worst)) = deviations.max_by(|a, b| a.1.middle_mm.total_cmp(&b.1.middle_mm)) {
        lines.push(format!(
            "in the middle of the boards, camera {id} is known worst: to {:.2} mm, and to {:.2} px in its image (one standard deviation)",
            worst.middle_mm,
            worst.worst_px()
        ));
    }
    let mut worst: Vec<&(i64, f64)> = fit.shots.iter().collect();
    worst.sort_by(|a, b| b.1.total_cmp(&a.1));
    let times: Vec<String> =
        worst.iter().take(3).map(|(nanos, px)| format!("{:.2} s ({px:.2} px)", *nanos as f64 * 1e-9)).collect();
    lines.push(format!("worst boards: {}", times.join(", ")));
    lines
}

/// `calibration.json`.
fn report(seen: &SeenBoards, fit: &RigFit) -> serde_json::Value {
    let cameras: Vec<_> = seen
        .ids
        .iter()
        .zip(&fit.cameras)
        .map(|(id, camera)| {
            json!({
                "camera": id,
                "rms_px": camera.rms_px,
                "boards": camera.views,
                "corners": camera.corners.len(),
                "deviation_deg_mm": camera.deviation,
                "halves_deg_mm": camera.halves,
                "offset_secs": camera.lag_s.0,
                "offset_deviation_secs": camera.lag_s.1,
            })
        })
        .collect();
    json!({
        "rms_px": fit.rms_px,
        "sigma_px": fit.sigma_px,
        "bend_mm": fit.bend_mm,
        "cameras": cameras,
        "pairs": fit.pairs,
        "boards": fit.shots.iter().map(|(nanos, px)| json!({ "nanos": nanos, "rms_px": px })).collect::<Vec<_>>(),
    })
}

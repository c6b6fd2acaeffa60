//! `flyrig calibrate rig`: poses of all cameras from a board that they see together.

use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_calib::{Board, Deviation, LensModel, RigFit, RigOptions, calibrate_rig, load_lenses, save_calibration};
use flyrig_gpu::GpuContext;
use flyrig_report::{stop, write_whole};
use flyrig_types::Intrinsics;
use glam::DVec3;
use serde_json::json;

use super::{
    lens,
    output::{FILES, refuse_existing},
    page,
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

/// Name of the page about the calibration.
pub(super) const PAGE: &str = "calibration.html";
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

/// Destination of the results, and options of the solve.
pub(super) struct RigTarget<'a> {
    pub out: &'a Path,
    pub floor: bool,
    pub no_offsets: bool,
}

/// Runs the command.
pub fn rig(args: &CalibrateRigArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let board = load_board(&args.solve.board.board, &args.take)?;
    refuse_existing(&args.target.out, &[&FILES[..], &[PAGE]].concat(), args.target.force)?;
    let seen = SeenBoards::find(&args.take, &board, gpu)?;
    ensure!(seen.ids.len() > 1, "one camera alone is no rig; flyrig calibrate lens calibrates it");
    check_floor(args.solve.floor, &seen)?;
    let lenses = lenses(args.solve.lenses.as_deref(), &board, &seen)?;
    let refine = args.refine_lenses.then_some(LensModel::RadialTangential);
    let target = RigTarget { out: &args.target.out, floor: args.solve.floor, no_offsets: args.solve.no_offsets };
    solve_and_write(&target, &board, &seen, &lenses, refine)
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

/// Calibrates the poses, prints them, and writes all files.
pub(super) fn solve_and_write(
    args: &RigTarget<'_>,
    board: &Board,
    seen: &SeenBoards,
    lenses: &[Intrinsics],
    refine: Option<LensModel>,
) -> Result<()> {
    let solve = |lags, bend| {
        let options = RigOptions { lens: refine, lags, bend, floor_first: args.floor };
        calibrate_rig(board, &seen.ids, lenses, &seen.shots, options)
    };
    let plain = solve(false, false)?;
    // Offsets are kept only if the board moved and they lower the noise.
    let with_offsets = if args.no_offsets { None } else { solve(true, false).ok() };
    let better = |fit: &RigFit| {
        fit.sigma_px < OFFSETS_PAY * plain.sigma_px && fit.cameras.iter().all(|camera| camera.deviation.is_some())
    };
    let noise_before = plain.sigma_px;
    let (fit, has_offsets) = match with_offsets.filter(better) {
        Some(fit) => (fit, true),
        None => (plain, false),
    };
    let is_bent = |bent: &RigFit| {
        bent.sigma_px < BEND_PAYS * fit.sigma_px && bent.bend_mm.is_some_and(|(mm, sigma)| mm > BEND_SIGMAS * sigma)
    };
    let fit = solve(has_offsets, true).ok().filter(is_bent).unwrap_or(fit);
    let above =
        fit.rig.cameras.iter().map(|camera| camera.camera_from_world.rotation.inverse() * DVec3::NEG_Y).sum::<DVec3>();
    let tilt_deg = above.angle_between(fit.rig.world_up).to_degrees();
    ensure!(
        !args.floor || tilt_deg < MOST_TILT_DEG,
        "--floor: the first board stands {tilt_deg:.0} degrees off what the cameras have above them; begin the take with the board on \
         the floor, face up"
    );
    print(seen, &fit, has_offsets);
    let sentences = sentences(seen, &fit, has_offsets.then_some(noise_before));
    sentences.iter().for_each(|sentence| println!("{sentence}"));
    std::fs::create_dir_all(args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    let mut rig = fit.rig.clone();
    let mut deviations = Vec::new();
    for (camera, solved) in rig.cameras.iter_mut().zip(&fit.cameras) {
        let (lag_s, sigma_s) = solved.lag_s;
        if has_offsets {
            camera.time_offset_nanos = (1e9 * lag_s).round() as i64;
        }
        deviations.push(solved.deviation.map(|(rotation_deg, position_mm)| Deviation {
            rotation_deg,
            position_mm,
            time_offset_ms: has_offsets.then_some(1e3 * sigma_s),
        }));
    }
    save_calibration(args.out, &rig, &deviations)?;
    write_whole(&args.out.join("calibration.json"), &serde_json::to_vec_pretty(&report(seen, &fit))?)?;
    page::page(&seen.ids, &fit, sentences).save(&args.out.join(PAGE))?;
    println!("{}: {}, {PAGE}", args.out.display(), FILES.join(", "));
    println!(
        "next: look at {}, set source.path = \"{}\" in the configuration, then flyrig doctor",
        args.out.join(PAGE).display(),
        args.out.display()
    );
    Ok(())
}

/// Loads the lenses of a folder, or calibrates them from this take.
pub(super) fn lenses(folder: Option<&Path>, board: &Board, seen: &SeenBoards) -> Result<Vec<Intrinsics>> {
    let Some(folder) = folder else {
        return Ok(lens::solve(board, seen)?.into_iter().map(|(_, intrinsics)| intrinsics).collect());
    };
    let size = |id: &_| {
        let slot = seen.ids.iter().position(|known| known == id)?;
        seen.sizes[slot].map(|[width, height]| (width, height))
    };
    let known = load_lenses(folder, &size)?;
    let of = |id| {
        let found = known.iter().find(|(known, _)| known == id).map(|(_, intrinsics)| *intrinsics);
        found.with_context(|| {
            format!("camera {id} is not in {}; calibrate its lens, or leave --lenses out", folder.display())
        })
    };
    seen.ids.iter().map(of).collect()
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

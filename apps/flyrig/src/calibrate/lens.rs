//! `flyrig calibrate lens`: calibrates the lens of each camera separately.

use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_calib::{Board, LensFit, calibrate_lens, load_lenses, save_lenses};
use flyrig_gpu::GpuContext;
use flyrig_report::stop;
use flyrig_types::{CameraId, Intrinsics};

use super::{
    output::refuse_existing,
    views::{BoardTakeArgs, SeenBoards, load_board},
};
use crate::arguments::{BoardArgs, TargetArgs};

/// Arguments of `flyrig calibrate lens`.
#[derive(Debug, Args)]
pub struct CalibrateLensArgs {
    #[command(flatten)]
    pub take: BoardTakeArgs,
    #[command(flatten)]
    pub board: BoardArgs,
    #[command(flatten)]
    pub target: TargetArgs,
}

/// Least coverage of an image, 0..=1: below it the lens is extrapolated at the edges.
const GOOD_COVERAGE: f64 = 0.6;

/// Runs the command.
pub fn lens(args: &CalibrateLensArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let board = load_board(&args.board.board, &args.take)?;
    refuse_existing(&args.target.out, &["calibration.toml"], args.target.force)?;
    let seen = SeenBoards::find(&args.take, &board, gpu)?;
    let (mut lenses, mut missing) = (Vec::<(CameraId, Intrinsics)>::new(), Vec::new());
    for (id, lens) in seen.ids.iter().zip(solve(&board, &seen)) {
        match lens {
            Ok(lens) => lenses.push((id.clone(), lens)),
            Err(error) => missing.push(format!("{error:#}")),
        }
    }
    ensure!(!lenses.is_empty(), "{}", missing.join("; "));
    std::fs::create_dir_all(&args.target.out)
        .with_context(|| format!("cannot create {}", args.target.out.display()))?;
    save_lenses(&args.target.out, &lenses)?;
    println!("{}: calibration.toml with lenses alone", args.target.out.display());
    ensure!(
        missing.is_empty(),
        "{}; the lenses of the other {} cameras are written; show the board to these cameras too and run this again with --force",
        missing.join("; "),
        lenses.len()
    );
    println!("next: flyrig calibrate rig TAKE --lenses {}", args.target.out.display());
    Ok(())
}

/// Lenses of the cameras of a take.
pub(super) struct Lenses {
    /// One per camera; an error says what is missing.
    pub by_slot: Vec<Result<Intrinsics>>,
    /// Whether they were calibrated from the take.
    pub are_new: bool,
}

impl Lenses {
    /// Loads the lenses of a folder, or calibrates them from this take.
    pub fn load_or_solve(folder: Option<&Path>, board: &Board, seen: &SeenBoards) -> Result<Self> {
        let Some(folder) = folder else { return Ok(Self { by_slot: solve(board, seen), are_new: true }) };
        let size = |id: &_| {
            let slot = seen.ids.iter().position(|known| known == id)?;
            seen.sizes[slot].map(|[width, height]| (width, height))
        };
        let known = load_lenses(folder, &size)?;
        let of = |id: &CameraId| {
            let found = known.iter().find(|(known, _)| known == id).map(|(_, intrinsics)| *intrinsics);
            found.with_context(|| {
                format!("camera {id} is not in {}; calibrate its lens, or leave --lenses out", folder.display())
            })
        };
        let lenses = seen.ids.iter().map(of).collect::<Result<Vec<_>>>()?;
        Ok(Self { by_slot: lenses.into_iter().map(Ok).collect(), are_new: false })
    }

    /// Returns all lenses.
    ///
    /// # Errors
    /// Missing part for each camera without one.
    pub fn all(&self) -> Result<Vec<Intrinsics>> {
        let missing: Vec<String> =
            self.by_slot.iter().filter_map(|lens| Some(format!("{:#}", lens.as_ref().err()?))).collect();
        ensure!(missing.is_empty(), "{}", missing.join("; "));
        Ok(self.by_slot.iter().flatten().copied().collect())
    }
}

/// Calibrates the lens of every camera, in their order, and prints the residuals.
fn solve(board: &Board, seen: &SeenBoards) -> Vec<Result<Intrinsics>> {
    println!(
        "{:<14} {:>6} {:>7} {:>9} {:>18} {:>16} {:>9}  lens",
        "camera", "boards", "rms px", "noise px", "focal px", "centre px", "covered"
    );
    (0..seen.ids.len()).map(|slot| solve_camera(board, seen, slot)).collect()
}

fn solve_camera(board: &Board, seen: &SeenBoards, slot: usize) -> Result<Intrinsics> {
    seen.check(slot, board)?;
    let (id, views) = (&seen.ids[slot], seen.of_camera(slot));
    let size = seen.sizes[slot].with_context(|| format!("camera {id}: no image"))?;
    let fit = calibrate_lens(board, id, size, &views)?;
    let (focal, center, [dx, dy, du, dv]) = (fit.intrinsics.focal_px, fit.intrinsics.center_px, fit.deviations_px);
    println!(
        "{:<14} {:>6} {:>7.3} {:>9.3} {:>18} {:>16} {:>8.0}%  {}",
        id,
        fit.views.len(),
        fit.rms_px,
        fit.sigma_px,
        format!("{:.1} +-{:.1}", 0.5 * (focal.x + focal.y), dx.max(dy)),
        format!("{:.0} {:.0} +-{:.1}", center.x, center.y, du.max(dv)),
        100.0 * fit.coverage,
        model(&fit)
    );
    advise(id, &fit);
    Ok(fit.intrinsics)
}

/// Formats the lens model, and the error of each model on held-out views.
fn model(fit: &LensFit) -> String {
    let errors: Vec<String> = fit.held_out_px.iter().map(|(model, px)| format!("{} {px:.3}", model.name())).collect();
    format!("{} (kept-out views, px: {})", fit.model.name(), errors.join(", "))
}

fn advise(id: &CameraId, fit: &LensFit) {
    if fit.coverage < GOOD_COVERAGE {
        println!(
            "  camera {id}: boards cover {:.0} % of the image; show it in the corners as well",
            100.0 * fit.coverage
        );
    }
    if !fit.suspects.is_empty() {
        let times: Vec<String> = fit.suspects.iter().map(|nanos| format!("{:.2} s", *nanos as f64 * 1e-9)).collect();
        println!(
            "  camera {id}: these images fit far worse than the others (blur, a bent board?): {}",
            times.join(", ")
        );
    }
}

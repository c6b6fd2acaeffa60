//! `flyrig calibrate lens`: calibrates the lens of each camera separately.

use anyhow::{Context as _, Result};
use clap::Args;
use flyrig_calib::{Board, LensFit, calibrate_lens, save_lenses};
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
    let lenses = solve(&board, &seen)?;
    std::fs::create_dir_all(&args.target.out)
        .with_context(|| format!("cannot create {}", args.target.out.display()))?;
    save_lenses(&args.target.out, &lenses)?;
    println!("{}: calibration.toml with lenses alone", args.target.out.display());
    println!("next: flyrig calibrate rig TAKE --lenses {}", args.target.out.display());
    Ok(())
}

/// Calibrates the lens of every camera and prints the residuals.
pub fn solve(board: &Board, seen: &SeenBoards) -> Result<Vec<(CameraId, Intrinsics)>> {
    let mut lenses = Vec::new();
    println!(
        "{:<14} {:>6} {:>7} {:>9} {:>18} {:>16} {:>9}  lens",
        "camera", "boards", "rms px", "noise px", "focal px", "centre px", "covered"
    );
    for (slot, id) in seen.ids.iter().enumerate() {
        let views = seen.of_camera(slot);
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
        lenses.push((id.clone(), fit.intrinsics));
    }
    Ok(lenses)
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

//! Cameras that do not expose together.

use flyrig_gpu::AdapterChoice;

use super::case::{Row, pipeline, run_pipeline};
use super::*;

/// Scores of the second half of a fast turn, with cameras that expose so long after the instant.
fn scores(gpu: &GpuContext, seed: u64, side: u32, shifts: &[i64], per_view_time: bool, solver: Solver) -> Row {
    let config = SequenceConfig { seed, side, frames: 12, fps: 30.0 };
    let sequence = Sequence::simulate_shifted(gpu, config, shifts).unwrap();
    let case =
        Case { solver, iterations: None, gaussians: 12_000, compared: Some(12_000), full_size: true, views: 3, side };
    let mut pipeline = pipeline(gpu, &sequence, &case).unwrap();
    pipeline.per_view_time = per_view_time;
    run_pipeline(pipeline, &sequence, &case).unwrap()
}

/// A full turn in 2.4 seconds; phases spread over a frame's period, as seeds 1, 2, 3 of a uniform draw give them.
#[test]
fn a_rig_without_genlock_loses_little_with_the_time_of_each_view() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let shifts = [4_100_000, 29_300_000, 17_600_000];
    for solver in [Solver::None, Solver::GaussNewton] {
        let together = scores(&gpu, 1, 192, &[], true, solver);
        let on = scores(&gpu, 1, 192, &shifts, true, solver);
        let off = scores(&gpu, 1, 192, &shifts, false, solver);
        println!(
            "{solver:?}: genlock {:.2} dB, {:.1} mm; per-view time on {:.2} dB, {:.1} mm; off {:.2} dB, {:.1} mm",
            together.psnr_db, together.chamfer_mm, on.psnr_db, on.chamfer_mm, off.psnr_db, off.chamfer_mm
        );
        assert!(on.psnr_db > together.psnr_db - 0.3, "{solver:?}");
        assert!(on.psnr_db > off.psnr_db + 0.02, "{solver:?}: the switch does something");
    }
}

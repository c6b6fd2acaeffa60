//! Cameras without a common exposure.

use flyrig_fusion::Solver;
use flyrig_gpu::{AdapterChoice, GpuContext};

use super::case::{Case, CaseRow, run_session, session};
use crate::harness::sequence::{SequenceConfig, SequenceMotion, SimulatedSequence};

const SIDE: u32 = 160;

/// Returns the scores of the second half of a fast turn.
fn scores(gpu: &GpuContext, sequence: &SimulatedSequence, per_view_time: bool, solver: Solver) -> CaseRow {
    let case = Case::new(solver, 9_000, 3, sequence.config());
    let mut session = session(gpu, sequence, &case).unwrap();
    session.set_per_view_time(per_view_time);
    run_session(session, sequence, &case).unwrap()
}

/// Tests a full turn in two seconds; each camera exposes at some time within the frame period after the instant.
#[test]
#[ignore = "minutes: run by make test-long"]
fn a_rig_without_genlock_loses_little_with_the_time_of_each_view() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let config = SequenceConfig { motion: SequenceMotion::Turn, seed: 1, side: SIDE, frames: 10, fps: 30.0 };
    let genlocked = SimulatedSequence::simulate(&gpu, config).unwrap();
    let shifted = SimulatedSequence::simulate_shifted(&gpu, config, &[4_100_000, 29_300_000, 17_600_000]).unwrap();
    for solver in [Solver::None, Solver::GaussNewton] {
        let together = scores(&gpu, &genlocked, true, solver);
        let on = scores(&gpu, &shifted, true, solver);
        let off = scores(&gpu, &shifted, false, solver);
        println!(
            "{solver:?}: genlock {:.2} dB, {:.1} mm; per-view time on {:.2} dB, {:.1} mm; off {:.2} dB, {:.1} mm",
            together.psnr_db, together.chamfer_mm, on.psnr_db, on.chamfer_mm, off.psnr_db, off.chamfer_mm
        );
        assert!(on.psnr_db > together.psnr_db - 0.3, "{solver:?}");
        assert!(on.psnr_db > off.psnr_db, "{solver:?}: the switch does something");
        assert!(solver == Solver::None || on.psnr_db > off.psnr_db + 0.5, "{solver:?}: and much for the deformation");
    }
}

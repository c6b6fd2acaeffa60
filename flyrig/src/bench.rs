//! `flyrig bench track`: how much error is left for how much time, on simulated people whose clothes are known.

mod case;
pub(crate) mod plot;
mod sequence;
mod surface;
mod write;

use anyhow::{Context, Result};
use flyrig_gpu::GpuContext;

use self::case::{Case, run_case};
pub use self::sequence::{Sequence, SequenceConfig};
use crate::{cli::BenchTrackArgs, config::Solver, eval::progress_bar};

/// Runs the command.
pub fn track(args: &BenchTrackArgs, gpu: &GpuContext) -> Result<()> {
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    let cases = grid(args);
    let bar = progress_bar(cases.len() as u64, "bench track");
    let mut rows = Vec::new();
    let mut sequence: Option<Sequence> = None;
    for case in cases {
        bar.set_message(case.name());
        let config = SequenceConfig { seed: args.seed, side: case.side, frames: args.frames, fps: 30.0 };
        let scene = match sequence.take().filter(|known| known.config() == config) {
            Some(known) => known,
            None => Sequence::simulate(gpu, config)?,
        };
        rows.push(run_case(gpu, &scene, &case)?);
        // After every case, so that a run that is stopped leaves what it has.
        write::all(&args.out, &gpu.adapter_name(), args, &rows)?;
        sequence = Some(scene);
        bar.inc(1);
    }
    bar.finish_and_clear();
    print!("{}", write::table(&rows));
    println!("\nwritten to {}: track.csv, track.json, track.svg, energy.svg, views.svg", args.out.display());
    Ok(())
}

/// What is compared: solvers, iterations, Gaussians, resolution, views; ordered so that a sequence is simulated once a
/// resolution.
fn grid(args: &BenchTrackArgs) -> Vec<Case> {
    let base = Case {
        solver: Solver::GaussNewton,
        iterations: None,
        gaussians: args.gaussians,
        compared: None,
        full_size: false,
        views: 3,
        side: args.side,
    };
    let mut cases = vec![Case { solver: Solver::None, ..base }, Case { solver: Solver::Paper, ..base }, base];
    if args.quick {
        return cases;
    }
    cases.extend([[1, 1], [6, 1], [6, 2], [10, 4]].map(|n| Case { iterations: Some(n), ..base }));
    cases.extend([8_000, 15_000, 60_000].map(|n| Case { compared: Some(n), ..base }));
    cases.push(Case { full_size: true, ..base });
    cases.push(Case { compared: Some(usize::MAX), full_size: true, ..base });
    for views in [1, 2, 4, 6] {
        cases.push(Case { views, ..base });
        cases.push(Case { views, solver: Solver::None, ..base });
    }
    for side in [args.side / 2, args.side * 3 / 2] {
        cases.extend([Solver::None, Solver::GaussNewton].map(|solver| Case { side, solver, ..base }));
    }
    cases
}

#[cfg(test)]
#[path = "bench/desync_tests.rs"]
mod desync_tests;

#[cfg(test)]
#[path = "bench/state_tests.rs"]
mod state_tests;

//! `flyrig-bench track`: error against run time of the deformation, on simulated people whose surface is known.

use anyhow::{Context, Result, ensure};
use flyrig_fusion::{PAPER_COLOR_WEIGHT, Solver};
use flyrig_gpu::GpuContext;
use flyrig_report::progress_bar;
use flyrig_tracker::DeformSolver;

use crate::{
    case::{Case, run_case},
    cli::BenchTrackArgs,
    sequence::{Motion, Sequence, SequenceConfig},
    summary, write,
};

/// Runs the command.
pub fn track(args: &BenchTrackArgs, gpu: &GpuContext) -> Result<()> {
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    let mut cases = grid(args);
    if let Some(only) = &args.only {
        let names: Vec<String> = cases.iter().map(Case::name).collect();
        cases.retain(|case| case.name().contains(only.as_str()));
        ensure!(!cases.is_empty(), "no case is named like '{only}'; there are:\n  {}", names.join("\n  "));
    }
    let bar = progress_bar(cases.len() as u64, "bench track");
    let mut rows = Vec::new();
    let mut sequence: Option<Sequence> = None;
    for case in cases {
        bar.set_message(case.name());
        let scene = match sequence.take().filter(|known| known.config() == case.sequence) {
            Some(known) => known,
            None => Sequence::simulate(gpu, case.sequence)?,
        };
        rows.push(run_case(gpu, &scene, &case)?);
        // After every case, so that a run that is stopped leaves what it has.
        write::all(&args.out, &gpu.fastest().adapter_name(), &rows)?;
        sequence = Some(scene);
        bar.inc(1);
    }
    bar.finish_and_clear();
    print!("{}", summary::summary(&rows));
    println!("\nwritten to {}: track.csv, track.json, track.txt, track.svg, energy.svg, views.svg", args.out.display());
    Ok(())
}

/// What is compared: solvers, iterations, Gaussians, resolution, views, what is skipped, people; ordered so that a sequence
/// is simulated once.
fn grid(args: &BenchTrackArgs) -> Vec<Case> {
    let turn =
        SequenceConfig { motion: Motion::Turn, seed: args.seed, side: args.side, frames: args.frames, fps: 30.0 };
    let case = |solver, views, sequence| Case::new(solver, args.gaussians, views, sequence);
    let base = case(Solver::GaussNewton, VIEWS, turn);
    let mut cases = vec![case(Solver::None, VIEWS, turn), case(Solver::Paper, VIEWS, turn), base.clone()];
    if args.quick {
        return cases;
    }
    for [first_iterations, iterations] in [[1, 1], [6, 1], [6, 2], [10, 4]] {
        cases.push(base.but(&format!("{first_iterations}/{iterations} iterations"), |options| {
            options.solver.solver = DeformSolver::GaussNewton { first_iterations, iterations };
        }));
    }
    for gaussians in [8_000, 15_000, 60_000] {
        cases.push(base.but(&format!("{gaussians} Gaussians"), |options| options.gaussians = gaussians));
    }
    cases.push(base.but(ALL_GAUSSIANS, |options| {
        (options.gaussians, options.gaussians_a_pixel) = (usize::MAX, f64::INFINITY);
    }));
    for weight in [PAPER_COLOR_WEIGHT, 0.1] {
        cases.push(base.but(&format!("colour weight {weight}"), |options| options.color_weight = weight));
    }
    cases.push(base.but("no stiff parts", |options| options.stiff_parts = false));
    let full = base.but(FULL_SIZE, |options| options.max_level = 0);
    cases.push(full.but("8000 Gaussians", |options| options.gaussians = 8_000));
    cases.push(full.but(ALL_GAUSSIANS, |options| {
        (options.gaussians, options.gaussians_a_pixel) = (usize::MAX, f64::INFINITY);
    }));
    cases.push(full);
    for views in [1, 2, 4, 6] {
        cases.push(case(Solver::None, views, turn));
        cases.push(case(Solver::GaussNewton, views, turn).but(ALL_VIEWS, |options| options.views = 0));
    }
    cases.push(base.but(ALL_VIEWS, |options| options.views = 0));
    for most in [2, 3, 4] {
        let name = format!("{most} compared");
        cases.push(case(Solver::GaussNewton, 6, turn).but(&name, |options| options.views = most));
    }
    for side in [small(args.side), args.side / 2, args.side * 3 / 2] {
        let sequence = SequenceConfig { side, ..turn };
        let usual = case(Solver::GaussNewton, VIEWS, sequence);
        cases.push(case(Solver::None, VIEWS, sequence));
        if side == small(args.side) {
            cases.push(usual.but(ALL_DETAIL, |options| *options = options.without_level_of_detail()));
        } else {
            cases.push(usual.but(FULL_SIZE, |options| options.max_level = 0));
        }
        cases.push(usual);
    }
    let still = case(Solver::GaussNewton, VIEWS, SequenceConfig { motion: Motion::Still, ..turn });
    cases.push(still.but(NO_REST, |options| options.solver.rest = 0.0));
    cases.push(still.but("no rest, colour weight 2", |options| {
        (options.solver.rest, options.color_weight) = (0.0, PAPER_COLOR_WEIGHT);
    }));
    cases.push(still);
    for seed in (1..=4).filter(|seed| *seed != args.seed) {
        let sequence = SequenceConfig { seed, ..turn };
        cases.extend([Solver::None, Solver::GaussNewton].map(|solver| case(solver, VIEWS, sequence)));
    }
    cases
}

/// Images where a pixel covers several of the compared Gaussians.
pub fn small(side: u32) -> u32 {
    (side * 5 / 16).max(16)
}

/// Input cameras, where nothing else is told.
pub const VIEWS: usize = 3;
pub const ALL_GAUSSIANS: &str = "all Gaussians";
pub const FULL_SIZE: &str = "full size";
pub const ALL_DETAIL: &str = "all detail";
pub const ALL_VIEWS: &str = "all views";
pub const NO_REST: &str = "no rest";

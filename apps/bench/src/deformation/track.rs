//! `flyrig-bench track`: error against run time of the deformation, on simulated people whose surface is known.

use anyhow::{Result, ensure};
use clap::{Args, builder::TypedValueParser as _};
use flyrig_fusion::{PAPER_COLOR_WEIGHT, Solver};
use flyrig_gpu::GpuContext;
use flyrig_report::{arguments::GaussiansArgs, progress_bar};
use flyrig_tracker::DeformSolver;

use super::{
    case::{Case, run_case},
    cases::{ALL_DETAIL, ALL_GAUSSIANS, ALL_VIEWS, FULL_SIZE, NO_REST, VIEWS, small},
    summary, write,
};
use crate::harness::{
    arguments::SimulationArgs,
    sequence::{SequenceConfig, SequenceMotion, SimulatedSequence},
};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-track")))]
pub struct BenchTrackArgs {
    /// Frames of the sequence.
    #[arg(long, default_value_t = 14, value_parser = clap::value_parser!(u16).range(2..=1000).map(usize::from))]
    pub frames: usize,
    /// Run the three solvers alone.
    #[arg(long)]
    pub quick: bool,
    /// Run only cases whose names contain this text, such as "2 views".
    #[arg(long)]
    pub only: Option<String>,
    #[command(flatten)]
    pub simulation: SimulationArgs,
    #[command(flatten)]
    pub surface: GaussiansArgs,
}

/// Runs the command.
pub fn track(args: &BenchTrackArgs, gpu: &GpuContext) -> Result<()> {
    args.simulation.output.create()?;
    let mut cases = grid(args);
    if let Some(only) = &args.only {
        let names: Vec<String> = cases.iter().map(Case::name).collect();
        cases.retain(|case| case.name().contains(only.as_str()));
        ensure!(!cases.is_empty(), "no case is named like '{only}'; there are:\n  {}", names.join("\n  "));
    }
    let bar = progress_bar(cases.len() as u64, "bench track");
    let mut rows = Vec::new();
    let mut sequence: Option<SimulatedSequence> = None;
    for case in cases {
        bar.set_message(case.name());
        let scene = match sequence.take().filter(|known| known.config() == case.sequence) {
            Some(known) => known,
            None => SimulatedSequence::simulate(gpu, case.sequence)?,
        };
        rows.push(run_case(gpu, &scene, &case)?);
        // After every case, so that a run that is stopped leaves what it has.
        write::all(&args.simulation.output.out, &gpu.fastest().adapter_name(), &rows)?;
        sequence = Some(scene);
        bar.inc(1);
    }
    bar.finish_and_clear();
    print!("{}", summary::summary(&rows));
    println!(
        "\nwritten to {}: track.csv, track.json, track.txt, track.svg, energy.svg, views.svg",
        args.simulation.output.out.display()
    );
    Ok(())
}

/// Returns all cases (solvers, iterations, Gaussians, resolutions, views, skipped work, people), those of one sequence in succession so
/// that it is simulated once.
fn grid(args: &BenchTrackArgs) -> Vec<Case> {
    let turn = SequenceConfig {
        motion: SequenceMotion::Turn,
        seed: args.simulation.seed,
        side: args.simulation.side,
        frames: args.frames,
        fps: 30.0,
    };
    let case = |solver, views, sequence| Case::new(solver, args.surface.gaussians, views, sequence);
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
    for side in [small(args.simulation.side), args.simulation.side / 2, args.simulation.side * 3 / 2] {
        let sequence = SequenceConfig { side, ..turn };
        let usual = case(Solver::GaussNewton, VIEWS, sequence);
        cases.push(case(Solver::None, VIEWS, sequence));
        if side == small(args.simulation.side) {
            cases.push(usual.but(ALL_DETAIL, |options| *options = options.without_level_of_detail()));
        } else {
            cases.push(usual.but(FULL_SIZE, |options| options.max_level = 0));
        }
        cases.push(usual);
    }
    let still = case(Solver::GaussNewton, VIEWS, SequenceConfig { motion: SequenceMotion::Still, ..turn });
    cases.push(still.but(NO_REST, |options| options.solver.rest = 0.0));
    cases.push(still.but("no rest, colour weight 2", |options| {
        (options.solver.rest, options.color_weight) = (0.0, PAPER_COLOR_WEIGHT);
    }));
    cases.push(still);
    for seed in (1..=4).filter(|seed| *seed != args.simulation.seed) {
        let sequence = SequenceConfig { seed, ..turn };
        cases.extend([Solver::None, Solver::GaussNewton].map(|solver| case(solver, VIEWS, sequence)));
    }
    cases
}

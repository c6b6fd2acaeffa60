//! `flyrig-bench`: benchmarks that print run time beside error.

mod appearance;
mod avatar;
mod budget;
mod capture;
mod cli;
mod deformation;
mod harness;
mod people;
mod perception;
mod scale;
mod stream;
mod surfaces;
mod watch;

use std::process::ExitCode;

use anyhow::Result;
use clap::Parser as _;
use flyrig_report::{
    program::{self, open_gpu},
    traced,
};

use crate::cli::{BenchCli, BenchCommand};

#[allow(unsafe_code)]
fn main() -> ExitCode {
    // SAFETY: no other thread runs yet.
    unsafe { flyrig_transport::use_one_network_thread() };
    flyrig_fusion::share_memory_pools();
    let cli = BenchCli::parse();
    program::start_log(cli.program.verbose, false);
    program::exit_code(traced(cli.program.trace.as_deref(), || dispatch(&cli)))
}

fn dispatch(cli: &BenchCli) -> Result<()> {
    let gpu = || open_gpu(cli.program.adapter.as_deref());
    match &cli.command {
        BenchCommand::Track(args) => deformation::track::track(args, &gpu()?),
        BenchCommand::Endure(args) => deformation::endure::endure(args, &gpu()?),
        BenchCommand::Appearance(args) => appearance::appearance(args, &gpu()?),
        BenchCommand::Avatar(args) => avatar::avatar(args, &gpu()?),
        BenchCommand::Budget(args) => budget::budget(args, &gpu()?),
        BenchCommand::Capture(args) => capture::capture(args),
        BenchCommand::Stress(args) => perception::stress::stress(args, &gpu()?),
        BenchCommand::Hands(args) => perception::hands::hands(args, &gpu()?),
        BenchCommand::Landmarks(args) => perception::landmarks::landmarks(args),
        BenchCommand::Stream(args) => stream::stream(args, &gpu()?),
        BenchCommand::Receive(args) => stream::receive::receive(args, &gpu()?),
        BenchCommand::Watch(args) => watch::watch(args, &gpu()?),
        BenchCommand::Masks(args) => perception::masks::masks(args),
        BenchCommand::Perception(args) => perception::perception(args, &gpu()?),
        BenchCommand::Surfaces(args) => surfaces::surfaces(args, &gpu()?),
        BenchCommand::Scale(args) => scale::scale(args, &gpu()?),
        BenchCommand::Takes(args) => people::takes::takes(args, &gpu()?),
        BenchCommand::Subjects(args) => people::subjects::subjects(args, &gpu()?),
        BenchCommand::Record(args) => capture::record::record(args, &gpu()?),
    }
}

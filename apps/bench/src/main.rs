//! `flyrig-bench`: benchmarks that print run time beside error.

mod appearance;
mod avatar;
mod avatar_detail;
mod budget;
mod capture;
mod case;
mod cli;
mod endure;
mod hands;
mod landmarks;
mod mask_errors;
mod masks;
mod perception;
mod processor;
mod receive;
mod recording;
mod rest;
mod scale;
mod sequence;
mod steady;
mod stream;
mod stress;
mod subjects;
mod summary;
mod surface;
mod takes;
mod track;
mod watch;
mod write;

#[cfg(test)]
mod desync_tests;
#[cfg(test)]
mod first_sets_tests;
#[cfg(test)]
mod hands_tests;
#[cfg(test)]
mod other_person_tests;
#[cfg(test)]
mod state_tests;

use std::process::ExitCode;

use anyhow::Result;
use clap::Parser as _;
use flyrig_report::{
    program::{self, open_gpu},
    traced,
};

use crate::cli::{BenchCommand, Cli};

#[allow(unsafe_code)]
fn main() -> ExitCode {
    // SAFETY: no other thread runs yet.
    unsafe { flyrig_transport::use_one_network_thread() };
    let cli = Cli::parse();
    program::start_log(cli.verbose, false);
    program::exit_code(traced(cli.trace.as_deref(), || dispatch(&cli)))
}

fn dispatch(cli: &Cli) -> Result<()> {
    let gpu = || open_gpu(cli.adapter.as_deref());
    match &cli.command {
        BenchCommand::Track(args) => track::track(args, &gpu()?),
        BenchCommand::Endure(args) => endure::endure(args, &gpu()?),
        BenchCommand::Appearance(args) => appearance::appearance(args, &gpu()?),
        BenchCommand::Avatar(args) => avatar::avatar(args, &gpu()?),
        BenchCommand::Budget(args) => budget::budget(args, &gpu()?),
        BenchCommand::Capture(args) => capture::capture(args),
        BenchCommand::Stress(args) => stress::stress(args, &gpu()?),
        BenchCommand::Hands(args) => hands::hands(args, &gpu()?),
        BenchCommand::Landmarks(args) => landmarks::landmarks(args),
        BenchCommand::Stream(args) => stream::stream(args, &gpu()?),
        BenchCommand::Receive(args) => receive::receive(args, &gpu()?),
        BenchCommand::Watch(args) => watch::watch(args, &gpu()?),
        BenchCommand::Masks(args) => masks::masks(args),
        BenchCommand::Perception(args) => perception::perception(args, &gpu()?),
        BenchCommand::Scale(args) => scale::scale(args, &gpu()?),
        BenchCommand::Takes(args) => takes::takes(args, &gpu()?),
        BenchCommand::Subjects(args) => subjects::subjects(args, &gpu()?),
        BenchCommand::Record(args) => recording::record(args, &gpu()?),
    }
}

//! The `flyrig` command: wires the stages, reads the configuration, writes the reports.
//!
//! A library only so that the end-to-end tests can build the same program; its documentation is `--help`.

mod arguments;
mod avatar;
mod calibrate;
mod capture;
mod cli;
mod config;
mod config_check;
mod demo;
mod doctor;
mod eval;
mod import;
mod keys;
mod mesh;
mod opening;
mod orbit_film;
mod plate;
mod pose_recording;
mod recording;
mod replay;
mod run;
mod serve;
mod sim_export;
mod simulator_file;
#[cfg(test)]
mod source_tests;
mod stream_film;
mod stream_recording;
mod sync_check;
mod take_choices;
mod toml_errors;
mod video_file;
mod view;
mod watch;

use std::process::ExitCode;

use anyhow::Result;
use clap::Parser as _;
use flyrig_report::{
    program::{self, open_gpu},
    traced,
};
use flyrig_takes::SourceKind;

use crate::{
    cli::{Cli, Command, ConfigAction},
    config::{Config, DEFAULT_TOML},
    sim_export::SimAction,
};

/// Checks the text of a configuration; the error is that of `flyrig config check`.
///
/// # Errors
/// Names the key, its value, and the expected values.
pub fn check_config(text: &str) -> Result<(), String> {
    Config::parse(text).map(|_| ()).map_err(|error| program::one_line(&error))
}

/// Reads and checks the simulator's configuration, as `flyrig sim print` prints it.
///
/// # Errors
/// Names the key, what was found, and what is expected.
pub fn check_simulator(text: &str) -> Result<(), String> {
    simulator_file::parse(text).map(|_| ()).map_err(|error| program::one_line(&error))
}

/// Checks a command line, whose first word is the program: its options and values must be known, and nothing is run.
///
/// # Errors
/// The error that the command would print.
pub fn check_command(words: &[String]) -> Result<(), String> {
    use clap::error::ErrorKind;
    match Cli::try_parse_from(words) {
        Err(error) if !matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion) => {
            Err(error.to_string())
        }
        Ok(_) | Err(_) => Ok(()),
    }
}

/// Runs the command line of this process. Call it at the beginning of `main`, before any other thread starts.
#[must_use]
#[allow(unsafe_code)]
pub fn main() -> ExitCode {
    // SAFETY: no other thread runs yet.
    unsafe {
        flyrig_transport::use_one_network_thread();
        program::look_for_no_desktop();
    }
    flyrig_fusion::share_memory_pools();
    let cli = Cli::from_arguments();
    program::start_log(cli.program.verbose, cli.log_json);
    if let Some(line) = cli.command.first_line() {
        eprintln!("{}", flyrig_types::escape_controls(&line));
    }
    program::exit_code(traced(cli.program.trace.as_deref(), || dispatch(&cli)))
}

fn dispatch(cli: &Cli) -> Result<()> {
    match &cli.command {
        Command::Demo(args) => demo::demo(args, &open_gpu(cli.program.adapter.as_deref())?),
        Command::Run { config, record, table, trust } => {
            let config = Config::load(config)?;
            let adapter = cli.program.adapter.as_deref().or(Some(config.gpu.adapter.as_str()));
            let gpu = open_gpu(adapter)?;
            let source = &config.source;
            if matches!(source.kind, SourceKind::Folder | SourceKind::Video)
                && source.calibration.as_os_str().is_empty()
            {
                trust.check(&source.path, source.fps, &gpu)?;
            }
            run::run(&config, &gpu, record.as_deref(), *table)
        }
        Command::Record(args) => {
            let config = Config::load_for_capture(&args.config)?;
            let adapter = cli.program.adapter.as_deref().or(Some(config.gpu.adapter.as_str()));
            let gpu = (config.source.kind == SourceKind::Sim).then(|| open_gpu(adapter)).transpose()?;
            recording::record(&config, args, gpu.as_ref())
        }
        Command::Capture { config, key } => {
            let config = Config::load_for_capture(config)?;
            let adapter = cli.program.adapter.as_deref().or(Some(config.gpu.adapter.as_str()));
            let gpu = (config.source.kind == SourceKind::Sim).then(|| open_gpu(adapter)).transpose()?;
            capture::capture(&config, key.as_deref(), gpu.as_ref())
        }
        Command::Import(args) => import::run(args, &|| open_gpu(cli.program.adapter.as_deref())),
        Command::Replay(args) => replay::replay(args),
        Command::SyncCheck(args) => sync_check::sync_check(args, &|| open_gpu(cli.program.adapter.as_deref())),
        Command::Plate(args) => plate::plate(args, &|| open_gpu(cli.program.adapter.as_deref())),
        Command::Calibrate { action } => calibrate::calibrate(action, &|| open_gpu(cli.program.adapter.as_deref())),
        Command::Doctor { config } => doctor::doctor(config.as_deref()),
        Command::View(args) => view::view(args, || open_gpu(cli.program.adapter.as_deref())),
        Command::Serve(args) => serve::serve(args),
        Command::Watch(args) => match &args.record {
            Some(path) => stream_recording::record(args, path),
            None => watch::watch(args),
        },
        Command::Keys { action } => keys::keys(action),
        Command::Play(args) => match &args.orbit {
            Some(path) => stream_film::film(&args.recording, path, &open_gpu(cli.program.adapter.as_deref())?),
            None => stream_recording::play(args),
        },
        Command::Avatar { action } => avatar::avatar(action, &|| open_gpu(cli.program.adapter.as_deref())),
        Command::Mesh(args) => mesh::mesh(args, &|| open_gpu(cli.program.adapter.as_deref())),
        Command::Eval(args) => eval::eval(args, &open_gpu(cli.program.adapter.as_deref())?),
        Command::Sim { action: SimAction::Export(args) } => {
            let config = args.config.as_deref().map(sim_export::load_config).transpose()?.unwrap_or_default();
            sim_export::sim_export(args, &config, &open_gpu(cli.program.adapter.as_deref())?)
        }
        Command::Sim { action: SimAction::Print } => {
            print!("{}", simulator_file::DEFAULT_TOML);
            Ok(())
        }
        Command::Train(args) => flyrig_training::train(args, &|| open_gpu(cli.program.adapter.as_deref())),
        Command::Config { action: ConfigAction::Print } => {
            print!("{DEFAULT_TOML}");
            Ok(())
        }
        Command::Config { action: ConfigAction::Check { config, offline } } => config_check::check(config, *offline),
    }
}

//! The `flyrig` command: wires the stages, reads the configuration, writes the reports.
//!
//! A library only so that the end-to-end tests can build the same program; its documentation is `--help`.

mod bench;
mod cameras;
mod capture;
mod cli;
mod config;
mod dataset;
mod deformation;
mod demo;
mod doctor;
mod engine;
mod error_parts;
mod eval;
mod health;
mod intake;
mod live;
mod metrics_server;
mod network;
mod notify;
mod outlet;
mod outlines;
mod pipeline;
mod png;
mod pose_curve;
mod pose_recording;
mod record;
mod report;
mod run;
mod score;
mod silhouettes;
mod sim_export;
mod stats;
mod stop;
mod sync_check;
mod track_state;
mod train;
mod viewpoints;
mod watch;

use std::{io::IsTerminal, process::ExitCode};

use anyhow::Result;
use clap::Parser as _;
use flyrig_gpu::{AdapterChoice, GpuContext};
use tracing_subscriber::EnvFilter;

use crate::{
    cli::{BenchCommand, Cli, Command, ConfigAction, SimAction},
    config::{Config, DEFAULT_TOML, SourceKind},
};

/// An error and its causes, leaving out causes that the text before tells already.
fn one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if line.is_empty() {
            line = cause;
        } else if !line.contains(&cause) {
            line = format!("{line}: {cause}");
        }
    }
    line
}

/// Reads and checks a configuration; the error is what `flyrig config check` says.
///
/// # Errors
/// Names the key, what was found, and what is expected.
pub fn check_config(text: &str) -> Result<(), String> {
    Config::parse(text).map(|_| ()).map_err(|error| one_line(&error))
}

/// Runs the command line of this process.
#[must_use]
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    start_log(&cli);
    match dispatch(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", one_line(&error));
            ExitCode::FAILURE
        }
    }
}

fn dispatch(cli: &Cli) -> Result<()> {
    match &cli.command {
        Command::Demo(args) => demo::demo(args, &gpu(cli.adapter.as_deref())?),
        Command::Run { config, record, table } => {
            let config = Config::load(config)?;
            let adapter = cli.adapter.as_deref().or(Some(config.gpu.adapter.as_str()));
            run::run(&config, &gpu(adapter)?, record.as_deref(), *table)
        }
        Command::Record(args) => {
            let config = Config::load(&args.config)?;
            let adapter = cli.adapter.as_deref().or(Some(config.gpu.adapter.as_str()));
            let gpu = (config.source.kind == SourceKind::Sim).then(|| gpu(adapter)).transpose()?;
            record::record(&config, args, gpu.as_ref())
        }
        Command::Capture { config } => {
            let config = Config::load_for_capture(config)?;
            let adapter = cli.adapter.as_deref().or(Some(config.gpu.adapter.as_str()));
            let gpu = (config.source.kind == SourceKind::Sim).then(|| gpu(adapter)).transpose()?;
            capture::capture(&config, gpu.as_ref())
        }
        Command::Replay(args) => record::replay(args),
        Command::SyncCheck(args) => sync_check::sync_check(args, &|| gpu(cli.adapter.as_deref())),
        Command::Doctor { config } => doctor::doctor(config.as_deref()),
        Command::Watch(args) => watch::watch(args),
        Command::Eval(args) => eval::eval(args, &gpu(cli.adapter.as_deref())?),
        Command::Sim { action: SimAction::Export(args) } => {
            let config = args.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
            let adapter = cli.adapter.as_deref().or(Some(config.gpu.adapter.as_str()));
            sim_export::sim_export(args, &config.sim, &gpu(adapter)?)
        }
        Command::Train(args) => train::train(args, &|| gpu(cli.adapter.as_deref())),
        Command::Bench { what: BenchCommand::Appearance(args) } => {
            bench::appearance(args, &gpu(cli.adapter.as_deref())?)
        }
        Command::Bench { what: BenchCommand::Endure(args) } => bench::endure(args, &gpu(cli.adapter.as_deref())?),
        Command::Bench { what: BenchCommand::Capture(args) } => bench::soak::capture(args),
        Command::Bench { what: BenchCommand::Record(args) } => {
            bench::recording::record(args, &gpu(cli.adapter.as_deref())?)
        }
        Command::Bench { what: BenchCommand::Track(args) } => bench::track(args, &gpu(cli.adapter.as_deref())?),
        Command::Config { action: ConfigAction::Print } => {
            print!("{DEFAULT_TOML}");
            Ok(())
        }
        Command::Config { action: ConfigAction::Check { config } } => {
            let loaded = Config::load_for_capture(config)?;
            match loaded.check_scene() {
                Ok(()) => println!("{} is right", config.display()),
                Err(error) => {
                    println!("{} is right for `flyrig capture` and `flyrig doctor` alone: {error}", config.display());
                }
            }
            Ok(())
        }
    }
}

fn gpu(adapter: Option<&str>) -> Result<GpuContext> {
    let choice = match adapter {
        Some(name) if !name.is_empty() => AdapterChoice::Named(name.to_owned()),
        _ => AdapterChoice::Best,
    };
    Ok(GpuContext::new(&choice)?)
}

fn start_log(cli: &Cli) {
    let level = match cli.verbose {
        0 => "warn,flyrig=info,zenoh=error",
        1 => {
            "info,flyrig=debug,flyrig_capture=debug,flyrig_calib=debug,flyrig_tracker=debug,flyrig_renderer=debug,flyrig_transport=debug,flyrig_gpu=debug"
        }
        _ => "debug",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let builder = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr);
    if cli.log_json {
        builder.json().init();
    } else {
        builder.with_target(false).init();
    }
}

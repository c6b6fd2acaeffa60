//! Start and end of every program: logging, graphics adapter, exit code.

use std::{env, io::IsTerminal as _, process::ExitCode};

use anyhow::Result;
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_types::{escape_controls, shorten_values, shortened, wrong_vectors_limit};
use tracing_subscriber::EnvFilter;

/// Opens the graphics adapter with this text in its name, or the fastest one; none where the processor is faster
/// ([`GpuContext::fastest_of`]).
///
/// # Errors
/// No adapter has the name, or the adapter does not open.
pub fn open_gpu(adapter: Option<&str>) -> Result<GpuContext> {
    let choice = match adapter {
        Some(name) if !name.is_empty() => AdapterChoice::Named(name.to_owned()),
        _ => AdapterChoice::Best,
    };
    Ok(GpuContext::fastest_of(&choice)?)
}

/// Name of the variable that keeps Mesa from asking the desktop which adapter it uses.
const NO_DESKTOP_ADAPTER: &str = "NODEVICE_SELECT";

/// Keeps Mesa's driver from looking for a desktop where there is none: it would print `XDG_RUNTIME_DIR is invalid or not set`.
/// Call it at the beginning of `main`.
///
/// # Safety
/// No other thread may run yet: it could read the environment while it changes.
#[allow(unsafe_code)]
pub unsafe fn look_for_no_desktop() {
    let has_desktop = env::var("XDG_RUNTIME_DIR").is_ok_and(|folder| folder.starts_with('/'));
    if !has_desktop && env::var_os(NO_DESKTOP_ADAPTER).is_none() {
        // SAFETY: the caller guarantees that this is the only thread.
        unsafe { env::set_var(NO_DESKTOP_ADAPTER, "1") };
    }
}

/// Starts logging to standard error, in more detail with each level of `verbose`, and with one JSON object per line if `json`.
pub fn start_log(verbose: u8, json: bool) {
    let level = match verbose {
        // An image without a board is no reason for a warning, and what the libraries below report as a problem of theirs is reported
        // again as an error of ours.
        0 => {
            // What graphics and windows have to say comes as errors of ours.
            "warn,flyrig=info,flyrig_fusion=info,zenoh=error,calib_targets_chessboard=error,calib_targets_charuco=error,\
             wgpu=off,wgpu_core=off,wgpu_hal=off,naga=off,winit=off,eframe=off,egui=off,egui_wgpu=off,egui_winit=off,\
             smithay_client_toolkit=off,sctk=off,calloop=off"
        }
        1 => {
            "info,flyrig=debug,flyrig_fusion=debug,flyrig_capture=debug,flyrig_sync=debug,flyrig_calib=debug,\
             flyrig_tracker=debug,flyrig_renderer=debug,flyrig_transport=debug,flyrig_gpu=debug"
        }
        _ => "debug",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let builder = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr);
    if json {
        builder.json().init();
    } else {
        builder.with_target(false).init();
    }
    if let Some(wrong) = wrong_vectors_limit() {
        tracing::warn!("FLYRIG_VECTORS is \"{}\", expected \"avx2\" or \"none\"; it limits nothing", shortened(&wrong));
    }
}

/// Prints an error as one line and returns the exit code.
#[must_use]
pub fn exit_code(result: Result<()>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", one_line(&error));
            ExitCode::FAILURE
        }
    }
}

/// Joins an error and its causes, without causes that the text already contains. Errors repeat the content of foreign files: what a
/// terminal would obey is escaped, but for line breaks, and quoted values are cut at 100 characters.
#[must_use]
pub fn one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if line.is_empty() {
            line = cause;
        } else if !line.contains(&cause) {
            line = format!("{line}: {cause}");
        }
    }
    let line = line.split('\n').map(escape_controls).collect::<Vec<_>>().join("\n");
    shorten_values(&line).into_owned()
}

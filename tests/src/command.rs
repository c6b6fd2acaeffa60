//! Execution of the command under test.

use std::{path::Path, process::Command};

use anyhow::{Context, Result};

/// Result of a finished command.
#[derive(Debug)]
pub struct Finished {
    /// Exit code; `None` when a signal ended it.
    pub code: Option<i32>,
    /// Standard output.
    pub stdout: String,
    /// Standard error without the graphics driver's own lines.
    pub stderr: String,
}

/// Runs `program` to completion. Pass `env!("CARGO_BIN_EXE_flyrig-under-test")`, which is defined in tests only.
///
/// # Errors
/// Fails when the program cannot be started.
pub fn run(program: &str, args: &[&str], folder: &Path) -> Result<Finished> {
    let output = Command::new(program)
        .args(args)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .output()
        .with_context(|| format!("starting {program}"))?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let from_us = |line: &&str| !line.contains("XDG_RUNTIME_DIR");
    Ok(Finished {
        code: output.status.code(),
        stdout: text(&output.stdout),
        stderr: text(&output.stderr).lines().filter(from_us).collect::<Vec<_>>().join("\n"),
    })
}

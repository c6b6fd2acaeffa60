//! Command-line arguments that the programs share: groups to flatten into a command's own, and parsers.
//!
//! A command gives a flattened argument a default of its own with `mut_arg`.

use std::{ops::Range, path::PathBuf};

use anyhow::{Context as _, Result};
use clap::{Args, builder::TypedValueParser as _};
use flyrig_body::DEFAULT_GAUSSIAN_COUNT;

/// Arguments of every command.
#[derive(Debug, Clone, Args)]
pub struct ProgramArgs {
    /// Log more: -v debug, -vv trace. RUST_LOG selects modules.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// Part of a graphics adapter's name; the fastest adapter otherwise.
    #[arg(long, global = true)]
    pub adapter: Option<String>,
    /// Write when each stage ran into this file, for Perfetto (ui.perfetto.dev) or about:tracing.
    #[arg(long, global = true, value_name = "FILE")]
    pub trace: Option<PathBuf>,
}

/// Folder of a command's results.
#[derive(Debug, Clone, Args)]
pub struct OutputArgs {
    /// Folder of the results; created where it is missing.
    #[arg(long, default_value = "out")]
    pub out: PathBuf,
}

impl OutputArgs {
    /// Creates the folder.
    ///
    /// # Errors
    /// Names the folder that cannot be created.
    pub fn create(&self) -> Result<()> {
        std::fs::create_dir_all(&self.out).with_context(|| format!("cannot create {}", self.out.display()))
    }
}

/// Number of Gaussians.
#[derive(Debug, Clone, Args)]
pub struct GaussiansArgs {
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT, value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: usize,
}

/// Frame rate of images without timestamps.
#[derive(Debug, Clone, Args)]
pub struct FpsArgs {
    /// Frames per second of a folder of images; recordings and videos have their own timestamps.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
}

/// Range of a take's frames.
#[derive(Debug, Clone, Args)]
pub struct FramesArgs {
    /// Frames FIRST..END, END excluded; all frames otherwise.
    #[arg(long, value_parser = parse_range)]
    pub frames: Option<Range<u64>>,
}

/// Parses WIDTHxHEIGHT, 16 to 4096 pixels a side.
///
/// # Errors
/// Says what was expected.
pub fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let sides: Option<(u32, u32)> = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    match sides {
        Some((w, h)) if (16..=4096).contains(&w) && (16..=4096).contains(&h) => Ok([w, h]),
        _ => Err(format!("'{text}' is not WIDTHxHEIGHT with sides of 16 to 4096 pixels")),
    }
}

/// Parses 0.01 to 10000 minutes.
///
/// # Errors
/// Says what was expected.
pub fn parse_minutes(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(minutes) if (0.01..=10_000.0).contains(&minutes) => Ok(minutes),
        _ => Err(format!("'{text}' is not between 0.01 and 10000 minutes")),
    }
}

/// Parses 0.1 to 1000000 seconds.
///
/// # Errors
/// Says what was expected.
pub fn parse_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.1..=1e6).contains(&seconds) => Ok(seconds),
        _ => Err(format!("'{text}' is not between 0.1 and 1000000 seconds")),
    }
}

/// Parses a pace of 0.01 to 100 times the recorded one.
///
/// # Errors
/// Says what was expected.
pub fn parse_speed(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(speed) if (0.01..=100.0).contains(&speed) => Ok(speed),
        _ => Err(format!("'{text}' is not between 0.01 and 100 times the recorded pace")),
    }
}

/// Parses 0.1 to 1000 frames per second.
///
/// # Errors
/// Says what was expected.
pub fn parse_fps(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(fps) if (0.1..=1000.0).contains(&fps) => Ok(fps),
        _ => Err(format!("'{text}' is not between 0.1 and 1000 frames per second")),
    }
}

/// Parses a range of frames, FIRST..END with END excluded.
///
/// # Errors
/// Says what was expected.
pub fn parse_range(text: &str) -> Result<Range<u64>, String> {
    let ends: Option<(u64, u64)> = text.split_once("..").and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
    match ends {
        Some((a, b)) if a < b => Ok(a..b),
        _ => Err(format!("'{text}' is not a range of frames like 0..60 (the end is excluded)")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odd_ranges_and_sizes_are_refused() {
        assert_eq!(parse_range("3..7"), Ok(3..7));
        for bad in ["3", "7..3", "3..3", "-1..4", "a..b"] {
            assert!(parse_range(bad).is_err(), "{bad}");
        }
        assert_eq!(parse_size("640x480"), Ok([640, 480]));
        for bad in ["0x0", "640", "640x100000", "x"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }
}

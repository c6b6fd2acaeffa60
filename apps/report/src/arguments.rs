//! Parsers of command-line arguments that the programs share.

use std::ops::Range;

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

/// Parses 0.1 to 1000 frames a second.
///
/// # Errors
/// Says what was expected.
pub fn parse_fps(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(fps) if (0.1..=1000.0).contains(&fps) => Ok(fps),
        _ => Err(format!("'{text}' is not between 0.1 and 1000 frames a second")),
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

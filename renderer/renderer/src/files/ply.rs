//! Binary PLY files: header, rows of floats and the encoding of opacities and scales. A file appears whole or not at all.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use flyrig_types::write_whole;

/// Reason why an export failed.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The file could not be written.
    #[error("cannot write {}: {source}; check that the folder exists, may be written and has room", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Reason given by the system.
        source: io::Error,
    },
}

/// Spherical harmonic of degree 0, Y_0^0.
pub const SH_DEGREE_0: f32 = 0.282_094_8;

/// Returns the logit of an opacity for a PLY file; clamped, since 1 would have an infinite logit.
pub(crate) fn opacity_logit(opacity: f32) -> f32 {
    const MARGIN: f32 = 1e-4;
    let opacity = opacity.clamp(MARGIN, 1.0 - MARGIN);
    (opacity / (1.0 - opacity)).ln()
}

/// Returns the natural logarithm of a standard deviation for a PLY file.
pub(crate) fn log_scale(scale_m: f32) -> f32 {
    const SMALLEST_M: f32 = 1e-9;
    scale_m.max(SMALLEST_M).ln()
}

/// Writes `count` rows of floats, one for each property.
pub(crate) fn write_ply<'a, R: IntoIterator<Item = f32>>(
    path: &Path,
    properties: impl Iterator<Item = &'a str>,
    count: usize,
    rows: impl Iterator<Item = R>,
) -> Result<(), ExportError> {
    write_whole(path, |out| {
        write!(out, "ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: mip\nelement vertex {count}\n")?;
        for property in properties {
            writeln!(out, "property float {property}")?;
        }
        writeln!(out, "end_header")?;
        for value in rows.flatten() {
            out.write_all(&value.to_le_bytes())?;
        }
        Ok(())
    })
    .map_err(|source| ExportError::Io { path: path.to_owned(), source })
}

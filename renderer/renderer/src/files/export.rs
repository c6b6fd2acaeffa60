//! Splats as PLY files that other tools open. A file appears whole or not at all.

use std::{
    io::{self, Write as _},
    path::{Path, PathBuf},
};

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_types::write_whole;

use crate::{GaussianBuffers, PLY_PROPERTIES, color::srgb_from_linear};

/// Why an export failed.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The file could not be written.
    #[error("cannot write {}: {source}; check that the folder exists, may be written and has room", path.display())]
    Io {
        /// Which file.
        path: PathBuf,
        /// The system's word.
        source: io::Error,
    },
}

/// One Gaussian as a splat file knows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Splat {
    /// Metres.
    pub position: [f32; 3],
    /// Unit normal of the surface.
    pub normal: [f32; 3],
    /// Linear RGB.
    pub color: [f32; 3],
    /// 0..=1.
    pub opacity: f32,
    /// Standard deviations along the axes, metres.
    pub scale_m: [f32; 3],
    /// Unit quaternion w, x, y, z: world from the Gaussian's axes.
    pub rotation_wxyz: [f32; 4],
}

impl Splat {
    fn is_finite(&self) -> bool {
        let lists: [&[f32]; 5] = [&self.position, &self.normal, &self.color, &self.scale_m, &self.rotation_wxyz];
        self.opacity.is_finite() && lists.iter().all(|list| list.iter().all(|x| x.is_finite()))
    }
}

/// Waits for the GPU and copies the Gaussians out (isotropic, no rotation).
///
/// # Errors
/// [`GpuError::Lost`].
pub fn read_splats(gpu: &GpuContext, gaussians: &GaussianBuffers) -> Result<Vec<Splat>, GpuError> {
    let centers = gaussians.center_scale.read(gpu)?;
    let normals = gaussians.normal.read(gpu)?;
    let colors = gaussians.color.read(gpu)?;
    Ok(centers
        .iter()
        .zip(&normals)
        .zip(&colors)
        .map(|((&[x, y, z, scale], &[nx, ny, nz, _]), &[r, g, b, opacity])| Splat {
            position: [x, y, z],
            normal: [nx, ny, nz],
            color: [r, g, b],
            opacity,
            scale_m: [scale; 3],
            rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
        })
        .collect())
}

/// Writes splats as binary PLY in the layout of the 3D Gaussian Splatting reference code: `f_dc` is the degree-0
/// spherical harmonic of the sRGB colour, opacity a logit, scales natural logarithms of metres. Splats that hold a
/// NaN or an infinity are left out; returns how many were written.
///
/// # Errors
/// [`ExportError::Io`] names the file; the old one, if any, is then untouched.
pub fn write_splat_ply(path: &Path, splats: &[Splat]) -> Result<usize, ExportError> {
    let row = |splat: &Splat| {
        splat
            .position
            .into_iter()
            .chain(splat.normal)
            .chain(splat.color.map(|c| (srgb_from_linear(c) - 0.5) / SH_DEGREE_0))
            .chain([opacity_logit(splat.opacity)])
            .chain(splat.scale_m.map(log_scale))
            .chain(splat.rotation_wxyz)
    };
    let count = splats.iter().filter(|splat| splat.is_finite()).count();
    let rows = splats.iter().filter(|splat| splat.is_finite()).map(row);
    write_ply(path, PLY_PROPERTIES.iter().copied(), count, rows)?;
    Ok(count)
}

/// Y_0^0.
pub const SH_DEGREE_0: f32 = 0.282_094_8;

/// Opacity in a PLY file; 1 would have an infinite logit.
pub(crate) fn opacity_logit(opacity: f32) -> f32 {
    const MARGIN: f32 = 1e-4;
    let opacity = opacity.clamp(MARGIN, 1.0 - MARGIN);
    (opacity / (1.0 - opacity)).ln()
}

/// Standard deviation in a PLY file.
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
        write!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n")?;
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

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const SPLAT: Splat = Splat {
        position: [1.0, 2.0, 3.0],
        normal: [0.0, 0.0, 1.0],
        color: [1.0, 0.0, 0.214_041_14],
        opacity: 1.0,
        scale_m: [0.003; 3],
        rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
    };

    fn floats(bytes: &[u8]) -> Vec<f32> {
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        bytes[end..].chunks_exact(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
    }

    #[test]
    fn splats_follow_the_3dgs_convention_and_poison_is_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        let poisoned = Splat { position: [f32::NAN, 0.0, 0.0], ..SPLAT };
        assert_eq!(write_splat_ply(&path, &[poisoned, SPLAT]).unwrap(), 1);
        let bytes = fs::read(&path).unwrap();
        assert!(String::from_utf8_lossy(&bytes[..80]).contains("element vertex 1\n"));
        let row = floats(&bytes);
        assert_eq!(row.len(), 17);
        assert_eq!(row[..6], [1.0, 2.0, 3.0, 0.0, 0.0, 1.0]);
        // White, black and middle grey in sRGB.
        for (value, expected) in row[6..9].iter().zip([0.5 / 0.282_094_8, -0.5 / 0.282_094_8, 0.0]) {
            assert!((value - expected).abs() < 1e-4, "{row:?}");
        }
        assert!((row[9] - (0.9999f32 / 0.0001).ln()).abs() < 1e-2);
        assert!((row[10] - 0.003f32.ln()).abs() < 1e-6);
        assert_eq!(row[13..], [1.0, 0.0, 0.0, 0.0]);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing half-written stays");
    }

    #[test]
    fn refusals_name_the_file_and_leave_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let nowhere = folder.path().join("no/such/folder.ply");
        assert!(write_splat_ply(&nowhere, &[SPLAT]).unwrap_err().to_string().contains("no/such/folder.ply"));
        // The target is a folder: the rename fails and the partial file goes.
        let taken = folder.path().join("taken.ply");
        fs::create_dir(&taken).unwrap();
        assert!(matches!(write_splat_ply(&taken, &[SPLAT]), Err(ExportError::Io { .. })));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}

//! Splats and meshes as PLY files that other tools open. A file appears whole or not at all.

use std::{
    fs,
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
};

use flyrig_gpu::{GpuContext, GpuError};
use glam::Vec3;

use crate::{GaussianBuffers, color::srgb_from_linear};

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
    /// The lists do not belong together.
    #[error("{}: not written, {message}", path.display())]
    Invalid {
        /// Which file.
        path: PathBuf,
        /// What is wrong with the content.
        message: String,
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
    /// Y_0^0.
    const SH_DEGREE_0: f32 = 0.282_094_8;
    /// Opacity 1 has an infinite logit.
    const OPACITY_MARGIN: f32 = 1e-4;
    const SMALLEST_SCALE_M: f32 = 1e-9;
    const PROPERTIES: [&str; 17] = [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
        "rot_0", "rot_1", "rot_2", "rot_3",
    ];
    let count = splats.iter().filter(|splat| splat.is_finite()).count();
    write_whole(path, |out| {
        write!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n")?;
        for property in PROPERTIES {
            writeln!(out, "property float {property}")?;
        }
        writeln!(out, "end_header")?;
        for splat in splats.iter().filter(|splat| splat.is_finite()) {
            let opacity = splat.opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
            let row = splat
                .position
                .into_iter()
                .chain(splat.normal)
                .chain(splat.color.map(|c| (srgb_from_linear(c) - 0.5) / SH_DEGREE_0))
                .chain([(opacity / (1.0 - opacity)).ln()])
                .chain(splat.scale_m.map(|s| s.max(SMALLEST_SCALE_M).ln()))
                .chain(splat.rotation_wxyz);
            for value in row {
                out.write_all(&value.to_le_bytes())?;
            }
        }
        Ok(())
    })?;
    Ok(count)
}

/// Writes a triangle mesh with normals as binary PLY; positions in metres.
///
/// # Errors
/// [`ExportError::Invalid`] when the lists do not fit together or a position is not finite, [`ExportError::Io`]
/// names the file; the old one, if any, is then untouched.
pub fn write_mesh_ply(
    path: &Path,
    positions: &[Vec3],
    normals: &[Vec3],
    triangles: &[[u32; 3]],
) -> Result<(), ExportError> {
    let invalid = |message| ExportError::Invalid { path: path.to_owned(), message };
    let count = positions.len();
    if normals.len() != count {
        return Err(invalid(format!("there are {count} positions but {} normals", normals.len())));
    }
    // The indices are written as signed 32-bit integers.
    if let Some(index) = triangles.as_flattened().iter().find(|&&i| i as usize >= count || i32::try_from(i).is_err()) {
        return Err(invalid(format!("a triangle refers to vertex {index} of {count}")));
    }
    if let Some(vertex) = positions.iter().zip(normals).position(|(p, n)| !p.is_finite() || !n.is_finite()) {
        return Err(invalid(format!("vertex {vertex} is not a finite number")));
    }
    write_whole(path, |out| {
        write!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n")?;
        for property in ["x", "y", "z", "nx", "ny", "nz"] {
            writeln!(out, "property float {property}")?;
        }
        write!(out, "element face {}\nproperty list uchar int vertex_indices\nend_header\n", triangles.len())?;
        for (position, normal) in positions.iter().zip(normals) {
            for value in position.to_array().into_iter().chain(normal.to_array()) {
                out.write_all(&value.to_le_bytes())?;
            }
        }
        for triangle in triangles {
            out.write_all(&[3])?;
            for index in triangle {
                out.write_all(&index.to_le_bytes())?;
            }
        }
        Ok(())
    })
}

/// Writes beside the target, then renames over it, so that a reader never meets half a file.
fn write_whole(
    path: &Path,
    content: impl FnOnce(&mut BufWriter<fs::File>) -> io::Result<()>,
) -> Result<(), ExportError> {
    let failed = |source| ExportError::Io { path: path.to_owned(), source };
    let Some(name) = path.file_name() else {
        return Err(failed(io::Error::new(io::ErrorKind::InvalidInput, "the path has no file name")));
    };
    let mut partial_name = name.to_owned();
    partial_name.push(format!(".{}.partial", std::process::id()));
    let partial = path.with_file_name(partial_name);
    let write = || {
        let mut out = BufWriter::new(fs::File::create(&partial)?);
        content(&mut out)?;
        out.flush()?;
        drop(out);
        fs::rename(&partial, path)
    };
    write().map_err(|source| {
        // Nothing more can be done when even that fails; the first error is the one worth telling.
        let _ = fs::remove_file(&partial);
        failed(source)
    })
}

#[cfg(test)]
mod tests {
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
    fn a_mesh_has_the_bytes_it_promises() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.ply");
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y];
        write_mesh_ply(&path, &positions, &[Vec3::Z; 3], &[[0, 1, 2]]).unwrap();
        let bytes = fs::read(&path).unwrap();
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        assert_eq!(bytes.len(), end + 3 * 24 + 13);
        assert_eq!(bytes[end + 72..], [3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    }

    #[test]
    fn refusals_name_the_file_and_leave_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.ply");
        let message = |normals: &[Vec3], triangles: &[[u32; 3]], x: f32| {
            write_mesh_ply(&path, &[Vec3::splat(x)], normals, triangles).unwrap_err().to_string()
        };
        assert!(message(&[], &[], 0.0).contains("m.ply: not written, there are 1 positions but 0 normals"));
        assert!(message(&[Vec3::Z], &[[0, 0, 1]], 0.0).contains("refers to vertex 1 of 1"));
        assert!(message(&[Vec3::Z], &[], f32::INFINITY).contains("vertex 0 is not a finite number"));
        let nowhere = folder.path().join("no/such/folder.ply");
        assert!(write_splat_ply(&nowhere, &[SPLAT]).unwrap_err().to_string().contains("no/such/folder.ply"));
        // The target is a folder: the rename fails and the partial file goes.
        let taken = folder.path().join("taken.ply");
        fs::create_dir(&taken).unwrap();
        assert!(matches!(write_splat_ply(&taken, &[SPLAT]), Err(ExportError::Io { .. })));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}

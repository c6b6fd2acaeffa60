//! USDZ packages: a zip archive without compression, whose files begin at multiples of 64 bytes, with the stage first.

use std::io::{self, Write};
use std::path::Path;

use zip::CompressionMethod;
use zip::write::SimpleFileOptions;

use super::archive::write_archive;
use super::mesh_file::{MeshFile, MeshFileError};
use super::usd_skeleton::{write_skeleton, write_skin};
use super::usd_text::{Times, write_extent, write_header, write_material, write_mesh_opening, write_vectors};

/// Offset of each file's data is a multiple of this (USDZ specification, "Layout").
const ALIGNMENT: u16 = 64;
/// Texture inside of the package.
const TEXTURE: &str = "textures/color.png";

/// Writes a mesh as a USDZ package, metres, y up: the stage `mesh.usda` with normals, texture coordinates, a
/// `UsdPreviewSurface` of the texture, and, where given, the skeleton with skin weights and motion.
///
/// # Errors
/// [`MeshFileError`] for faulty content, and when the system fails.
pub fn write_usdz(path: &Path, mesh: &MeshFile<'_>) -> Result<(), MeshFileError> {
    mesh.check(path, "usdz")?;
    write_archive(path, |archive| {
        let options =
            SimpleFileOptions::default().compression_method(CompressionMethod::Stored).with_alignment(ALIGNMENT);
        archive.start_file("mesh.usda", options)?;
        let mut stage = io::BufWriter::new(&mut *archive);
        write_stage(&mut stage, mesh)?;
        stage.flush()?;
        drop(stage);
        if let Some(png) = mesh.texture {
            archive.start_file(TEXTURE, options)?;
            archive.write_all(png)?;
        }
        Ok(())
    })
}

fn write_stage(out: &mut impl Write, mesh: &MeshFile<'_>) -> io::Result<()> {
    let times = mesh.skeleton.and_then(|skeleton| Times::new(skeleton.frames.iter().map(|frame| frame.secs)));
    write_header(out, times.as_ref())?;
    let root = if mesh.skeleton.is_some() { "SkelRoot" } else { "Xform" };
    write!(out, "def {root} \"Root\" (\n    kind = \"component\"\n)\n{{\n")?;
    write_mesh_opening(out, mesh)?;
    write!(out, "        float3[] extent = ")?;
    write_extent(out, mesh.positions)?;
    write!(out, "\n        point3f[] points = ")?;
    write_vectors(out, mesh.positions)?;
    write!(out, "\n        normal3f[] normals = ")?;
    write_vectors(out, mesh.normals)?;
    writeln!(out, " (\n            interpolation = \"vertex\"\n        )")?;
    if let Some(skeleton) = &mesh.skeleton {
        write_skin(out, skeleton)?;
    }
    writeln!(out, "    }}")?;
    if mesh.texture.is_some() {
        write_material(out, TEXTURE, mesh.is_lit)?;
    }
    if let Some(skeleton) = &mesh.skeleton {
        write_skeleton(out, skeleton, times.as_ref())?;
    }
    writeln!(out, "}}")
}

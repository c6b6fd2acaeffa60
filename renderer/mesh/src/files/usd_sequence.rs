//! USD stage of a mesh that moves: one topology, points by time.

use std::io::{self, Write};
use std::path::Path;

use flyrig_types::write_whole;
use glam::Vec3;

use super::mesh_file::{MeshFile, MeshFileError, beside, refused, system, times_problem};
use super::usd_text::{Times, write_extent, write_header, write_material, write_mesh_opening, write_vectors};

/// Vertices of a moving mesh at a time.
#[derive(Debug, Clone, Copy)]
pub struct MeshFrame<'a> {
    /// Time, seconds.
    pub secs: f64,
    /// Vertex positions, metres, y up.
    pub positions: &'a [Vec3],
    /// Unit normal of each vertex.
    pub normals: &'a [Vec3],
}

/// Writes a moving mesh as one stage in USD's text form, metres, y up. Triangles, texture coordinates and texture are those
/// of `mesh`, whose positions and normals are the default outside of the animation; its skeleton is left out. A texture is
/// written beside the stage as `NAME.png`, before it.
///
/// # Errors
/// [`MeshFileError`] for faulty content, no frames, times that do not ascend, frames that do not fit the mesh, and when the
/// system fails.
pub fn write_usd_sequence(path: &Path, mesh: &MeshFile<'_>, frames: &[MeshFrame<'_>]) -> Result<(), MeshFileError> {
    let mesh = MeshFile { skeleton: None, ..*mesh };
    mesh.check(path, "usda")?;
    if let Some(problem) = problem(frames, mesh.positions.len()) {
        return Err(refused(path, problem));
    }
    let Some(times) = Times::new(frames.iter().map(|frame| frame.secs)) else {
        return Err(refused(path, "the sequence has no frames".to_owned()));
    };
    let texture = match mesh.texture {
        None => None,
        Some(png) => {
            let (texture_path, name) = beside(path, "png")?;
            write_whole(&texture_path, |out| out.write_all(png)).map_err(system(&texture_path))?;
            Some(format!("./{name}"))
        }
    };
    write_whole(path, |out| write_stage(out, &mesh, frames, &times, texture.as_deref())).map_err(system(path))
}

fn problem(frames: &[MeshFrame<'_>], vertices: usize) -> Option<String> {
    for frame in frames {
        let (secs, positions, normals) = (frame.secs, frame.positions.len(), frame.normals.len());
        if (positions, normals) != (vertices, vertices) {
            return Some(format!(
                "the frame at {secs} s has {positions} positions and {normals} normals of {vertices}"
            ));
        }
        if let Some(vertex) =
            frame.positions.iter().zip(frame.normals).position(|(p, n)| !p.is_finite() || !n.is_finite())
        {
            return Some(format!("vertex {vertex} of the frame at {secs} s is not a finite number"));
        }
    }
    times_problem(frames.iter().map(|frame| frame.secs))
}

fn write_stage(
    out: &mut impl Write,
    mesh: &MeshFile<'_>,
    frames: &[MeshFrame<'_>],
    times: &Times,
    texture: Option<&str>,
) -> io::Result<()> {
    write_header(out, Some(times))?;
    write!(out, "def Xform \"Root\" (\n    kind = \"component\"\n)\n{{\n")?;
    write_mesh_opening(out, mesh)?;
    write!(out, "        float3[] extent = ")?;
    write_extent(out, mesh.positions)?;
    write!(out, "\n        float3[] extent.timeSamples = {{\n")?;
    for frame in frames {
        write!(out, "            {}: ", times.code(frame.secs))?;
        write_extent(out, frame.positions)?;
        writeln!(out, ",")?;
    }
    write!(out, "        }}\n        point3f[] points = ")?;
    write_vectors(out, mesh.positions)?;
    write_samples(out, "point3f[] points", frames, times, |frame| frame.positions)?;
    write!(out, "        normal3f[] normals = ")?;
    write_vectors(out, mesh.normals)?;
    write!(out, " (\n            interpolation = \"vertex\"\n        )")?;
    write_samples(out, "normal3f[] normals", frames, times, |frame| frame.normals)?;
    writeln!(out, "    }}")?;
    if let Some(texture) = texture {
        write_material(out, texture)?;
    }
    writeln!(out, "}}")
}

/// Writes the values of an attribute at the times of frames.
fn write_samples<'a>(
    out: &mut impl Write,
    attribute: &str,
    frames: &[MeshFrame<'a>],
    times: &Times,
    values: fn(&MeshFrame<'a>) -> &'a [Vec3],
) -> io::Result<()> {
    write!(out, "\n        {attribute}.timeSamples = {{\n")?;
    for frame in frames {
        write!(out, "            {}: ", times.code(frame.secs))?;
        write_vectors(out, values(frame))?;
        writeln!(out, ",")?;
    }
    writeln!(out, "        }}")
}

//! USD stage of a mesh that moves: one topology, points by time.

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use flyrig_types::write_whole;
use glam::Vec3;

use super::mesh_file::{MeshFile, MeshFileError, beside, refused, system, times_problem};
use super::usd_text::{Times, write_extent, write_header, write_material, write_mesh_opening, write_vectors};

/// Vertices of a moving mesh at a time.
#[derive(Debug, Clone)]
pub struct MeshFrame {
    /// Vertex positions, metres, y up.
    pub positions: Vec<Vec3>,
    /// Unit normal of each vertex.
    pub normals: Vec<Vec3>,
}

/// Writes a moving mesh as one stage in USD's text form, metres, y up. Triangles, texture coordinates and texture are those
/// of `mesh`, whose positions and normals are the default outside of the animation; its skeleton is left out. A texture is
/// written beside the stage as `NAME.png`, before it.
///
/// `secs` are the times of the frames, seconds, ascending. `frame` makes the frame of each time; it is called once per frame, in order,
/// and one frame is held at a time.
///
/// # Errors
/// [`MeshFileError`] for faulty content, no frames, times that do not ascend, frames that do not fit the mesh, errors of `frame`, and when
/// the system fails.
pub fn write_usd_sequence(
    path: &Path,
    mesh: &MeshFile<'_>,
    secs: &[f64],
    frame: impl FnMut(usize) -> io::Result<MeshFrame>,
) -> Result<(), MeshFileError> {
    let mesh = MeshFile { skeleton: None, ..*mesh };
    mesh.check(path, "usda")?;
    if let Some(problem) = times_problem(secs.iter().copied()) {
        return Err(refused(path, problem));
    }
    let Some(times) = Times::new(secs.iter().copied()) else {
        return Err(refused(path, "the sequence has no frames".to_owned()));
    };
    let texture =
        mesh.texture.map(|png| beside(path, "png").map(|(path, name)| (png, path, format!("./{name}")))).transpose()?;
    // Text of normals, which follow the points of all frames.
    let (normals, _) = beside(path, "normals.partial")?;
    let mut frames = Frames { mesh: &mesh, secs, times: &times, frame, problem: None };
    let mut failed = None;
    let written = write_whole(path, |out| {
        frames.write_stage(out, &normals, texture.as_ref().map(|(_, _, name)| name.as_str()))?;
        let Some((png, path, _)) = &texture else { return Ok(()) };
        write_whole(path, |out| out.write_all(png)).inspect_err(|_| failed = Some(path.clone()))
    });
    // It exists only if the stage was begun.
    let _ = fs::remove_file(&normals);
    match frames.problem {
        Some(problem) => Err(refused(path, problem)),
        None => written.map_err(system(failed.as_deref().unwrap_or(path))),
    }
}

/// Frames on their way into a stage.
struct Frames<'a, F> {
    mesh: &'a MeshFile<'a>,
    secs: &'a [f64],
    times: &'a Times,
    frame: F,
    /// Fault of a frame.
    problem: Option<String>,
}

impl<F: FnMut(usize) -> io::Result<MeshFrame>> Frames<'_, F> {
    fn write_stage(&mut self, out: &mut impl Write, normals: &Path, texture: Option<&str>) -> io::Result<()> {
        write_header(out, Some(self.times))?;
        write!(out, "def Xform \"Root\" (\n    kind = \"component\"\n)\n{{\n")?;
        write_mesh_opening(out, self.mesh)?;
        let extents = self.write_points(out, normals)?;
        write!(out, "        normal3f[] normals = ")?;
        write_vectors(out, self.mesh.normals)?;
        write!(out, " (\n            interpolation = \"vertex\"\n        )")?;
        write!(out, "\n        normal3f[] normals.timeSamples = {{\n")?;
        io::copy(&mut fs::File::open(normals)?, out)?;
        write!(out, "        }}\n        float3[] extent = ")?;
        write_extent(out, self.mesh.positions)?;
        write!(out, "\n        float3[] extent.timeSamples = {{\n")?;
        for (secs, extent) in self.secs.iter().zip(&extents) {
            write!(out, "            {}: ", self.times.code(*secs))?;
            write_extent(out, extent)?;
            writeln!(out, ",")?;
        }
        writeln!(out, "        }}\n    }}")?;
        if let Some(texture) = texture {
            write_material(out, texture, self.mesh.is_lit)?;
        }
        writeln!(out, "}}")
    }

    /// Writes the points of all frames, and their normals to a file of their own. Returns the lowest and highest corner of each frame.
    fn write_points(&mut self, out: &mut impl Write, normals: &Path) -> io::Result<Vec<[Vec3; 2]>> {
        let mut of_normals = BufWriter::new(fs::File::create(normals)?);
        let mut extents = Vec::with_capacity(self.secs.len());
        write!(out, "        point3f[] points = ")?;
        write_vectors(out, self.mesh.positions)?;
        write!(out, "\n        point3f[] points.timeSamples = {{\n")?;
        for (i, secs) in self.secs.iter().enumerate() {
            let frame = (self.frame)(i)?;
            self.problem = problem(&frame, *secs, self.mesh.positions.len());
            if self.problem.is_some() {
                return Err(io::ErrorKind::InvalidData.into());
            }
            let code = self.times.code(*secs);
            write!(out, "            {code}: ")?;
            write_vectors(out, &frame.positions)?;
            writeln!(out, ",")?;
            write!(of_normals, "            {code}: ")?;
            write_vectors(&mut of_normals, &frame.normals)?;
            writeln!(of_normals, ",")?;
            let corner = |start: Vec3, pick: fn(Vec3, Vec3) -> Vec3| frame.positions.iter().copied().fold(start, pick);
            extents.push([corner(Vec3::INFINITY, Vec3::min), corner(Vec3::NEG_INFINITY, Vec3::max)]);
        }
        of_normals.flush()?;
        writeln!(out, "        }}")?;
        Ok(extents)
    }
}

/// Returns what is wrong with a frame.
fn problem(frame: &MeshFrame, secs: f64, vertices: usize) -> Option<String> {
    let (positions, normals) = (frame.positions.len(), frame.normals.len());
    if (positions, normals) != (vertices, vertices) {
        return Some(format!("the frame at {secs} s has {positions} positions and {normals} normals of {vertices}"));
    }
    let vertex = frame.positions.iter().zip(&frame.normals).position(|(p, n)| !p.is_finite() || !n.is_finite())?;
    Some(format!("vertex {vertex} of the frame at {secs} s is not a finite number"))
}

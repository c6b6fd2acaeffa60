//! True surfaces of simulated people and prepared takes.

use std::path::Path;

use anyhow::{Context as _, Result, bail, ensure};
use flyrig_types::Camera;
use glam::Vec3;

use super::visibility::{cameras_around, seen_by};
use crate::harness::surface::Points;

/// Points spread over a true surface.
const POINTS: usize = 300_000;

/// True surface of one frame.
pub(super) struct TrueSurface {
    pub positions: Vec<Vec3>,
    pub triangles: Vec<[u32; 3]>,
    pub points: Points,
    /// Whether an input camera sees the point.
    pub is_seen: Vec<bool>,
    /// Cameras on all sides, and whether one of them sees the point: the rest is hidden from everybody, like legs under a long skirt.
    pub around: Vec<Camera>,
    pub is_outer: Vec<bool>,
}

impl TrueSurface {
    /// Collects what cameras see of the points of a surface.
    pub fn new(positions: Vec<Vec3>, triangles: Vec<[u32; 3]>, points: Points, cameras: &[Camera]) -> Self {
        let around = cameras_around(&positions);
        let [is_seen, is_outer] = [cameras, around.as_slice()].map(|by| seen_by(by, &positions, &triangles, &points));
        Self { positions, triangles, points, is_seen, around, is_outer }
    }

    /// Reads `truth/surface/NNNNNN.ply` of a take, world metres. `cameras` decide on what is seen.
    ///
    /// # Errors
    /// Names a file that is missing or damaged.
    pub fn read(take: &Path, frame: u64, cameras: &[Camera]) -> Result<Self> {
        let (positions, triangles) = read_surface(take, frame)?;
        let points = Points::on(&positions, &triangles, POINTS);
        ensure!(!points.points.is_empty(), "frame {frame} of {} has no true surface", take.display());
        Ok(Self::new(positions, triangles, points, cameras))
    }
}

/// Reads `truth/surface/NNNNNN.ply` of a take: positions in world metres, and triangles.
///
/// # Errors
/// Names a file that is missing or damaged.
pub(super) fn read_surface(take: &Path, frame: u64) -> Result<(Vec<Vec3>, Vec<[u32; 3]>)> {
    let path = take.join(format!("truth/surface/{frame:06}.ply"));
    let bytes = std::fs::read(&path).with_context(|| {
        format!("cannot read {}; `flyrig sim export` writes the true surfaces of a take", path.display())
    })?;
    parse(&bytes).with_context(|| format!("{} is damaged", path.display()))
}

/// Parses a binary PLY mesh whose vertices begin with three floats, and whose faces are triangles of 32-bit indices.
fn parse(bytes: &[u8]) -> Result<(Vec<Vec3>, Vec<[u32; 3]>)> {
    const END: &[u8] = b"end_header\n";
    let end = bytes.windows(END.len()).position(|window| window == END).context("its header does not end")? + END.len();
    let header = std::str::from_utf8(&bytes[..end]).context("its header is no text")?;
    let (mut counts, mut element, mut width) = ([0usize; 2], 0, 0usize);
    for line in header.lines() {
        match line.split_ascii_whitespace().collect::<Vec<_>>().as_slice() {
            ["element", "vertex", count] => counts[0] = count.parse()?,
            ["element", "face", count] => (counts[1], element) = (count.parse()?, 1),
            ["property", kind, _] if element == 0 => width += size_of_kind(kind)?,
            ["property", "list", "uchar", "int" | "int32" | "uint" | "uint32", _]
            | ["ply" | "comment" | "end_header", ..] => {}
            ["format", "binary_little_endian", "1.0"] => {}
            _ => bail!("its header says {line:?}"),
        }
    }
    ensure!(width >= 12, "it has no positions");
    let [vertices, faces] = counts;
    let mut rest = &bytes[end..];
    let positions = cut(&mut rest, vertices, width)?.map(|row| Vec3::new(float(row, 0), float(row, 4), float(row, 8)));
    let positions: Vec<Vec3> = positions.collect();
    let triangles = cut(&mut rest, faces, 13)?.map(|row| {
        ensure!(row[0] == 3, "a face has {} corners", row[0]);
        Ok([1, 5, 9].map(|at| u32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]])))
    });
    Ok((positions, triangles.collect::<Result<_>>()?))
}

/// Takes `count` rows of `width` bytes from the front.
fn cut<'a>(rest: &mut &'a [u8], count: usize, width: usize) -> Result<std::slice::ChunksExact<'a, u8>> {
    let length = count.checked_mul(width).context("it announces too many rows")?;
    let (rows, after) = rest.split_at_checked(length).context("it is cut off")?;
    *rest = after;
    Ok(rows.chunks_exact(width))
}

fn float(row: &[u8], at: usize) -> f32 {
    f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]])
}

fn size_of_kind(kind: &str) -> Result<usize> {
    Ok(match kind {
        "char" | "uchar" | "int8" | "uint8" => 1,
        "short" | "ushort" | "int16" | "uint16" => 2,
        "int" | "uint" | "float" | "int32" | "uint32" | "float32" => 4,
        "double" | "float64" => 8,
        other => bail!("it has a property of the kind {other:?}"),
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use flyrig_body::write_mesh_ply;

    use super::*;

    #[test]
    fn meshes_are_read_as_they_were_written_and_damaged_ones_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        let (positions, triangles) = ([Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z], [[0, 1, 2], [0, 3, 1]]);
        write_mesh_ply(&path, &positions, &[Vec3::Z; 4], &triangles, &[("more", vec![0.5; 4])]).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let (found, faces) = parse(&bytes).unwrap();
        assert_eq!((found.as_slice(), faces.as_slice()), (&positions[..], &triangles[..]));
        for end in [0, 20, bytes.len() - 60, bytes.len() - 1] {
            assert!(parse(&bytes[..end]).is_err(), "{end} bytes");
        }
        let mut quad = bytes.clone();
        let at = bytes.len() - 13;
        quad[at] = 4;
        assert!(parse(&quad).is_err());
        assert!(TrueSurface::read(folder.path(), 3, &[]).is_err_and(|error| error.to_string().contains("000003.ply")));
    }
}

//! Export of meshes as PLY files.

use std::io::Write as _;
use std::path::Path;

use flyrig_types::write_whole;
use glam::Vec3;

use crate::BodyError;

/// Writes a triangle mesh with normals atomically as binary PLY, positions in metres. Each element of `more` is the name of a
/// property and its value at each vertex.
///
/// # Errors
/// [`BodyError::Unwritten`] when the lists differ in length, a number is not finite, or the system fails.
pub fn write_mesh_ply(
    path: &Path,
    positions: &[Vec3],
    normals: &[Vec3],
    triangles: &[[u32; 3]],
    more: &[(&str, Vec<f32>)],
) -> Result<(), BodyError> {
    let invalid = |message| Err(BodyError::Unwritten { path: path.to_owned(), message });
    let count = positions.len();
    if normals.len() != count {
        return invalid(format!("there are {count} positions but {} normals", normals.len()));
    }
    if let Some((name, values)) = more.iter().find(|(_, values)| values.len() != count) {
        return invalid(format!("there are {count} positions but {} values of {name}", values.len()));
    }
    // The indices are written as signed 32-bit integers.
    if let Some(index) = triangles.as_flattened().iter().find(|&&i| i as usize >= count || i32::try_from(i).is_err()) {
        return invalid(format!("a triangle refers to vertex {index} of {count}"));
    }
    let finite = |vertex: usize| {
        positions[vertex].is_finite()
            && normals[vertex].is_finite()
            && more.iter().all(|(_, values)| values[vertex].is_finite())
    };
    if let Some(vertex) = (0..count).find(|&vertex| !finite(vertex)) {
        return invalid(format!("vertex {vertex} is not a finite number"));
    }
    write_whole(path, |out| {
        write!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n")?;
        for property in ["x", "y", "z", "nx", "ny", "nz"].into_iter().chain(more.iter().map(|(name, _)| *name)) {
            writeln!(out, "property float {property}")?;
        }
        write!(out, "element face {}\nproperty list uchar int vertex_indices\nend_header\n", triangles.len())?;
        for vertex in 0..count {
            let row = positions[vertex].to_array().into_iter().chain(normals[vertex].to_array());
            for value in row.chain(more.iter().map(|(_, values)| values[vertex])) {
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
    .map_err(|source| BodyError::Unwritten { path: path.to_owned(), message: source.to_string() })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_mesh_has_the_bytes_it_promises() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.ply");
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y];
        write_mesh_ply(&path, &positions, &[Vec3::Z; 3], &[[0, 1, 2]], &[("w", vec![1.5, 2.5, 3.5])]).unwrap();
        let bytes = fs::read(&path).unwrap();
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        assert!(
            String::from_utf8_lossy(&bytes[..end]).contains("property float nz\nproperty float w\nelement face 1\n")
        );
        assert_eq!(bytes.len(), end + 3 * 28 + 13);
        assert_eq!(bytes[end + 24..end + 28], 1.5f32.to_le_bytes());
        assert_eq!(bytes[end + 84..], [3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    }

    #[test]
    fn refusals_name_the_file_and_leave_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.ply");
        let message = |normals: &[Vec3], triangles: &[[u32; 3]], x: f32, more: Vec<f32>| {
            write_mesh_ply(&path, &[Vec3::splat(x)], normals, triangles, &[("w", more)]).unwrap_err().to_string()
        };
        assert!(message(&[], &[], 0.0, vec![0.0]).contains("m.ply: not written, there are 1 positions but 0 normals"));
        assert!(message(&[Vec3::Z], &[], 0.0, vec![]).contains("1 positions but 0 values of w"));
        assert!(message(&[Vec3::Z], &[[0, 0, 1]], 0.0, vec![0.0]).contains("refers to vertex 1 of 1"));
        assert!(message(&[Vec3::Z], &[], f32::INFINITY, vec![0.0]).contains("vertex 0 is not a finite number"));
        assert!(message(&[Vec3::Z], &[], 0.0, vec![f32::NAN]).contains("vertex 0 is not a finite number"));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}

//! 3MF files for slicers (3MF core specification 1.3): millimetres, z up.

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::Path;

use glam::{DVec3, Vec3};
use zip::CompressionMethod;
use zip::write::SimpleFileOptions;

use super::archive::write_archive;
use super::mesh_file::{MeshFile, MeshFileError, refused};
use crate::Connectivity;

const TYPES: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types"><Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/><Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>
"#;
const RELATIONS: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships"><Relationship Target="/3D/3dmodel.model" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>
"#;
const MODEL: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<model unit="millimeter" xml:lang="en-US" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">
<metadata name="Application">flyrig</metadata>
<resources><object id="1" type="model"><mesh><vertices>
"#;

/// Writes the closed surface of a mesh as 3MF in millimetres, z up, standing on the build plate. Vertices that are split
/// for texture coordinates are joined again where the surface would be open otherwise. Texture and skeleton are left out.
///
/// # Errors
/// [`MeshFileError`] for faulty content, a surface that is open, not manifold at its edges or inside out, and when the
/// system fails.
pub fn write_3mf(path: &Path, mesh: &MeshFile<'_>) -> Result<(), MeshFileError> {
    mesh.check(path, "3mf")?;
    let points: Vec<Vec3> = mesh.positions.iter().map(|p| 1000.0 * Vec3::new(p.x, 0.0 - p.z, p.y)).collect();
    let (points, triangles) = solid(points, mesh.triangles).map_err(|message| refused(path, message))?;
    write_archive(path, |archive| {
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
        for (name, text) in [("[Content_Types].xml", TYPES), ("_rels/.rels", RELATIONS)] {
            archive.start_file(name, options)?;
            archive.write_all(text.as_bytes())?;
        }
        archive.start_file("3D/3dmodel.model", options)?;
        write_model(&mut io::BufWriter::new(archive), &points, &triangles)
    })
}

fn write_model(out: &mut impl Write, points: &[Vec3], triangles: &[[u32; 3]]) -> io::Result<()> {
    out.write_all(MODEL.as_bytes())?;
    for p in points {
        writeln!(out, r#"<vertex x="{}" y="{}" z="{}"/>"#, p.x, p.y, p.z)?;
    }
    writeln!(out, "</vertices><triangles>")?;
    for [a, b, c] in triangles {
        writeln!(out, r#"<triangle v1="{a}" v2="{b}" v3="{c}"/>"#)?;
    }
    // Printers accept positive coordinates alone.
    let corner = points.iter().copied().fold(Vec3::INFINITY, Vec3::min);
    let [x, y, z] = corner.to_array().map(|low| 0.0 - low);
    writeln!(
        out,
        r#"</triangles></mesh></object></resources>
<build><item objectid="1" transform="1 0 0 0 1 0 0 0 1 {x} {y} {z}"/></build>
</model>"#
    )?;
    out.flush()
}

/// Returns the vertices and triangles of a closed surface, or the problem.
fn solid(points: Vec<Vec3>, triangles: &[[u32; 3]]) -> Result<(Vec<Vec3>, Vec<[u32; 3]>), String> {
    let is_solid = |t: &Connectivity| (t.open_edges, t.crowded_edges, t.twisted_edges) == (0, 0, 0);
    let (points, triangles) = if is_solid(&Connectivity::new(triangles)) {
        (points, triangles.to_vec())
    } else {
        let (points, triangles) = welded(&points, triangles);
        let topology = Connectivity::new(&triangles);
        if !is_solid(&topology) {
            let Connectivity { open_edges, crowded_edges, twisted_edges, .. } = topology;
            return Err(format!(
                "3MF holds closed surfaces; this one has {open_edges} open edges, {crowded_edges} with more than two triangles, and {twisted_edges} between triangles of opposite orientation"
            ));
        }
        (points, triangles)
    };
    let solid = |t: &[u32; 3]| {
        let [a, b, c]: [DVec3; 3] = t.map(|i| points[i as usize].as_dvec3());
        a.dot(b.cross(c))
    };
    if triangles.iter().map(solid).sum::<f64>() <= 0.0 {
        return Err("the surface is inside out or encloses nothing".to_owned());
    }
    Ok((points, triangles))
}

/// Joins vertices at equal positions and drops triangles that lose a corner.
fn welded(points: &[Vec3], triangles: &[[u32; 3]]) -> (Vec<Vec3>, Vec<[u32; 3]>) {
    let mut kept: Vec<Vec3> = Vec::new();
    let mut index = HashMap::new();
    let map: Vec<u32> = points
        .iter()
        .map(|p| {
            // Zero plus negative zero is zero.
            *index.entry((*p + Vec3::ZERO).to_array().map(f32::to_bits)).or_insert_with(|| {
                kept.push(*p);
                kept.len() as u32 - 1
            })
        })
        .collect();
    let joined = triangles.iter().map(|t| t.map(|i| map[i as usize]));
    let triangles = joined.filter(|[a, b, c]| a != b && b != c && c != a).collect();
    (kept, triangles)
}

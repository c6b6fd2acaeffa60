//! Wavefront OBJ files with a material and a texture.

use std::io::{self, Write};
use std::path::Path;

use flyrig_types::write_whole;

use super::mesh_file::{MeshFile, MeshFileError, beside, system};

/// Writes a mesh as OBJ, metres, y up. A texture is written beside it as `NAME.png`, with the material in `NAME.mtl`; both
/// precede the OBJ file, which never appears without them. The skeleton is left out.
///
/// # Errors
/// [`MeshFileError`] for faulty content, before anything is written, and when the system fails.
pub fn write_obj(path: &Path, mesh: &MeshFile<'_>) -> Result<(), MeshFileError> {
    mesh.check(path, "obj")?;
    let material = match mesh.texture {
        None => None,
        Some(png) => {
            let (texture_path, texture) = beside(path, "png")?;
            let (material_path, material) = beside(path, "mtl")?;
            write_whole(&texture_path, |out| out.write_all(png)).map_err(system(&texture_path))?;
            // Illumination 0 is the plain colour.
            let illumination = u8::from(mesh.is_lit);
            let text =
                format!("newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum {illumination}\nmap_Kd {texture}\n");
            write_whole(&material_path, |out| out.write_all(text.as_bytes())).map_err(system(&material_path))?;
            Some(material)
        }
    };
    write_whole(path, |out| write_text(out, mesh, material.as_deref())).map_err(system(path))
}

fn write_text(out: &mut impl Write, mesh: &MeshFile<'_>, material: Option<&str>) -> io::Result<()> {
    writeln!(out, "# metres, y up")?;
    if let Some(name) = material {
        writeln!(out, "mtllib {name}")?;
    }
    for p in mesh.positions {
        writeln!(out, "v {} {} {}", p.x, p.y, p.z)?;
    }
    for uv in mesh.uvs {
        writeln!(out, "vt {} {}", uv.x, 1.0 - uv.y)?;
    }
    for n in mesh.normals {
        writeln!(out, "vn {} {} {}", n.x, n.y, n.z)?;
    }
    if material.is_some() {
        writeln!(out, "usemtl surface")?;
    }
    for triangle in mesh.triangles {
        let [a, b, c] = triangle.map(|i| u64::from(i) + 1);
        if mesh.uvs.is_empty() {
            writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
        } else {
            writeln!(out, "f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}")?;
        }
    }
    Ok(())
}

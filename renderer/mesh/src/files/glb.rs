//! Binary glTF files of meshes without bones.

use std::path::Path;

use flyrig_body::{BodyError, GlbWriter};
use glam::Vec3;
use serde_json::json;

use super::mesh_file::{MeshFile, MeshFileError, refused};

/// Writes a mesh without its skeleton as binary glTF 2.0, metres, y up. [`flyrig_body::write_glb`] writes meshes with bones.
///
/// # Errors
/// [`MeshFileError`] for faulty content, a file beyond 4 GiB, and when the system fails.
pub fn write_glb(path: &Path, mesh: &MeshFile<'_>) -> Result<(), MeshFileError> {
    mesh.check(path, "glb")?;
    let mut glb = GlbWriter::default();
    let mut attributes = json!({ "POSITION": glb.positions(mesh.positions) });
    // glTF requires unit normals, and a vertex without area has none.
    let normals: Vec<f32> = mesh.normals.iter().flat_map(|normal| normal.normalize_or(Vec3::Y).to_array()).collect();
    attributes["NORMAL"] = json!(glb.floats(&normals, "VEC3", 3));
    if !mesh.uvs.is_empty() {
        let uvs: Vec<f32> = mesh.uvs.iter().flat_map(glam::Vec2::to_array).collect();
        attributes["TEXCOORD_0"] = json!(glb.floats(&uvs, "VEC2", 2));
    }
    let mut primitive = json!({ "attributes": attributes, "indices": glb.indices(mesh.triangles.as_flattened()) });
    let mut document = json!({ "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "name": "mesh", "mesh": 0 }] });
    if let Some(png) = mesh.texture {
        primitive["material"] = json!(0);
        glb.material(&mut document, png, mesh.is_lit);
    }
    document["meshes"] = json!([{ "primitives": [primitive] }]);
    glb.write(path, document).map_err(|error| match error {
        BodyError::Unwritten { message, .. } => refused(path, message),
        other => refused(path, other.to_string()),
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use glam::Vec2;
    use serde_json::Value;

    use super::*;

    #[test]
    fn a_mesh_without_bones_is_written_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.glb");
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::new(0.1, 0.2, 1.5)];
        let mesh = MeshFile {
            positions: &positions,
            normals: &[Vec3::X, Vec3::Y, Vec3::Z * 2.0, Vec3::ZERO],
            uvs: &[Vec2::ZERO, Vec2::X, Vec2::Y, Vec2::ONE],
            triangles: &[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
            texture: Some(b"\x89PNG\r\n\x1a\nrest"),
            is_lit: false,
            skeleton: None,
        };
        write_glb(&path, &mesh).unwrap();
        let bytes = fs::read(&path).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
        let document: Value = serde_json::from_slice(&bytes[20..20 + word(12)]).unwrap();
        let binary = 28 + word(12);
        let accessor = |index: &Value| document["accessors"][index.as_u64().unwrap() as usize].clone();
        let primitive = &document["meshes"][0]["primitives"][0];
        let place = accessor(&primitive["attributes"]["POSITION"]);
        assert_eq!((&place["count"], &place["max"][2]), (&4.into(), &1.5.into()));
        let view = &document["bufferViews"][place["bufferView"].as_u64().unwrap() as usize];
        let from = binary + view["byteOffset"].as_u64().unwrap() as usize;
        let row = |i: usize| [0, 1, 2].map(|k| f32::from_bits(word(from + 12 * i + 4 * k) as u32));
        assert!(Vec3::from(row(3)).distance(positions[3]) < 1e-9);
        assert_eq!(accessor(&primitive["indices"])["count"], 12);
        assert_eq!(document["skins"], Value::Null);
        // Without a texture, and faults.
        write_glb(&path, &MeshFile { texture: None, uvs: &[], ..mesh }).unwrap();
        fs::remove_file(&path).unwrap();
        for (mesh, name, text) in [
            (MeshFile { triangles: &[[0, 1, 9]], ..mesh }, "a.glb", "refers to vertex 9 of 4"),
            (mesh, "a.gltf", "must end in .glb"),
            (mesh, "no/a.glb", "a.glb: not written"),
        ] {
            let found = write_glb(&folder.path().join(name), &mesh).unwrap_err().to_string();
            assert!(found.contains(text), "{found}");
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}

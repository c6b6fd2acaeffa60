//! From a dense closed mesh to files of all formats. The files stay in the target folder's `tmp/meshes` for
//! `scripts/check-meshes.py`, which opens them with other programs.
#![allow(clippy::unwrap_used)] // a test may fail by panicking, in its helpers too

use std::io::Cursor;
use std::path::Path;

use flyrig_mesh::{
    AtlasSettings, Connectivity, JointFrame, MeshFile, MeshFrame, MeshJoint, MeshSkeleton, TriMesh, decimate,
    mesh_atlas, write_3mf, write_obj, write_usd_sequence, write_usdz,
};
use glam::{Mat4, Quat, Vec2, Vec3};

#[path = "../src/shapes.rs"]
#[allow(dead_code)]
mod shapes;

/// Texture whose colours are the coordinates.
fn png(side: u32) -> Vec<u8> {
    let image =
        image::RgbImage::from_fn(side, side, |x, y| image::Rgb([(x * 255 / side) as u8, (y * 255 / side) as u8, 99]));
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

/// Writes all files of one mesh and returns its row of `expected.json`.
fn write_all(folder: &Path, name: &str, mesh: &TriMesh, target: usize) -> String {
    let simple = decimate(mesh, target).unwrap();
    assert!(Connectivity::new(&simple.mesh.triangles).is_closed_manifold());
    let atlas = mesh_atlas(&simple.mesh, AtlasSettings { side: 1024, gutter: 4 }).unwrap();
    println!(
        "{name}: {} -> {} triangles, {:.2} mm off on average, {:.2} at most; {} charts, coverage {:.2}, texel {:.2} mm, stretch mean {:.3}, 99 % {:.3}, worst {:.3}",
        mesh.triangles.len(),
        simple.mesh.triangles.len(),
        1e3 * simple.mean_distance_m,
        1e3 * simple.max_distance_m,
        atlas.charts,
        atlas.coverage,
        1e3 * atlas.texel_m,
        atlas.mean_stretch,
        atlas.stretch_99,
        atlas.worst_stretch
    );
    let positions = atlas.split(&simple.mesh.positions);
    let normals = atlas.split(&shapes::normals(&simple.mesh));
    let (low, high) = positions.iter().fold((f32::MAX, f32::MIN), |(low, high), p| (low.min(p.y), high.max(p.y)));
    let texture = png(1024);
    let file = MeshFile {
        positions: &positions,
        normals: &normals,
        uvs: &atlas.uvs,
        triangles: &atlas.triangles,
        texture: Some(&texture),
        is_lit: true,
        skeleton: None,
    };
    let path = |extension: &str| folder.join(name).with_extension(extension);
    write_obj(&path("obj"), &file).unwrap();
    write_3mf(&path("3mf"), &file).unwrap();

    // The upper half leans to the side, once by joints and once by points.
    let middle = Mat4::from_translation(Vec3::Y * 0.5 * (low + high));
    let root =
        MeshJoint { name: "root", parent: None, mesh_from_joint: Mat4::IDENTITY, parent_from_joint: Mat4::IDENTITY };
    let top = MeshJoint { name: "upper half", parent: Some(0), mesh_from_joint: middle, parent_from_joint: middle };
    let share = |p: &Vec3| ((p.y - low) / (high - low)).clamp(0.0, 1.0);
    let weights: Vec<[f32; 4]> = positions.iter().map(|p| [1.0 - share(p), share(p), 0.0, 0.0]).collect();
    let turn = |frame: usize| Quat::from_rotation_z(0.05 * frame as f32);
    let poses: Vec<([Vec3; 2], [Quat; 2])> =
        (0..20).map(|i| ([Vec3::ZERO, middle.w_axis.truncate()], [Quat::IDENTITY, turn(i)])).collect();
    let frames: Vec<JointFrame<'_>> = (0u32..)
        .zip(&poses)
        .map(|(i, (translations, rotations))| JointFrame { secs: f64::from(i) / 25.0, translations, rotations })
        .collect();
    let skeleton = MeshSkeleton {
        joints: &[root, top],
        indices: &vec![[0, 1, 0, 0]; positions.len()],
        weights: &weights,
        frames: &frames,
    };
    write_usdz(&path("usdz"), &file).unwrap();
    let rigged = folder.join(format!("{name}-rigged.usdz"));
    write_usdz(&rigged, &MeshFile { skeleton: Some(skeleton), ..file }).unwrap();

    let moved = |i: usize| -> Vec<Vec3> {
        let turned = middle * Mat4::from_quat(turn(i)) * middle.inverse();
        positions.iter().map(|p| p.lerp(turned.transform_point3(*p), share(p))).collect()
    };
    let secs: Vec<f64> = (0u32..20).map(|i| f64::from(i) / 25.0).collect();
    let frame = |i: usize| Ok(MeshFrame { positions: moved(i), normals: normals.clone() });
    write_usd_sequence(&path("usda"), &file, &secs, frame).unwrap();
    let last: Vec2 = moved(19).iter().fold(Vec2::new(f32::MAX, f32::MIN), |y, p| Vec2::new(y.x.min(p.y), y.y.max(p.y)));
    format!(
        r#"  "{name}": {{"triangles": {}, "height_m": {}, "last_height_m": {}, "genus": {}}}"#,
        atlas.triangles.len(),
        high - low,
        last.y - last.x,
        1 - Connectivity::new(&simple.mesh.triangles).euler / 2
    )
}

#[test]
fn dense_meshes_become_files() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("meshes");
    std::fs::create_dir_all(&folder).unwrap();
    let rows = [
        write_all(&folder, "sphere", &shapes::bumpy_sphere(60), 8_000),
        write_all(&folder, "tori", &shapes::two_tori(400, 80), 6_000),
    ];
    std::fs::write(folder.join("expected.json"), format!("{{\n{}\n}}\n", rows.join(",\n"))).unwrap();
}

//! Bytes of mesh files, and refusals that leave nothing behind.

use std::fs;
use std::io::{Cursor, Read};
use std::path::Path;

use glam::{Mat4, Quat, Vec2, Vec3};
use zip::ZipArchive;

use super::*;
use crate::shapes;

const PNG: &[u8] = b"\x89PNG\r\n\x1a\n and so on";

/// Tetrahedron whose first vertex is split.
struct Sample {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    uvs: Vec<Vec2>,
    triangles: Vec<[u32; 3]>,
    joints: Vec<MeshJoint<'static>>,
    indices: Vec<[u16; 4]>,
    weights: Vec<[f32; 4]>,
}

impl Sample {
    fn new() -> Self {
        let joint = |name, parent, y| {
            let at = Mat4::from_translation(Vec3::Y * y);
            MeshJoint { name, parent, mesh_from_joint: at, parent_from_joint: at }
        };
        Self {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, Vec3::ZERO],
            normals: vec![Vec3::NEG_ONE.normalize(), Vec3::X, Vec3::Y, Vec3::Z, Vec3::NEG_Y],
            uvs: vec![Vec2::new(0.25, 0.75); 5],
            triangles: vec![[0, 2, 1], [4, 1, 3], [1, 2, 3], [2, 0, 3]],
            joints: vec![joint("hips", None, 0.0), joint("left leg", Some(0), 0.5), joint("left_leg", Some(0), 0.5)],
            indices: vec![[0, 1, 2, 0]; 5],
            weights: vec![[0.5, 0.25, 0.25, 0.0]; 5],
        }
    }

    fn mesh(&self) -> MeshFile<'_> {
        let Self { positions, normals, uvs, triangles, .. } = self;
        MeshFile { positions, normals, uvs, triangles, texture: Some(PNG), is_lit: true, skeleton: None }
    }

    fn skeleton<'a>(&'a self, frames: &'a [JointFrame<'a>]) -> MeshSkeleton<'a> {
        MeshSkeleton { joints: &self.joints, indices: &self.indices, weights: &self.weights, frames }
    }
}

fn entry(bytes: &[u8], name: &str) -> String {
    let mut text = String::new();
    ZipArchive::new(Cursor::new(bytes)).unwrap().by_name(name).unwrap().read_to_string(&mut text).unwrap();
    text
}

#[test]
fn obj_counts_from_one_and_has_v_up() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("body.obj");
    let sample = Sample::new();
    write_obj(&path, &sample.mesh()).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.starts_with("# metres, y up\nmtllib body.mtl\nv 0 0 0\nv 1 0 0\n"));
    assert!(text.contains("\nvt 0.25 0.25\n") && text.contains("\nvn 0 -1 0\nusemtl surface\nf 1/1/1 3/3/3 2/2/2\n"));
    assert!(fs::read_to_string(folder.path().join("body.mtl")).unwrap().contains("map_Kd body.png\n"));
    assert_eq!(fs::read(folder.path().join("body.png")).unwrap(), PNG);
    write_obj(&folder.path().join("plain.obj"), &MeshFile { uvs: &[], texture: None, ..sample.mesh() }).unwrap();
    assert!(fs::read_to_string(folder.path().join("plain.obj")).unwrap().ends_with("f 3//3 1//1 4//4\n"));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 4);
}

#[test]
fn textures_that_contain_the_light_are_not_lit_again() {
    let folder = tempfile::tempdir().unwrap();
    let sample = Sample::new();
    for (is_lit, illumination, color, other) in [
        (true, "illum 1", "inputs:diffuseColor.connect", "emissiveColor"),
        (false, "illum 0", "inputs:emissiveColor.connect", "diffuseColor.connect"),
    ] {
        let mesh = MeshFile { is_lit, ..sample.mesh() };
        write_obj(&folder.path().join("a.obj"), &mesh).unwrap();
        assert!(fs::read_to_string(folder.path().join("a.mtl")).unwrap().contains(illumination));
        write_usdz(&folder.path().join("a.usdz"), &mesh).unwrap();
        // Files in USDZ are not compressed.
        let bytes = fs::read(folder.path().join("a.usdz")).unwrap();
        let has = |text: &str| bytes.windows(text.len()).any(|window| window == text.as_bytes());
        assert!(has(color) && !has(other), "{is_lit}");
    }
}

#[test]
fn threemf_is_closed_in_millimetres_with_z_up() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("body.3mf");
    let sample = Sample::new();
    write_3mf(&path, &sample.mesh()).unwrap();
    let bytes = fs::read(&path).unwrap();
    let model = entry(&bytes, "3D/3dmodel.model");
    assert_eq!(model.matches("<vertex ").count(), 4, "the split vertex is joined");
    assert_eq!(model.matches("<triangle ").count(), 4);
    assert!(model.contains(r#"unit="millimeter""#) && model.contains(r#"<vertex x="0" y="0" z="1000"/>"#));
    assert!(model.contains(r#"transform="1 0 0 0 1 0 0 0 1 0 1000 0""#));
    assert!(entry(&bytes, "_rels/.rels").contains("/3D/3dmodel.model"));
    assert!(entry(&bytes, "[Content_Types].xml").contains("3dmanufacturing-3dmodel+xml"));
    write_3mf(&path, &sample.mesh()).unwrap();
    assert_eq!(fs::read(&path).unwrap(), bytes, "equal input gives equal bytes");

    // Two solids that touch at a vertex are split already and stay two.
    let tori = shapes::two_tori(12, 6);
    let normals = shapes::normals(&tori);
    let mesh =
        MeshFile { positions: &tori.positions, normals: &normals, triangles: &tori.triangles, ..MeshFile::default() };
    write_3mf(&path, &mesh).unwrap();
    assert_eq!(entry(&fs::read(&path).unwrap(), "3D/3dmodel.model").matches("<vertex ").count(), 144);
}

#[test]
fn usdz_is_stored_and_aligned_with_the_stage_first() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("body.usdz");
    let sample = Sample::new();
    let frame = |secs, x| (secs, vec![Vec3::X * x; 3], vec![Quat::IDENTITY; 3]);
    let frames = [frame(0.5, 1.0), frame(1.0, 2.0), frame(1.5, 3.0)];
    let frames: Vec<JointFrame<'_>> = frames
        .iter()
        .map(|(secs, translations, rotations)| JointFrame { secs: *secs, translations, rotations })
        .collect();
    write_usdz(&path, &MeshFile { skeleton: Some(sample.skeleton(&frames)), ..sample.mesh() }).unwrap();
    let bytes = fs::read(&path).unwrap();
    let mut zip = ZipArchive::new(Cursor::new(&bytes)).unwrap();
    for (i, name) in ["mesh.usda", "textures/color.png"].into_iter().enumerate() {
        let file = zip.by_index(i).unwrap();
        assert_eq!((file.name().unwrap().as_ref(), file.data_start().unwrap() % 64), (name, 0));
        assert_eq!((file.compression(), file.size()), (zip::CompressionMethod::Stored, file.compressed_size()));
    }
    let stage = entry(&bytes, "mesh.usda");
    for line in [
        "upAxis = \"Y\"",
        "metersPerUnit = 1\n",
        "startTimeCode = 1\n    endTimeCode = 3\n    timeCodesPerSecond = 2",
        "faceVertexIndices = [0, 2, 1, 4, 1, 3, ",
        "primvars:st = [(0.25, 0.25), ",
        "asset inputs:file = @textures/color.png@",
        "joints = [\"hips\", \"hips/left_leg\", \"hips/left_leg_2\"]",
        "bindTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0.5, 0, 1))",
        "2: [(2, 0, 0), (2, 0, 0), (2, 0, 0)],",
        "3: [(1, 0, 0, 0), (1, 0, 0, 0), (1, 0, 0, 0)],",
    ] {
        assert!(stage.contains(line), "{line} is missing in {stage}");
    }
    assert_eq!(stage.matches('{').count(), stage.matches('}').count());
}

#[test]
fn sequences_have_points_by_time() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("dance.usda");
    let sample = Sample::new();
    let moved: Vec<Vec3> = sample.positions.iter().map(|p| p + Vec3::Y).collect();
    let frame = |positions: &[Vec3]| MeshFrame { positions: positions.to_vec(), normals: sample.normals.clone() };
    let frames = [frame(&sample.positions), frame(&moved)];
    let write = |path: &Path, secs: &[f64], frames: &[MeshFrame]| {
        write_usd_sequence(path, &sample.mesh(), secs, |i| Ok(frames[i].clone()))
    };
    write(&path, &[0.0, 0.25], &frames).unwrap();
    let stage = fs::read_to_string(&path).unwrap();
    assert!(stage.contains("timeCodesPerSecond = 4") && stage.contains("endTimeCode = 1\n"));
    assert!(stage.contains("1: [(0, 1, 0), (1, 1, 0),") && stage.contains("@./dance.png@"));
    assert!(stage.contains("1: [(0, 1, 0), (1, 2, 1)],"), "the extent moves");
    assert!(folder.path().join("dance.png").exists());
    assert_eq!(stage.matches('{').count(), stage.matches('}').count());
    let normals = stage.split("normals.timeSamples").nth(1).unwrap();
    assert_eq!(normals.split('}').next().unwrap().matches(": [(").count(), 2, "{normals}");
    let no = folder.path().join("no.usda");
    let refused = |secs: &[f64], frames: &[MeshFrame]| write(&no, secs, frames).unwrap_err().to_string();
    assert!(refused(&[], &[]).ends_with("no.usda: not written, the sequence has no frames"));
    assert!(refused(&[0.25, 0.0], &frames).contains("the frame at 0 s does not follow the one at 0.25 s"));
    assert!(refused(&[f64::NAN], &frames).contains("NaN"));
    assert!(refused(&[0.0], &[frame(&moved[1..])]).contains("has 4 positions and 5 normals of 5"));
    let poisoned = MeshFrame { normals: [&[Vec3::NAN], &moved[1..]].concat(), ..frames[0].clone() };
    assert!(refused(&[0.0, 1.0], &[frames[0].clone(), poisoned]).contains("vertex 0 of the frame at 1 s"));
    let failed = write_usd_sequence(&no, &sample.mesh(), &[0.0], |_| Err(std::io::Error::other("no disk")));
    assert!(failed.unwrap_err().to_string().ends_with("no.usda: not written, no disk"));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2, "nothing of a refused sequence stays");
}

/// Every writer refuses the same faults with the file's name and leaves nothing.
#[test]
fn faulty_meshes_are_refused_and_leave_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let sample = Sample::new();
    let write = |name: &str, mesh: &MeshFile<'_>| -> String {
        let path = folder.path().join(name);
        let result = match Path::new(name).extension().and_then(|e| e.to_str()) {
            Some("obj") => write_obj(&path, mesh),
            Some("3mf") => write_3mf(&path, mesh),
            Some("usdz") => write_usdz(&path, mesh),
            _ => {
                let frame = MeshFrame { positions: mesh.positions.to_vec(), normals: mesh.normals.to_vec() };
                write_usd_sequence(&path, mesh, &[0.0], |_| Ok(frame.clone()))
            }
        };
        result.unwrap_err().to_string()
    };
    let poisoned = [Vec3::X, Vec3::NAN, Vec3::X, Vec3::X, Vec3::X];
    let infinite = [Vec2::INFINITY; 5];
    for name in ["a.obj", "a.3mf", "a.usdz", "a.usda"] {
        let good = sample.mesh();
        for (mesh, message) in [
            (MeshFile { positions: &[], ..good }, "the mesh is empty"),
            (MeshFile { triangles: &[], ..good }, "the mesh is empty"),
            (MeshFile { normals: &sample.normals[1..], ..good }, "there are 5 positions but 4 normals"),
            (MeshFile { uvs: &sample.uvs[1..], ..good }, "there are 5 positions but 4 texture coordinates"),
            (MeshFile { uvs: &[], ..good }, "there is a texture but no texture coordinates"),
            (MeshFile { texture: Some(b"GIF"), ..good }, "the texture is not a PNG file"),
            (MeshFile { triangles: &[[0, 1, 5]], ..good }, "a triangle refers to vertex 5 of 5"),
            (MeshFile { positions: &poisoned, ..good }, "vertex 1 is not a finite number"),
            (MeshFile { normals: &poisoned, ..good }, "vertex 1 is not a finite number"),
            (MeshFile { uvs: &infinite, ..good }, "vertex 0 is not a finite number"),
        ] {
            let found = write(name, &mesh);
            assert!(found.ends_with(&format!("{name}: not written, {message}")), "{found}");
        }
    }
    assert!(write("a.stl", &sample.mesh()).contains("must end in .usda"));
    assert!(write("a@b.usda", &sample.mesh()).contains("without control characters and '@'"));
    assert!(write("a.3mf", &MeshFile { triangles: &sample.triangles[1..], ..sample.mesh() }).contains("3 open edges"));
    let turned: Vec<[u32; 3]> = sample.triangles.iter().map(|[a, b, c]| [*b, *a, *c]).collect();
    assert!(write("a.3mf", &MeshFile { triangles: &turned, ..sample.mesh() }).contains("inside out"));
    assert!(write("no/such/a.obj", &sample.mesh()).contains("a.png: not written"));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn faulty_skeletons_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usdz");
    let refused = |change: fn(&mut Sample), rotations: &[Quat]| {
        let mut sample = Sample::new();
        change(&mut sample);
        let frames = [JointFrame { secs: 0.0, translations: &[Vec3::ZERO; 3], rotations }];
        write_usdz(&path, &MeshFile { skeleton: Some(sample.skeleton(&frames)), ..sample.mesh() })
            .unwrap_err()
            .to_string()
    };
    let still = [Quat::IDENTITY; 3];
    for (message, change) in [
        ("the skeleton has no joints", (|s| s.joints.clear()) as fn(&mut Sample)),
        ("joint 'left leg' stands before its parent", |s| s.joints[1].parent = Some(1)),
        ("joint 'hips' has a transform that is not finite", |s| s.joints[0].mesh_from_joint.x_axis.x = f32::NAN),
        ("there are 5 positions but joints of 5 and weights of 4", |s| s.weights.truncate(4)),
        ("a vertex refers to joint 3 of 3", |s| s.indices[2][1] = 3),
        ("the skin weights of vertex 4 do not sum to one", |s| s.weights[4][0] = 0.9),
        ("the skin weights of vertex 0 do not sum to one", |s| s.weights[0][0] = f32::NAN),
    ] {
        let found = refused(change, &still);
        assert!(found.contains(message), "{found}");
    }
    assert!(refused(|_| (), &still[1..]).contains("3 translations and 2 rotations does not fit 3 joints"));
    assert!(refused(|_| (), &[Quat::from_array([0.0; 4]); 3]).contains("rotations that are not unit"));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

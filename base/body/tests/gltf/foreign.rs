//! Additions of exporters and extensions of the format.

use flyrig_body::{GltfHuman, RetargetOptions, Template, load_gltf_motion, skin_mesh};
use flyrig_types::PoseTrack;
use glam::{DVec3, Mat4, Vec3};
use serde_json::{Value, json};

use crate::file::{File, animate, armature};
use crate::human;

/// Box of the human's body, metres, so that its feet are on the floor.
const BODY: [[f32; 3]; 6] =
    [[-0.2, 0.0, 0.1], [0.2, 0.0, 0.1], [0.0, 1.0, 0.0], [-0.1, 1.0, -0.1], [0.1, 1.4, 0.0], [0.0, 1.7, 0.05]];

/// Replaces the human's mesh by one of these positions, all on the hips.
fn with_positions(file: &mut File, accessor: usize) {
    let joints = file.shorts("VEC4", &[0; 24]);
    let weights = file.accessor(&[255, 0, 0, 0].repeat(6), 5121, "VEC4", 6);
    file.json["accessors"][weights]["normalized"] = json!(true);
    let indices = file.accessor(&[0, 1, 2, 3, 4, 5], 5121, "SCALAR", 6);
    let attributes = json!({"POSITION": accessor, "JOINTS_0": joints, "WEIGHTS_0": weights});
    file.json["meshes"] = json!([{"primitives": [{"attributes": attributes, "indices": indices}]}]);
}

fn plain() -> File {
    let mut file = human("");
    let positions = file.floats("VEC3", BODY.as_flattened());
    with_positions(&mut file, positions);
    file
}

/// Multiplies the inverse bind matrices by `body_from_mesh`, and the dequantisation that it holds.
fn rebind(file: &mut File, body_from_mesh: Mat4) {
    let binds = file.json["skins"][0]["inverseBindMatrices"].as_u64().unwrap() as usize;
    let at = file.json["bufferViews"][binds]["byteOffset"].as_u64().unwrap() as usize;
    let count = file.json["accessors"][binds]["count"].as_u64().unwrap() as usize;
    let numbers: Vec<f32> =
        file.bin[at..at + 64 * count].chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    let changed: Vec<f32> = numbers
        .chunks(16)
        .flat_map(|matrix| (Mat4::from_cols_slice(matrix) * body_from_mesh).to_cols_array())
        .collect();
    let binds = file.floats("MAT4", &changed);
    file.json["skins"][0]["inverseBindMatrices"] = json!(binds);
}

/// Asserts that two humans have the same surface at rest and in the middle of the animation.
fn assert_same(a: &GltfHuman, b: &GltfHuman, most_m: f32, what: &str) {
    let poses = |human: &GltfHuman| {
        let track: &PoseTrack = human.track.as_ref().unwrap();
        [human.template.skeleton.rest_pose(), track.at(500_000_000)]
    };
    for (pose_a, pose_b) in poses(a).iter().zip(&poses(b)) {
        let surface = |template: &Template, pose| {
            let mut positions = skin_mesh(template, pose).0;
            positions
                .sort_by(|a, b| a.to_array().map(|x| (x * 1e4) as i32).cmp(&b.to_array().map(|x| (x * 1e4) as i32)));
            positions
        };
        let (a, b) = (surface(&a.template, pose_a), surface(&b.template, pose_b));
        assert_eq!(a.len(), b.len(), "{what}");
        for a in &a {
            let off = b.iter().map(|b| a.distance(*b)).fold(f32::INFINITY, f32::min);
            assert!(off < most_m, "{what}: {a} is {off} m off");
        }
    }
}

#[test]
fn quantised_meshes_are_read() {
    let expected = plain().load().unwrap();
    // The middle of the body at the origin, its largest half as 1: what glTF-Transform and gltfpack write.
    let (middle, half) = (Vec3::new(0.0, 0.85, 0.0), 0.85f32);
    let unit = |p: &[f32; 3]| ((Vec3::from(*p) - middle) / half).to_array();
    let dequantise = Mat4::from_translation(middle) * Mat4::from_scale(Vec3::splat(half));
    let check = |bytes: &[u8], component: u32, normalized: bool, matrix: Mat4, most_m: f32| {
        let mut file = human("");
        let positions = file.accessor(bytes, component, "VEC3", 6);
        file.json["accessors"][positions]["normalized"] = json!(normalized);
        file.json["accessors"][positions]["min"] = json!([-32767, -32767, -32767]);
        file.json["extensionsUsed"] = json!(["KHR_mesh_quantization"]);
        file.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
        with_positions(&mut file, positions);
        rebind(&mut file, matrix);
        let found = file.load().unwrap();
        assert_same(&expected, &found, most_m, &format!("component {component}, normalized {normalized}"));
        // The canonical body stands on the floor, as the plain one does.
        let lowest = found.template.positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
        assert!(lowest.abs() < 0.01, "{lowest}");
        found.template.check().unwrap();
    };
    let shorts = |scale: f32| -> Vec<u8> {
        BODY.iter().flat_map(unit).flat_map(|x| ((x * scale).round() as i16).to_le_bytes()).collect()
    };
    let bytes: Vec<u8> = BODY.iter().flat_map(unit).map(|x| (x * 127.0).round() as i8 as u8).collect();
    // Rows of vertices begin at multiples of four; a stride is not needed here.
    check(&shorts(32767.0), 5122, true, dequantise, 1e-3);
    check(&shorts(10000.0), 5122, false, dequantise * Mat4::from_scale(Vec3::splat(1e-4)), 1e-3);
    check(&bytes, 5120, true, dequantise, 1e-2);
    // Other steps along each axis.
    let uneven: Vec<u8> = BODY
        .iter()
        .flat_map(|p| [p[0] / 0.2, (p[1] - 0.85) / 0.85, p[2] / 0.1])
        .flat_map(|x| ((x * 32767.0).round() as i16).to_le_bytes())
        .collect();
    let matrix = Mat4::from_translation(middle) * Mat4::from_scale(Vec3::new(0.2, 0.85, 0.1));
    check(&uneven, 5122, true, matrix, 1e-3);
}

#[test]
fn compressed_files_name_the_extension_and_the_command() {
    let refused = |change: &dyn Fn(&mut Value)| {
        let mut file = armature();
        change(&mut file.json);
        file.refused()
    };
    for extension in ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"] {
        let error = refused(&|json| json["extensionsRequired"] = json!([extension]));
        assert!(error.contains(extension) && error.contains("npx @gltf-transform/cli copy \"test.glb\""), "{error}");
    }
    // Not required, but without plain data.
    let draco = json!({"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}});
    let error = refused(&|json| {
        json["meshes"][0]["primitives"][0]["extensions"] = draco.clone();
        json["accessors"][0].as_object_mut().unwrap().remove("bufferView");
    });
    assert!(error.contains("KHR_draco_mesh_compression"), "{error}");
    let mut file = armature();
    file.json["buffers"] = json!([{"byteLength": 4, "extensions": {"EXT_meshopt_compression": {"fallback": true}}}]);
    let error = crate::file::load_bytes(file.json.to_string().as_bytes(), "test.gltf").unwrap_err().to_string();
    assert!(error.contains("EXT_meshopt_compression"), "{error}");
    // Beside plain data it does not matter.
    let mut file = armature();
    file.json["meshes"][0]["primitives"][0]["extensions"] = draco;
    file.json["extensionsUsed"] = json!(["KHR_draco_mesh_compression"]);
    assert!(file.load().is_ok());
    let error = refused(&|json| json["extensionsRequired"] = json!(["ACME_soft_flesh"]));
    assert!(error.contains("requires the extension ACME_soft_flesh, which is not read"), "{error}");
    let error = refused(&|json| json["asset"]["version"] = json!("1.0"));
    assert!(error.contains("glTF version 1.0; version 2.0 is read"), "{error}");
}

#[test]
fn looks_and_other_additions_are_ignored() {
    let expected = human("").load().unwrap();
    let add = |change: &dyn Fn(&mut File)| {
        let mut file = human("");
        change(&mut file);
        let found = file.load().unwrap();
        assert_eq!((&found.template, &found.track), (&expected.template, &expected.track));
    };
    add(&|file| {
        file.json["extensionsUsed"] = json!(["KHR_materials_variants", "VRMC_vrm", "EXT_texture_webp", "ACME_flesh"]);
        file.json["extensionsRequired"] = json!(["EXT_texture_webp", "KHR_texture_transform", "VRMC_materials_mtoon"]);
        file.json["extensions"] =
            json!({"VRMC_vrm": {"humanoid": 7}, "KHR_lights_punctual": {"lights": [{"type": "moon"}]}});
        // A texture without a plain source, materials of other programs, a camera of a new kind.
        file.json["textures"] = json!([{"extensions": {"EXT_texture_webp": {"source": 0}}}, 7]);
        file.json["images"] = json!([{"mimeType": "image/webp", "bufferView": 0}]);
        file.json["materials"] = json!([{"pbrMetallicRoughness": {"baseColorFactor": "red"}, "alphaMode": "GLOW"}]);
        file.json["cameras"] = json!([{"type": "fisheye"}]);
        file.json["samplers"] = json!([{"magFilter": 1}]);
        file.json["scene"] = json!(9);
    });
    add(&|file| {
        let primitive = &mut file.json["meshes"][0]["primitives"][0];
        primitive["material"] = json!(3);
        primitive["targets"] = json!([{"POSITION": 99, "ACME_BLUSH": 1}]);
        primitive["attributes"]["COLOR_x"] = json!(0);
        primitive["attributes"]["_FEATURE_ID_0"] = json!(0);
        primitive["attributes"]["TEXCOORD_3"] = json!(77);
        file.json["meshes"][0]["weights"] = json!([0.5]);
        file.json["nodes"][0]["camera"] = json!(4);
        file.json["nodes"][0]["extensions"] = json!({"KHR_lights_punctual": {"light": 3}, "ACME": null});
        file.json["skins"][0]["skeleton"] = json!(900);
    });
    // Accessors without data, which are all zeros, and bounds of another form.
    add(&|file| {
        file.json["accessors"].as_array_mut().unwrap().push(json!({"componentType": 5126, "type": "VEC3", "count": 4}));
        file.json["accessors"][0]["min"] = json!(null);
        file.json["accessors"][0]["max"] = json!([1, 2]);
    });
    // Channels that move no node.
    add(&|file| {
        let channels = file.json["animations"][0]["channels"].as_array_mut().unwrap();
        channels.push(json!({"sampler": 0, "target": {"path": "rotation"}}));
        channels.push(json!({"sampler": 1, "target": {"path": "pointer", "extensions": {
            "KHR_animation_pointer": {"pointer": "/materials/0/pbrMetallicRoughness/roughnessFactor"}}}}));
        channels.push(json!({"sampler": 1, "target": {"node": 2, "path": "weights"}}));
        channels.push(json!({"sampler": 1, "target": {"node": 2, "path": "ACME_glow"}}));
    });
    // A pointer to the transform of a node moves it.
    add(&|file| {
        file.json["animations"][0]["channels"][0]["target"] = json!({"path": "pointer", "extensions": {
            "KHR_animation_pointer": {"pointer": "/nodes/1/rotation"}}});
    });
    // A byte order mark in front of JSON text, and no names.
    let mut file = human("");
    file.json["buffers"] = json!([{"byteLength": file.bin.len(), "uri": "data:application/octet-stream;base64,"}]);
    let error =
        crate::file::load_bytes(format!("\u{feff}{}", file.json).as_bytes(), "test.gltf").unwrap_err().to_string();
    assert!(error.contains("buffer 0 is cut off"), "{error}");
}

#[test]
fn sparse_accessors_are_read() {
    let expected = plain().load().unwrap();
    let mut file = human("");
    // The first three positions lie elsewhere in the data, and the last is replaced twice.
    let mut wrong = BODY;
    wrong[1] = [9.0; 3];
    wrong[5] = [8.0; 3];
    let positions = file.floats("VEC3", wrong.as_flattened());
    let values = file.floats("VEC3", &[BODY[1], [7.0; 3], BODY[5]].concat());
    let indices = file.accessor(&[1, 0, 5, 0, 5, 0], 5123, "SCALAR", 3);
    let accessors = file.json["accessors"].clone();
    let view = |accessor: usize| accessors[accessor]["bufferView"].clone();
    let sparse = json!({
        "count": 3,
        "indices": {"bufferView": view(indices), "componentType": 5123},
        "values": {"bufferView": view(values)},
    });
    file.json["accessors"][positions]["sparse"] = sparse.clone();
    with_positions(&mut file, positions);
    assert_same(&expected, &file.load().unwrap(), 1e-6, "sparse");
    let refused = |change: &dyn Fn(&mut Value)| {
        let mut file = file.clone();
        change(&mut file.json["accessors"][positions]["sparse"]);
        file.refused()
    };
    assert!(refused(&|sparse| sparse["count"] = json!(7)).contains("replaced items of the positions"));
    assert!(refused(&|sparse| sparse["count"] = json!(5)).contains("reaches beyond the end"));
    assert!(refused(&|sparse| sparse["indices"]["byteOffset"] = json!(1u64 << 60)).contains("beyond the end"));
    let odd = refused(&|sparse| sparse["indices"] = json!({"bufferView": view(values), "componentType": 5125}));
    assert!(odd.contains("replaces item"), "{odd}");
    // Differences to zeros alone.
    let mut zeros = file.clone();
    zeros.json["accessors"][positions].as_object_mut().unwrap().remove("bufferView");
    assert!(zeros.load().is_ok());
}

/// Cuts the body in two meshes, each on a skin of its own, with the listed joints; the face stands in a mesh space of its own.
fn on_two_skins(face_first: bool, joints: [&[usize]; 2], face_space: Mat4) -> File {
    let mut file = plain();
    let nodes: Vec<Vec3> = [[0.0, 1.0, 0.0], [0.1, 1.0, 0.0], [0.1, 0.55, 0.0], [0.1, 0.1, 0.0], [0.1, 0.02, 0.13]]
        .into_iter()
        .chain([[-0.1, 1.0, 0.0], [-0.1, 0.55, 0.0], [-0.1, 0.1, 0.0], [-0.1, 0.02, 0.13], [0.0, 1.4, 0.0]])
        .chain([[0.2, 1.5, 0.0], [0.5, 1.5, 0.0]])
        .map(Vec3::from)
        .collect();
    file.json["meshes"] = json!([]);
    file.json["skins"] = json!([]);
    file.json["nodes"].as_array_mut().unwrap().truncate(12);
    let order = if face_first { [1, 0] } else { [0, 1] };
    for part in order {
        let space = if part == 1 { face_space } else { Mat4::IDENTITY };
        let points: Vec<f32> = BODY[3 * part..3 * part + 3]
            .iter()
            .flat_map(|p| space.inverse().transform_point3(Vec3::from(*p)).to_array())
            .collect();
        let positions = file.floats("VEC3", &points);
        // Body on its first joint, face on its last.
        let joint = if part == 1 { joints[1].len() as u16 - 1 } else { 0 };
        let own = file.shorts("VEC4", &[joint, 0, 0, 0].repeat(3));
        let weights = file.floats("VEC4", &[1., 0., 0., 0.].repeat(3));
        let binds: Vec<f32> = joints[part]
            .iter()
            .flat_map(|&node| (Mat4::from_translation(-nodes[node]) * space).to_cols_array())
            .collect();
        let binds = file.floats("MAT4", &binds);
        let attributes = json!({"POSITION": positions, "JOINTS_0": own, "WEIGHTS_0": weights});
        let skins = file.json["skins"].as_array_mut().unwrap();
        skins.push(json!({"joints": joints[part], "inverseBindMatrices": binds, "name": format!("skin {part}")}));
        let index = skins.len() - 1;
        file.json["meshes"].as_array_mut().unwrap().push(json!({"primitives": [{"attributes": attributes}]}));
        file.json["nodes"].as_array_mut().unwrap().push(json!({"mesh": index, "skin": index}));
    }
    file
}

#[test]
fn meshes_on_several_skins_of_one_body_are_joined_in_any_order() {
    let all: Vec<usize> = (0..12).collect();
    let spaces =
        [Mat4::IDENTITY, Mat4::from_translation(Vec3::new(0.0, 1.5, 0.1)) * Mat4::from_scale(Vec3::splat(0.2))];
    // The same joints; some of them; joints of its own below those of the body.
    let cases: [[&[usize]; 2]; 3] = [[&all, &all], [&all, &[0, 9]], [&[0, 1, 2, 3, 4, 5, 6, 7, 8], &[9]]];
    for joints in cases {
        let mut known: Option<GltfHuman> = None;
        for space in spaces {
            for face_first in [false, true] {
                let found = on_two_skins(face_first, joints, space).load().unwrap();
                let what = format!("{joints:?}, face first {face_first}");
                found.template.check().unwrap();
                let highest = found.template.positions.iter().map(|p| p.y).fold(0.0, f32::max);
                assert!(found.template.positions.len() == 6 && (highest - 1.7).abs() < 1e-5, "{what}: {highest} m");
                let expected = if joints[0].len() == 9 { 10 } else { 12 };
                assert_eq!(found.template.skeleton.joints().len(), expected, "{what}");
                match &known {
                    Some(known) => assert_same(known, &found, 1e-5, &what),
                    None => known = Some(found),
                }
            }
        }
    }
}

#[test]
fn the_body_is_taken_from_among_other_skinned_things() {
    let expected = plain().load().unwrap();
    for first in [false, true] {
        let mut file = plain();
        // A flag on two bones of its own.
        let nodes = file.json["nodes"].as_array_mut().unwrap();
        nodes.extend([json!({"name": "Pole", "children": [14]}), json!({"name": "Cloth", "translation": [0, 1, 0]})]);
        nodes.push(json!({"mesh": 0, "skin": 1}));
        let skins = file.json["skins"].as_array_mut().unwrap();
        skins.push(json!({"joints": [13, 14], "name": "Flag"}));
        if first {
            skins.swap(0, 1);
            file.json["nodes"][12]["skin"] = json!(1);
            file.json["nodes"][15]["skin"] = json!(0);
        }
        let found = file.load().unwrap();
        assert_eq!(found.template, expected.template, "flag first: {first}");
    }
    // Joints that share a name stay distinct.
    let mut file = plain();
    file.json["nodes"][5]["name"] = json!("LeftUpLeg");
    let names: Vec<String> =
        file.load().unwrap().template.skeleton.joints().iter().map(|joint| joint.name.clone()).collect();
    assert!(names.contains(&"LeftUpLeg".to_owned()) && names.contains(&"LeftUpLeg (node 5)".to_owned()), "{names:?}");
    // Matrices that cannot be inverted.
    let mut file = plain();
    rebind(&mut file, Mat4::ZERO);
    assert!(
        file.refused().contains("the inverse bind matrix of joint 'Hips' cannot be inverted"),
        "{}",
        file.refused()
    );
}

#[test]
fn an_animation_that_stands_still_is_not_preferred() {
    let expected = human("").load().unwrap().track.unwrap();
    let with_first = |first: &dyn Fn(&mut File)| {
        let mut file = human("");
        let moving = file.json["animations"][0].clone();
        file.json["animations"] = Value::Null;
        first(&mut file);
        file.json["animations"][0]["name"] = json!("T-Pose");
        file.json["animations"].as_array_mut().unwrap().push(moving);
        file
    };
    let still = with_first(&|file| {
        animate(file, 1, "rotation", "LINEAR", &[0.0, 1.0], &[0., 0., 0., 1., 0., 0., 0., -1.]);
        animate(file, 0, "translation", "LINEAR", &[0.0, 1.0], &[0., 1., 0., 0., 1.001, 0.]);
    });
    assert_eq!(still.load().unwrap().track.unwrap(), expected, "a T pose first");
    let one_key = with_first(&|file| animate(file, 1, "rotation", "LINEAR", &[0.0], &[0.6, 0., 0., 0.8]));
    assert_eq!(one_key.load().unwrap().track.unwrap(), expected, "a pose first");
    let camera = with_first(&|file| {
        file.json["nodes"].as_array_mut().unwrap().push(json!({"name": "Camera"}));
        animate(file, 13, "translation", "LINEAR", &[0.0, 1.0], &[0., 1., 0., 5., 1., 0.]);
    });
    assert_eq!(camera.load().unwrap().track.unwrap(), expected, "a camera first");
    // The first of two that move, and the only one, even if it stands still.
    let moves =
        with_first(&|file| animate(file, 1, "rotation", "LINEAR", &[0.0, 3.0], &[0., 0., 0., 1., 1., 0., 0., 0.]));
    assert_eq!(moves.load().unwrap().track.unwrap().span_nanos(), (0, 3_000_000_000));
    let mut alone = still.clone();
    alone.json["animations"].as_array_mut().unwrap().truncate(1);
    assert_eq!(alone.load().unwrap().track.unwrap().span_nanos(), (0, 1_000_000_000));
    // Many still animations that share their keys are not all read.
    let mut many = still;
    let first = many.json["animations"][0].clone();
    many.json["animations"].as_array_mut().unwrap().extend(vec![first; 10_000]);
    assert!(many.load().is_ok());
}

#[test]
fn a_skeleton_without_a_body_has_a_motion() {
    let body: Template = flyrig_body::default_template(&flyrig_body::ShapeParams::man()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.glb");
    let track = |file: &File| {
        std::fs::write(&path, file.glb()).unwrap();
        load_gltf_motion(&path).and_then(|motion| motion.retarget(&body, &RetargetOptions::default()))
    };
    let whole = human("mixamorig:");
    let mut bare = whole.clone();
    bare.json["meshes"] = json!([]);
    bare.json["skins"] = json!([]);
    bare.json["nodes"].as_array_mut().unwrap().truncate(12);
    let (whole, bare_track) = (track(&whole).unwrap(), track(&bare).unwrap());
    for nanos in [0, 400_000_000, 1_000_000_000] {
        let worlds = [&whole, &bare_track].map(|track| body.skeleton.world_from_joint(&track.at(nanos)));
        for (a, b) in worlds[0].iter().zip(&worlds[1]) {
            let off: DVec3 = a.w_axis.truncate() - b.w_axis.truncate();
            assert!(off.length() < 1e-4, "{off} at {nanos} ns");
        }
    }
    bare.json.as_object_mut().unwrap().remove("animations");
    assert!(track(&bare).unwrap_err().to_string().contains("neither a skin nor an animation"));
}

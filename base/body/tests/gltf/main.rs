//! Import of hand-made glTF files.
// Helpers of tests may stop a test.
#![allow(clippy::unwrap_used, clippy::panic)]

use base64::Engine;
use flyrig_body::{BodyError, Part, load_gltf, skin_mesh};
use glam::{DQuat, DVec3, Vec3};
use serde_json::{Value, json};

use crate::file::{File, animate, armature, load_bytes};

mod file;
mod foreign;
mod limits;

fn near(found: Vec3, expected: Vec3) {
    assert!(found.distance(expected) < 1e-5, "{found} is not {expected}");
}

#[test]
fn scale_and_axes_above_the_root_are_folded_in() {
    let human = armature().load().unwrap();
    let body = &human.template;
    body.check().unwrap();
    let names: Vec<_> = body.skeleton.joints().iter().map(|joint| joint.name.as_str()).collect();
    assert_eq!(names, ["Hips", "Head"]);
    assert_eq!(body.parts, [[Part::Torso; 3], [Part::Head; 3]].concat());
    // z up in centimetres has become y up in metres, in canonical space and in the world.
    near(body.positions[0], Vec3::new(0.0, 1.0, 0.0));
    near(body.positions[5], Vec3::new(0.0, 2.1, 0.0));
    let (positions, normals) = skin_mesh(body, &body.skeleton.rest_pose());
    for (posed, canonical) in positions.iter().zip(&body.positions) {
        near(*posed, *canonical);
    }
    near(normals[0], Vec3::Z);
    // Turning the head moves the second triangle about (0, 1.5, 0).
    let mut pose = body.skeleton.rest_pose();
    pose.joint_rotations[1] = DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2);
    let (positions, _) = skin_mesh(body, &pose);
    near(positions[0], Vec3::new(0.0, 1.0, 0.0));
    near(positions[3], Vec3::new(0.0, 1.5, 0.5));
    assert!(human.track.is_none());
}

#[test]
fn linear_step_and_cubic_curves_are_followed() {
    let quarter = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2).as_quat().to_array();
    let mut file = armature();
    animate(&mut file, 1, "translation", "LINEAR", &[0.0, 2.0], &[0., 0., 100., 0., 0., 300.]);
    animate(&mut file, 2, "rotation", "STEP", &[0.0, 1.0], &[[0., 0., 0., 1.], quarter].concat());
    let track = file.load().unwrap().track.unwrap();
    assert_eq!(track.span_nanos(), (0, 2_000_000_000));
    for (secs, height, turned) in
        [(0.0, 1.0, 0.0), (0.5, 1.5, 0.0), (0.999_999_9, 2.0, 0.0), (1.0, 2.0, 1.0), (1.7, 2.7, 1.0)]
    {
        let pose = track.at((secs * 1e9) as i64);
        assert!((pose.root_translation - DVec3::Y * height).length() < 1e-5, "{secs} s: {}", pose.root_translation);
        let expected = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2 * turned);
        assert!(pose.joint_rotations[1].angle_between(expected) < 1e-5, "{secs} s");
    }
    // Cubic: from 0 to 1 m in 1 s with tangents 0 is 3 t^2 - 2 t^3; an out-tangent of 300 cm/s adds 3 (t^3 - 2 t^2 + t).
    for tangent in [0.0f32, 300.0] {
        let mut file = armature();
        let values = [0., 0., 0., 0., 0., 0., 0., 0., tangent, 0., 0., 0., 0., 0., 100., 0., 0., 0.];
        animate(&mut file, 1, "translation", "CUBICSPLINE", &[0.0, 1.0], &values);
        let track = file.load().unwrap().track.unwrap();
        for t in [0.0, 0.1, 0.25, 0.5, 0.77, 1.0] {
            let expected = 3.0 * t * t - 2.0 * t * t * t + f64::from(tangent) / 100.0 * (t * t * t - 2.0 * t * t + t);
            let found = track.at((t * 1e9) as i64).root_translation.y;
            assert!((found - expected).abs() < 2e-4, "{t}: {found} {expected}");
        }
    }
}

#[test]
fn moving_nodes_above_the_root_move_the_root() {
    let mut file = armature();
    animate(&mut file, 0, "translation", "LINEAR", &[0.0, 1.0], &[0., 0., 0., 3., 0., 0.]);
    let track = file.load().unwrap().track.unwrap();
    assert!((track.at(1_000_000_000).root_translation - DVec3::new(3.0, 1.0, 0.0)).length() < 1e-5);
    // A leading joint that moves no vertex itself is folded too.
    let mut file = armature();
    file.json["skins"][0]["joints"] = json!([2, 1, 0]);
    let mut binds = vec![0.0; 48];
    binds[..16].copy_from_slice(&glam::Mat4::from_translation(Vec3::new(0., 0., -150.)).to_cols_array());
    binds[16..32].copy_from_slice(&glam::Mat4::from_translation(Vec3::new(0., 0., -100.)).to_cols_array());
    let accessor = file.floats("MAT4", &binds);
    file.json["skins"][0]["inverseBindMatrices"] = json!(accessor);
    assert_eq!(file.load().unwrap().template.skeleton.joints()[0].name, "Hips");
}

#[test]
fn eight_influences_become_the_strongest_four() {
    let mut file = armature();
    let joints = file.shorts("VEC4", &[1, 1, 0, 0].repeat(6));
    let weights = file.floats("VEC4", &[0.1, 0.2, 0.3, 0.0].repeat(6));
    let bytes: Vec<u8> = [25, 76, 0, 0].repeat(6);
    let more = file.accessor(&bytes, 5121, "VEC4", 6);
    file.json["accessors"][more]["normalized"] = json!(true);
    let attributes = &mut file.json["meshes"][0]["primitives"][0]["attributes"];
    attributes["JOINTS_1"] = json!(joints);
    attributes["WEIGHTS_1"] = json!(more);
    attributes["JOINTS_0"] = json!(joints);
    attributes["WEIGHTS_0"] = json!(weights);
    let body = file.load().unwrap().template;
    // Listed joint 1 is Hips (0 in order): 0.1 + 0.2 + 101 / 255; listed 0 is Head: 0.3.
    let hips = 0.3 + 101.0 / 255.0;
    assert_eq!(body.skin[0].joints[..2], [0, 1]);
    assert!((body.skin[0].weights[0] - hips / (hips + 0.3)).abs() < 1e-5, "{:?}", body.skin[0]);
}

#[test]
fn primitives_and_meshes_are_merged_and_buffers_may_lie_outside() {
    let mut file = armature();
    let primitive = file.json["meshes"][0]["primitives"][0].clone();
    file.json["meshes"][0]["primitives"].as_array_mut().unwrap().push(primitive.clone());
    file.json["meshes"].as_array_mut().unwrap().push(json!({"primitives": [primitive]}));
    file.json["nodes"].as_array_mut().unwrap().push(json!({"mesh": 1, "skin": 0}));
    let merged = file.load().unwrap().template;
    assert_eq!((merged.positions.len(), merged.triangles.len(), merged.triangles[5]), (18, 6, [15, 16, 17]));

    let mut inside = file.clone();
    let data = base64::engine::general_purpose::STANDARD.encode(&file.bin);
    inside.json["buffers"] =
        json!([{"byteLength": file.bin.len(), "uri": format!("data:application/octet-stream;base64,{data}")}]);
    assert_eq!(load_bytes(inside.json.to_string().as_bytes(), "test.gltf").unwrap().template, { merged.clone() });
    let folder = tempfile::tempdir().unwrap();
    file.json["buffers"] = json!([{"byteLength": file.bin.len(), "uri": "the%20body.bin"}]);
    std::fs::write(folder.path().join("the body.bin"), &file.bin).unwrap();
    std::fs::write(folder.path().join("test.gltf"), file.json.to_string()).unwrap();
    assert_eq!(load_gltf(&folder.path().join("test.gltf")).unwrap().template, merged);
}

#[test]
fn odd_files_are_refused_with_a_reason() {
    let with = |change: &dyn Fn(&mut Value)| {
        let mut file = armature();
        change(&mut file.json);
        file.refused()
    };
    let expect = |error: String, words: &str| assert!(error.contains(words), "{error}");
    expect(
        with(&|json| {
            json["skins"] = json!([]);
            json["nodes"][3] = json!({"mesh": 0});
        }),
        "no skin",
    );
    expect(with(&|json| json["nodes"][3] = json!({})), "no mesh");
    expect(with(&|json| json["meshes"][0]["primitives"][0]["mode"] = json!(5)), "export triangles");
    expect(with(&|json| json["nodes"][0]["scale"] = json!([1.0, 2.0, 1.0])), "apply its scale");
    expect(with(&|json| json["nodes"][2]["children"] = json!([1])), "two parents");
    expect(
        with(&|json| {
            json["nodes"][0]["children"] = json!([3]);
            json["nodes"][2]["children"] = json!([1]);
        }),
        "circle",
    );
    expect(with(&|json| json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = json!(99)), "accessor");
    expect(with(&|json| json["accessors"][0]["count"] = json!(60)), "beyond the end");
    expect(with(&|json| json["accessors"][0]["count"] = json!(3)), "index 3");
    expect(with(&|json| json["accessors"][0]["byteOffset"] = json!(1u64 << 62)), "beyond the end");
    expect(with(&|json| json["accessors"][2]["count"] = json!(5)), "5 weight sets for 6 vertices");
    expect(with(&|json| json["accessors"][0]["type"] = json!("VEC2")), "Vec3");
    expect(with(&|json| json["skins"][0]["joints"] = json!([2])), "joint");
    expect(with(&|json| json["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"] = json!(null)), "");
    for poison in [f32::NAN, f32::INFINITY] {
        let mut file = armature();
        file.bin[4..8].copy_from_slice(&poison.to_le_bytes());
        expect(file.refused(), "item 0 of the positions of primitive 0 of mesh 0 is not a finite number");
    }
    let mut file = armature();
    animate(&mut file, 1, "translation", "LINEAR", &[0.0, 1.0], &[0.0; 6]);
    file.json["animations"][0]["channels"][0]["sampler"] = json!(7);
    expect(file.refused(), "sampler");
    let mut file = armature();
    animate(&mut file, 1, "translation", "LINEAR", &[1.0, 1.0], &[0.0; 6]);
    expect(file.refused(), "do not grow");
    let mut file = armature();
    animate(&mut file, 1, "translation", "LINEAR", &[0.0, 1.0], &[0.0; 3]);
    expect(file.refused(), "1 values for 2 keys");
    assert!(matches!(load_gltf("/nowhere/body.glb".as_ref()), Err(BodyError::Io { .. })));
}

#[test]
fn no_cut_of_a_file_panics() {
    let mut file = armature();
    animate(&mut file, 1, "translation", "LINEAR", &[0.0, 2.0], &[0., 0., 100., 0., 0., 300.]);
    let glb = file.glb();
    assert!(load_bytes(&glb, "test.glb").is_ok());
    for end in (0..glb.len()).step_by(7) {
        let error = load_bytes(&glb[..end], "test.glb").unwrap_err();
        assert!(matches!(error, BodyError::Gltf { .. }), "cut at {end}: {error}");
    }
    // Nor does any single damaged byte; most are harmless or refused.
    for at in (12..glb.len()).step_by(3) {
        let mut damaged = glb.clone();
        damaged[at] ^= 0x55;
        let _ = load_bytes(&damaged, "test.glb");
    }
}

/// Returns a skinned human of a rig with prefixes: legs down, arms along x, y up; in one second the left thigh turns by 90
/// degrees to the front and the hips go 0.2 m along z.
pub fn human(prefix: &str) -> File {
    let mut file = File::new();
    let name = |joint: &str| format!("{prefix}{joint}");
    let node = |joint: &str, at: [f64; 3], children: &[usize]| match children {
        [] => json!({"name": name(joint), "translation": at}),
        _ => json!({"name": name(joint), "translation": at, "children": children}),
    };
    file.json["nodes"] = json!([
        node("Hips", [0.0, 1.0, 0.0], &[1, 5, 9]),
        node("LeftUpLeg", [0.1, 0.0, 0.0], &[2]),
        node("LeftLeg", [0.0, -0.45, 0.0], &[3]),
        node("LeftFoot", [0.0, -0.45, 0.0], &[4]),
        node("LeftToeBase", [0.0, -0.08, 0.13], &[]),
        node("RightUpLeg", [-0.1, 0.0, 0.0], &[6]),
        node("RightLeg", [0.0, -0.45, 0.0], &[7]),
        node("RightFoot", [0.0, -0.45, 0.0], &[8]),
        node("RightToeBase", [0.0, -0.08, 0.13], &[]),
        node("Spine", [0.0, 0.4, 0.0], &[10]),
        node("LeftArm", [0.2, 0.1, 0.0], &[11]),
        node("LeftForeArm", [0.3, 0.0, 0.0], &[]),
        json!({"name": "Body", "mesh": 0, "skin": 0}),
    ]);
    file.json["scenes"] = json!([{"nodes": [0, 12]}]);
    let positions = file.floats("VEC3", &[0., 1., 0., 0.1, 1., 0., 0., 1.1, 0.]);
    let joints = file.shorts("VEC4", &[0; 12]);
    let weights = file.floats("VEC4", &[1., 0., 0., 0.].repeat(3));
    let indices = file.shorts("SCALAR", &[0, 1, 2]);
    let places: [[f32; 3]; 12] = [
        [0.0, 1.0, 0.0],
        [0.1, 1.0, 0.0],
        [0.1, 0.55, 0.0],
        [0.1, 0.1, 0.0],
        [0.1, 0.02, 0.13],
        [-0.1, 1.0, 0.0],
        [-0.1, 0.55, 0.0],
        [-0.1, 0.1, 0.0],
        [-0.1, 0.02, 0.13],
        [0.0, 1.4, 0.0],
        [0.2, 1.5, 0.0],
        [0.5, 1.5, 0.0],
    ];
    let binds: Vec<f32> =
        places.iter().flat_map(|p| glam::Mat4::from_translation(-Vec3::from(*p)).to_cols_array()).collect();
    let binds = file.floats("MAT4", &binds);
    file.json["skins"] = json!([{"joints": (0..12).collect::<Vec<_>>(), "inverseBindMatrices": binds}]);
    let attributes = json!({"POSITION": positions, "JOINTS_0": joints, "WEIGHTS_0": weights});
    file.json["meshes"] = json!([{"primitives": [{"attributes": attributes, "indices": indices}]}]);
    let times = file.floats("SCALAR", &[0.0, 1.0]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let turns = file.floats("VEC4", &[0., 0., 0., 1., -half, 0., 0., half]);
    let ways = file.floats("VEC3", &[0., 1., 0., 0., 1., 0.2]);
    file.json["animations"] = json!([{
        "samplers": [{"input": times, "output": turns}, {"input": times, "output": ways}],
        "channels": [
            {"sampler": 0, "target": {"node": 1, "path": "rotation"}},
            {"sampler": 1, "target": {"node": 0, "path": "translation"}},
        ],
    }]);
    file
}

#[test]
fn a_rigs_motion_arrives_on_our_body() {
    let body = flyrig_body::default_template(&flyrig_body::ShapeParams::woman()).unwrap();
    let skeleton = &body.skeleton;
    for prefix in ["mixamorig:", "", "MyRig:mixamorig:"] {
        let motion = human(prefix).load().unwrap().motion().unwrap();
        let track = motion.retarget(&body, &flyrig_body::RetargetOptions::default()).unwrap();
        let world = |nanos: i64| skeleton.world_from_joint(&track.at(nanos));
        let place = |nanos: i64, name: &str| world(nanos)[skeleton.joint(name).unwrap()].w_axis.truncate();
        let bone = |nanos: i64, from: &str, to: &str| (place(nanos, to) - place(nanos, from)).normalize();
        let near = |a: DVec3, b: DVec3| assert!((a - b).length() < 0.15, "{prefix}: {a} is not {b}");
        assert_eq!(track.span_nanos(), (0, 1_000_000_000));
        near(bone(0, "LeftUpLeg", "LeftLeg"), DVec3::NEG_Z);
        near(bone(0, "LeftArm", "LeftForeArm"), DVec3::X);
        // A body that faces +z of the file faces -y.
        near(bone(1_000_000_000, "LeftUpLeg", "LeftLeg"), DVec3::NEG_Y);
        near(bone(1_000_000_000, "RightUpLeg", "RightLeg"), DVec3::NEG_Z);
        let way = place(1_000_000_000, "Hips") - place(0, "Hips");
        assert!(way.y < -0.1 && way.x.abs() < 0.02, "{way}");
    }
    let mut unknown = human("");
    for (number, node) in unknown.json["nodes"].as_array_mut().unwrap().iter_mut().enumerate() {
        node["name"] = json!(format!("bone {number}"));
    }
    let unknown = unknown.load().unwrap().motion().unwrap();
    let error = unknown.retarget(&body, &flyrig_body::RetargetOptions::default()).unwrap_err().to_string();
    assert!(error.contains("'LeftUpLeg', 'LeftLeg', 'LeftFoot', 'RightUpLeg'"), "{error}");
    let mut still = human("");
    still.json.as_object_mut().unwrap().remove("animations");
    assert!(still.load().unwrap().motion().unwrap_err().to_string().contains("no animation"));
}

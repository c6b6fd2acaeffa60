//! External buffers and sizes of glTF files.

use flyrig_body::{BodyError, GltfHuman, load_gltf};
use serde_json::{Value, json};

use crate::file::{File, animate, armature, load_bytes};

/// Loads a `.gltf` whose only buffer is `uri`, from a folder of its own in which `prepare` puts further files.
fn load_with_buffer(uri: &str, prepare: impl Fn(&std::path::Path, &[u8])) -> Result<GltfHuman, BodyError> {
    let outer = tempfile::tempdir().unwrap();
    let folder = outer.path().join("body");
    std::fs::create_dir_all(folder.join("data")).unwrap();
    let mut file = armature();
    file.json["buffers"] = json!([{"byteLength": file.bin.len(), "uri": uri}]);
    std::fs::write(outer.path().join("secret.bin"), &file.bin).unwrap();
    prepare(&folder, &file.bin);
    std::fs::write(folder.join("test.gltf"), file.json.to_string()).unwrap();
    load_gltf(&folder.join("test.gltf"))
}

#[test]
fn buffers_lie_in_the_folder_of_their_file() {
    let beside = |folder: &std::path::Path, bin: &[u8]| {
        for name in ["own.bin", "data/own.bin", "a%b ü.bin"] {
            std::fs::write(folder.join(name), bin).unwrap();
        }
    };
    for good in ["own.bin", "./own.bin", "data/own.bin", "data/../own.bin", "a%25b%20%C3%BC.bin"] {
        assert!(load_with_buffer(good, beside).is_ok(), "{good}");
    }
    for (bad, words) in [
        ("../secret.bin", "outside the folder"),
        ("data/../../secret.bin", "outside the folder"),
        ("%2e%2e/secret.bin", "outside the folder"),
        ("..%2Fsecret.bin", "outside the folder"),
        ("/etc/hostname", "not a relative path"),
        ("%2Fetc/hostname", "not a relative path"),
        ("//host/share.bin", "not a relative path"),
        ("\\\\host\\share.bin", "not a relative path"),
        ("http://127.0.0.1/own.bin", "scheme"),
        ("file:own.bin", "scheme"),
        ("FILE:///etc/hostname", "scheme"),
        ("C:\\own.bin", "scheme or a drive"),
        ("data:,own", "scheme"),
        ("own.bin%00", "not a relative path"),
        ("100%.bin", "percent-encoded"),
        ("%ff.bin", "percent-encoded"),
        ("data", "not a regular file"),
    ] {
        let error = load_with_buffer(bad, beside).unwrap_err();
        assert!(matches!(error, BodyError::Gltf { .. }) && error.to_string().contains(words), "{bad}: {error}");
    }
    assert!(matches!(load_with_buffer("absent.bin", beside), Err(BodyError::Io { .. })));
}

#[cfg(unix)]
#[test]
fn symbolic_links_do_not_lead_out_of_the_folder() {
    use std::os::unix::fs::symlink;
    let linked = |folder: &std::path::Path, bin: &[u8]| {
        std::fs::write(folder.join("own.bin"), bin).unwrap();
        symlink("own.bin", folder.join("inner.bin")).unwrap();
        symlink("../secret.bin", folder.join("outer.bin")).unwrap();
        symlink("..", folder.join("up")).unwrap();
    };
    assert!(load_with_buffer("inner.bin", linked).is_ok());
    for bad in ["outer.bin", "up/secret.bin"] {
        let error = load_with_buffer(bad, linked).unwrap_err().to_string();
        assert!(error.contains("by a symbolic link") && error.contains(bad), "{error}");
    }
    // A pipe without a writer would be waited for.
    let pipe = |folder: &std::path::Path, _: &[u8]| {
        assert!(std::process::Command::new("mkfifo").arg(folder.join("pipe")).status().unwrap().success());
    };
    assert!(load_with_buffer("pipe", pipe).unwrap_err().to_string().contains("not a regular file"));
}

#[test]
fn sizes_of_files_are_checked_before_they_are_read() {
    const GIB: u64 = 1 << 30;
    let folder = tempfile::tempdir().unwrap();
    // Sparse files: they claim gigabytes and hold nothing.
    let claim = |name: &str, bytes: u64| {
        let path = folder.path().join(name);
        std::fs::File::create(&path).unwrap().set_len(bytes).unwrap();
        path
    };
    let error = load_gltf(&claim("huge.glb", 3 * GIB)).unwrap_err().to_string();
    assert!(error.contains("huge.glb: 3221225472 bytes, at most 1073741824 are read"), "{error}");
    claim("most.bin", GIB - 1);
    claim("rest.bin", 2);
    let mut file = armature();
    let path = folder.path().join("test.gltf");
    let mut refused = |buffers: Value| {
        file.json["buffers"] = buffers;
        std::fs::write(&path, file.json.to_string()).unwrap();
        load_gltf(&path).unwrap_err().to_string()
    };
    let error = refused(json!([{"byteLength": 1, "uri": "most.bin"}, {"byteLength": 1, "uri": "rest.bin"}]));
    assert!(error.contains("bytes of all buffers up to buffer 1: 1073741825, at most 1073741824"), "{error}");
    let error = refused(json!([{"byteLength": 1, "uri": "rest.bin"}, {"byteLength": 1, "uri": "most.bin"}]));
    assert!(error.contains("up to buffer 1: 1073741825"), "{error}");
}

#[test]
fn small_files_cannot_ask_for_large_memory() {
    let expect = |file: &File, words: &str| {
        assert!(file.glb().len() < 8 << 20, "{} bytes", file.glb().len());
        let error = file.refused();
        assert!(error.contains("test.glb: ") && error.contains(words), "{error}");
    };
    // 10,000 nodes above the root and a cubic curve of 1000 keys, 10 s apart: a million poses, 1.3 TB of matrices.
    let mut file = armature();
    let nodes = file.json["nodes"].as_array_mut().unwrap();
    for index in 4..10_004 {
        nodes.push(json!({"children": [if index == 4 { 0 } else { index - 1 }]}));
    }
    let times: Vec<f32> = (0..1000).map(|key| key as f32 * 10.0).collect();
    animate(&mut file, 1, "translation", "CUBICSPLINE", &times, &vec![0.0; 9000]);
    expect(&file, "poses of an animation of 10003 nodes: 999001, at most 838 are allowed");

    // The same for nodes: each costs half a kilobyte and a matrix a pose.
    let mut file = armature();
    let nodes = file.json["nodes"].as_array_mut().unwrap();
    nodes.resize(16_385, json!({}));
    expect(&file, "nodes: 16385, at most 16384");
    file.json["nodes"].as_array_mut().unwrap().truncate(16_384);
    assert!(file.load().is_ok());
    let text = format!(r#"{{"asset":{{"version":"2.0"}},"nodes":[{}{{}}]}}"#, "{},".repeat(1 << 20));
    let error = load_bytes(text.as_bytes(), "test.gltf").unwrap_err().to_string();
    assert!(error.contains("entries of the JSON part: 2097157, at most 1048576"), "{error}");

    // Primitives that share one mesh of 70,000 vertices.
    let mut file = armature();
    let count = 70_000;
    let primitive = {
        let positions = file.floats("VEC3", &vec![0.0; 3 * count]);
        let joints = file.accessor(&vec![0; 4 * count], 5121, "VEC4", count);
        let weights = file.accessor(&vec![255; 4 * count], 5121, "VEC4", count);
        json!({"attributes": {"POSITION": positions, "JOINTS_0": joints, "WEIGHTS_0": weights}})
    };
    file.json["meshes"] = json!([{"primitives": vec![primitive.clone(); 30]}]);
    expect(&file, "vertices up to primitive 29 of mesh 0: 2100000, at most 2097152");
    // The same by nodes that share the mesh.
    file.json["meshes"] = json!([{"primitives": [primitive.clone()]}]);
    file.json["nodes"].as_array_mut().unwrap().extend(vec![json!({"mesh": 0, "skin": 0}); 30]);
    expect(&file, "vertices up to primitive 0 of mesh 0: 2100000");
    // Triangles of the same three vertices.
    file.json["nodes"].as_array_mut().unwrap().truncate(4);
    let indices = file.accessor(&vec![0; 600_000], 5121, "SCALAR", 600_000);
    let mut cornered = primitive.clone();
    cornered["indices"] = json!(indices);
    let few = armature().json["meshes"][0]["primitives"][0]["attributes"].clone();
    cornered["attributes"] = few;
    file.json["meshes"] = json!([{"primitives": vec![cornered; 21]}]);
    expect(&file, "triangle corners up to primitive 20 of mesh 0: 12600000, at most 12582912");
    // Sets of joints without end.
    let mut file = armature();
    let attributes = file.json["meshes"][0]["primitives"][0]["attributes"].clone();
    for set in 1..5 {
        for name in ["JOINTS", "WEIGHTS"] {
            file.json["meshes"][0]["primitives"][0]["attributes"][format!("{name}_{set}")] =
                attributes[format!("{name}_0")].clone();
        }
    }
    expect(&file, "sets of joints of primitive 0 of mesh 0: 5, at most 4");
    let mut file = armature();
    file.json["skins"][0]["joints"] = json!(vec![1; 1025]);
    expect(&file, "joints of the skin: 1025, at most 1024");
}

#[test]
fn animation_keys_are_bounded_over_all_channels() {
    // 300,000 keys, shared by the three properties of ten nodes above the root.
    let mut file = armature();
    let nodes = file.json["nodes"].as_array_mut().unwrap();
    for index in 4..14 {
        nodes.push(json!({"children": [if index == 4 { 0 } else { index - 1 }]}));
    }
    let keys = 300_000u32;
    let times: Vec<f32> = (0..keys).map(|key| key as f32).collect();
    animate(&mut file, 4, "translation", "LINEAR", &times, &vec![0.0; 3 * keys as usize]);
    for node in 4..14 {
        for path in ["translation", "scale", "rotation"] {
            if (node, path) != (4, "translation") {
                let channel = json!({"sampler": 0, "target": {"node": node, "path": path}});
                file.json["animations"][0]["channels"].as_array_mut().unwrap().push(channel);
            }
        }
    }
    let error = file.refused();
    assert!(error.contains("keys up to animation channel 27: 8400000, at most 8388608"), "{error}");
    // Two channels of one property would multiply the keys without end.
    file.json["animations"][0]["channels"].as_array_mut().unwrap().truncate(1);
    let again = file.json["animations"][0]["channels"][0].clone();
    file.json["animations"][0]["channels"].as_array_mut().unwrap().push(again);
    assert!(file.refused().contains("animation channel 1 moves the same property of node 4"), "{}", file.refused());
    // Times at which nanoseconds would overflow.
    for secs in [3e6, 1e30] {
        let mut file = armature();
        animate(&mut file, 1, "translation", "CUBICSPLINE", &[-secs, secs], &[0.0; 18]);
        assert!(file.refused().contains("s, at most 1000000 s are allowed"), "{}", file.refused());
    }
    // What moves elsewhere costs nothing.
    let mut file = armature();
    file.json["nodes"].as_array_mut().unwrap().push(json!({}));
    animate(&mut file, 4, "translation", "LINEAR", &[0.0, 1.0], &[0.0; 6]);
    assert!(file.load().unwrap().track.is_none());
}

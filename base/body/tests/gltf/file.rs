//! Construction of glTF files.

use std::path::PathBuf;

use flyrig_body::{BodyError, GltfHuman, load_gltf};
use glam::Vec3;
use serde_json::{Value, json};

/// glTF document with its binary buffer.
#[derive(Clone)]
pub struct File {
    pub json: Value,
    pub bin: Vec<u8>,
}

impl File {
    pub fn new() -> Self {
        let json = json!({
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
            "nodes": [], "meshes": [], "skins": [], "bufferViews": [], "accessors": [],
        });
        Self { json, bin: Vec::new() }
    }

    pub fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let view = json!({"buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len()});
        self.bin.extend(bytes);
        let views = self.json["bufferViews"].as_array_mut().unwrap();
        views.push(view);
        let mut accessor =
            json!({"bufferView": views.len() - 1, "componentType": component, "type": kind, "count": count});
        if kind == "VEC3" || kind == "SCALAR" {
            let n = if kind == "VEC3" { 3 } else { 1 };
            accessor["min"] = json!(vec![0.0; n]);
            accessor["max"] = json!(vec![0.0; n]);
        }
        let accessors = self.json["accessors"].as_array_mut().unwrap();
        accessors.push(accessor);
        accessors.len() - 1
    }

    pub fn floats(&mut self, kind: &str, numbers: &[f32]) -> usize {
        let width = [("SCALAR", 1), ("VEC2", 2), ("VEC3", 3), ("VEC4", 4), ("MAT4", 16)]
            .iter()
            .find(|k| k.0 == kind)
            .unwrap()
            .1;
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.accessor(&bytes, 5126, kind, numbers.len() / width)
    }

    pub fn shorts(&mut self, kind: &str, numbers: &[u16]) -> usize {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.accessor(&bytes, 5123, kind, numbers.len() / if kind == "SCALAR" { 1 } else { 4 })
    }

    pub fn glb(&self) -> Vec<u8> {
        let mut json = self.json.clone();
        json["buffers"] = json!([{"byteLength": self.bin.len()}]);
        let mut text = json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut bin = self.bin.clone();
        bin.resize(bin.len().next_multiple_of(4), 0);
        let total = 12 + 8 + text.len() + 8 + bin.len();
        let mut file = Vec::new();
        file.extend(b"glTF");
        for number in [2, total as u32, text.len() as u32] {
            file.extend(number.to_le_bytes());
        }
        file.extend(b"JSON");
        file.extend(text);
        file.extend((bin.len() as u32).to_le_bytes());
        file.extend(b"BIN\0");
        file.extend(bin);
        file
    }

    pub fn load(&self) -> Result<GltfHuman, BodyError> {
        load_bytes(&self.glb(), "test.glb")
    }

    pub fn refused(&self) -> String {
        self.load().unwrap_err().to_string()
    }
}

pub fn load_bytes(bytes: &[u8], name: &str) -> Result<GltfHuman, BodyError> {
    let folder = tempfile::tempdir().unwrap();
    let path: PathBuf = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    load_gltf(&path)
}

/// Returns an armature as Blender writes it: centimetres, turned by -90 degrees about x above the joints, z up in the
/// mesh. The root "Hips" moves a triangle at 100 cm, "Head" one at 200 cm; joints are listed child first.
pub fn armature() -> File {
    let mut file = File::new();
    let half = std::f32::consts::FRAC_1_SQRT_2;
    file.json["nodes"] = json!([
        {"name": "Armature", "rotation": [-half, 0.0, 0.0, half], "scale": [0.01, 0.01, 0.01], "children": [1, 3]},
        {"name": "Hips", "translation": [0.0, 0.0, 100.0], "children": [2]},
        {"name": "Head", "translation": [0.0, 0.0, 50.0]},
        {"name": "Body", "mesh": 0, "skin": 0, "translation": [7.0, 7.0, 7.0]},
    ]);
    let positions =
        file.floats("VEC3", &[0., 0., 100., 10., 0., 100., 0., 0., 110., 0., 0., 200., 10., 0., 200., 0., 0., 210.]);
    let joints =
        file.shorts("VEC4", &[1, 0, 0, 0].repeat(3).into_iter().chain([0, 0, 0, 0].repeat(3)).collect::<Vec<u16>>());
    let weights = file.floats("VEC4", &[1., 0., 0., 0.].repeat(6));
    let indices = file.shorts("SCALAR", &[0, 1, 2, 3, 4, 5]);
    let mut head = glam::Mat4::from_translation(Vec3::new(0., 0., -150.)).to_cols_array().to_vec();
    head.extend(glam::Mat4::from_translation(Vec3::new(0., 0., -100.)).to_cols_array());
    let binds = file.floats("MAT4", &head);
    file.json["skins"] = json!([{"joints": [2, 1], "inverseBindMatrices": binds}]);
    let attributes = json!({"POSITION": positions, "JOINTS_0": joints, "WEIGHTS_0": weights});
    file.json["meshes"] = json!([{"primitives": [{"attributes": attributes, "indices": indices}]}]);
    file
}

pub fn animate(file: &mut File, node: usize, path: &str, interpolation: &str, times: &[f32], values: &[f32]) {
    let input = file.floats("SCALAR", times);
    let output = file.floats(if path == "rotation" { "VEC4" } else { "VEC3" }, values);
    if file.json["animations"].is_null() {
        file.json["animations"] = json!([{"channels": [], "samplers": []}]);
    }
    let animation = &mut file.json["animations"][0];
    let sampler = animation["samplers"].as_array().unwrap().len();
    animation["samplers"]
        .as_array_mut()
        .unwrap()
        .push(json!({"input": input, "output": output, "interpolation": interpolation}));
    animation["channels"]
        .as_array_mut()
        .unwrap()
        .push(json!({"sampler": sampler, "target": {"node": node, "path": path}}));
}

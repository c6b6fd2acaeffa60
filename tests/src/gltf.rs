//! A minimal binary glTF writer: one skinned mesh with one animation.

use std::path::Path;

use anyhow::{Context, Result};
use flyrig_body::Template;
use flyrig_types::PoseTrack;
use serde_json::{Value, json};

/// Collects typed data into one buffer with a view and an accessor each.
#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Buffer {
    fn add(&mut self, data: &[u8], component: u32, kind: &str, count: usize, bounds: Option<(Value, Value)>) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": data.len() }));
        self.bytes.extend_from_slice(data);
        let mut accessor =
            json!({ "bufferView": self.views.len() - 1, "componentType": component, "count": count, "type": kind });
        if let Some((min, max)) = bounds {
            accessor["min"] = min;
            accessor["max"] = max;
        }
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn floats(&mut self, data: &[f32], kind: &str, width: usize) -> usize {
        let bounds = (kind == "SCALAR").then(|| {
            let low = data.iter().copied().fold(f32::INFINITY, f32::min);
            let high = data.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            (json!([low]), json!([high]))
        });
        self.add(bytemuck::cast_slice(data), 5126, kind, data.len() / width, bounds)
    }
}

/// Writes a template with its motion; times are those of the track.
///
/// # Errors
/// When the file cannot be written.
pub fn write_glb(path: &Path, template: &Template, track: &PoseTrack) -> Result<()> {
    let mut buffer = Buffer::default();
    let low = template.positions.iter().fold(glam::Vec3::INFINITY, |a, b| a.min(*b));
    let high = template.positions.iter().fold(glam::Vec3::NEG_INFINITY, |a, b| a.max(*b));
    let positions = buffer.add(
        bytemuck::cast_slice(&template.positions),
        5126,
        "VEC3",
        template.positions.len(),
        Some((json!(low.to_array()), json!(high.to_array()))),
    );
    let normals = buffer.floats(bytemuck::cast_slice(&template.normals), "VEC3", 3);
    let uvs = buffer.floats(bytemuck::cast_slice(&template.uvs), "VEC2", 2);
    let joints: Vec<[u16; 4]> = template.skin.iter().map(|s| s.joints).collect();
    let weights: Vec<f32> = template.skin.iter().flat_map(|s| s.weights).collect();
    let joints = buffer.add(bytemuck::cast_slice(&joints), 5123, "VEC4", joints.len(), None);
    let weights = buffer.floats(&weights, "VEC4", 4);
    let triangles: &[u32] = bytemuck::cast_slice(&template.triangles);
    let indices = buffer.add(bytemuck::cast_slice(triangles), 5125, "SCALAR", triangles.len(), None);
    let bones = template.skeleton.joints();
    let inverse: Vec<f32> = bones.iter().flat_map(|j| j.joint_from_canonical.as_mat4().to_cols_array()).collect();
    let inverse = buffer.floats(&inverse, "MAT4", 16);

    let times: Vec<f32> = track.keys().iter().map(|(nanos, _)| (*nanos as f64 * 1e-9) as f32).collect();
    let times = buffer.floats(&times, "SCALAR", 1);
    let mut samplers = Vec::new();
    let mut channels = Vec::new();
    let mut channel = |node: usize, what: &str, output: usize| {
        samplers.push(json!({ "input": times, "output": output }));
        channels.push(json!({ "sampler": samplers.len() - 1, "target": { "node": node, "path": what } }));
    };
    let root: Vec<f32> = track.keys().iter().flat_map(|(_, pose)| pose.root_translation.as_vec3().to_array()).collect();
    channel(0, "translation", buffer.floats(&root, "VEC3", 3));
    for joint in 0..bones.len() {
        let turns: Vec<f32> =
            track.keys().iter().flat_map(|(_, pose)| pose.joint_rotations[joint].as_quat().to_array()).collect();
        channel(joint, "rotation", buffer.floats(&turns, "VEC4", 4));
    }

    let mut nodes: Vec<Value> = bones
        .iter()
        .enumerate()
        .map(|(i, joint)| {
            let children: Vec<usize> = (0..bones.len()).filter(|child| bones[*child].parent == Some(i)).collect();
            let mut node = json!({
                "name": joint.name,
                "translation": joint.rest_translation.as_vec3().to_array(),
                "rotation": joint.rest_rotation.as_quat().to_array(),
            });
            if !children.is_empty() {
                node["children"] = json!(children);
            }
            node
        })
        .collect();
    nodes.push(json!({ "name": "body", "mesh": 0, "skin": 0 }));
    let document = json!({
        "asset": { "version": "2.0" },
        "scene": 0,
        "scenes": [{ "nodes": [0, bones.len()] }],
        "nodes": nodes,
        "meshes": [{ "primitives": [{
            "attributes": { "POSITION": positions, "NORMAL": normals, "TEXCOORD_0": uvs, "JOINTS_0": joints, "WEIGHTS_0": weights },
            "indices": indices,
        }] }],
        "skins": [{ "joints": (0..bones.len()).collect::<Vec<_>>(), "inverseBindMatrices": inverse, "skeleton": 0 }],
        "animations": [{ "samplers": samplers, "channels": channels }],
        "buffers": [{ "byteLength": buffer.bytes.len() }],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
    });
    let mut text = serde_json::to_vec(&document)?;
    text.resize(text.len().next_multiple_of(4), b' ');
    buffer.bytes.resize(buffer.bytes.len().next_multiple_of(4), 0);
    let total = 12 + 8 + text.len() + 8 + buffer.bytes.len();
    let mut file = Vec::with_capacity(total);
    file.extend(b"glTF");
    file.extend(2u32.to_le_bytes());
    file.extend((total as u32).to_le_bytes());
    file.extend((text.len() as u32).to_le_bytes());
    file.extend(b"JSON");
    file.extend(&text);
    file.extend((buffer.bytes.len() as u32).to_le_bytes());
    file.extend(b"BIN\0");
    file.extend(&buffer.bytes);
    std::fs::write(path, file).with_context(|| format!("writing {}", path.display()))
}

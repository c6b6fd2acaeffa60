//! A template with its motion as binary glTF.

use std::io::Write as _;
use std::path::Path;

use flyrig_types::{PoseTrack, write_whole};
use serde_json::{Value, json};

use crate::{BodyError, Template};

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

/// Writes a skinned mesh with one animation, as [`crate::load_gltf`] reads it: times and world axes are those of the
/// track. The file appears whole or not at all.
///
/// # Errors
/// [`BodyError::Unwritten`] when the poses do not fit the skeleton, the file would be larger than the format allows,
/// or the system refuses.
pub fn write_glb(path: &Path, template: &Template, track: &PoseTrack) -> Result<(), BodyError> {
    let unwritten = |message| BodyError::Unwritten { path: path.to_owned(), message };
    let joints = template.skeleton.joints().len();
    if let Some((_, pose)) = track.keys().iter().find(|(_, pose)| pose.joint_rotations.len() != joints) {
        let found = pose.joint_rotations.len();
        return Err(unwritten(format!("a pose of {found} joints does not fit the skeleton's {joints}")));
    }
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
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    buffer.bytes.resize(buffer.bytes.len().next_multiple_of(4), 0);
    let length =
        |bytes: usize| u32::try_from(bytes).map_err(|_| unwritten("4 GiB are the most it can hold".to_owned()));
    let total = length(12 + 8 + text.len() + 8 + buffer.bytes.len())?;
    let [text_length, bytes_length] = [length(text.len())?, length(buffer.bytes.len())?];
    write_whole(path, |out| {
        out.write_all(b"glTF")?;
        for word in [2, total, text_length] {
            out.write_all(&word.to_le_bytes())?;
        }
        out.write_all(b"JSON")?;
        out.write_all(&text)?;
        out.write_all(&bytes_length.to_le_bytes())?;
        out.write_all(b"BIN\0")?;
        out.write_all(&buffer.bytes)
    })
    .map_err(|source| unwritten(source.to_string()))
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Pose, PoseTrack};
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::{ShapeParams, default_template, load_gltf, skin_mesh};

    #[test]
    fn what_is_written_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("body.glb");
        let template = default_template(&ShapeParams::default()).unwrap();
        let pose = |turn: f64| {
            let mut pose = template.skeleton.rest_pose();
            pose.root_translation = DVec3::new(turn, 0.2, 0.9);
            pose.joint_rotations[3] *= DQuat::from_rotation_x(turn);
            pose
        };
        let track = PoseTrack::new(vec![(0, pose(0.0)), (500_000_000, pose(0.7))]).unwrap();
        write_glb(&path, &template, &track).unwrap();
        let human = load_gltf(&path).unwrap();
        assert_eq!(human.template.triangles, template.triangles);
        for (a, b) in human.template.positions.iter().zip(&template.positions) {
            assert!(a.distance(*b) < 1e-6);
        }
        let read = human.track.unwrap();
        assert_eq!(read.span_nanos(), track.span_nanos());
        for nanos in [0, 200_000_000, 500_000_000] {
            // The importer may order the joints in its own way; the surface tells.
            let (a, _) = skin_mesh(&human.template, &read.at(nanos));
            let (b, _) = skin_mesh(&template, &track.at(nanos));
            for (a, b) in a.iter().zip(&b) {
                assert!(a.distance(*b) < 1e-5, "{nanos}: {a} {b}");
            }
        }
        // A pose of another body.
        let single = Pose { root_translation: DVec3::ZERO, joint_rotations: vec![DQuat::IDENTITY] };
        let other = PoseTrack::new(vec![(0, single)]).unwrap();
        let refused = write_glb(&path, &template, &other).unwrap_err().to_string();
        assert!(refused.contains("a pose of 1 joints does not fit"), "{refused}");
    }
}

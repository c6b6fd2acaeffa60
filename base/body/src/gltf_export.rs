//! Export of a template with motion and texture as binary glTF.

use std::path::Path;

use flyrig_types::PoseTrack;
use serde_json::{Value, json};

use crate::{BodyError, GlbWriter, Template};

/// Optional content of a glTF file beside the skinned mesh.
#[derive(Debug, Clone, Copy, Default)]
pub struct GlbContents<'a> {
    /// Motion, written as one animation with the track's times and world axes.
    pub track: Option<&'a PoseTrack>,
    /// Texture as a PNG file.
    pub texture: Option<&'a [u8]>,
    /// Whether other programs light the texture; otherwise it contains the lighting.
    pub is_lit: bool,
}

/// Writes a skinned mesh atomically, in the form that [`crate::load_gltf`] reads.
///
/// # Errors
/// [`BodyError::Unwritten`] when the poses do not fit the skeleton, the file would be larger than the format allows,
/// or the system fails.
pub fn write_glb(path: &Path, template: &Template, contents: GlbContents<'_>) -> Result<(), BodyError> {
    let bones = template.skeleton.joints();
    let keys = contents.track.map(PoseTrack::keys).unwrap_or_default();
    if let Some((_, pose)) = keys.iter().find(|(_, pose)| pose.joint_rotations.len() != bones.len()) {
        let found = pose.joint_rotations.len();
        let message = format!("a pose of {found} joints does not fit the skeleton's {}", bones.len());
        return Err(BodyError::Unwritten { path: path.to_owned(), message });
    }
    let mut glb = GlbWriter::default();
    let positions = glb.positions(&template.positions);
    let normals = glb.floats(bytemuck::cast_slice(&template.normals), "VEC3", 3);
    let uvs = glb.floats(bytemuck::cast_slice(&template.uvs), "VEC2", 2);
    let joints: Vec<[u16; 4]> = template.skin.iter().map(|s| s.joints).collect();
    let weights: Vec<f32> = template.skin.iter().flat_map(|s| s.weights).collect();
    let joints = glb.shorts(bytemuck::cast_slice(&joints), "VEC4", 4);
    let weights = glb.floats(&weights, "VEC4", 4);
    let indices = glb.indices(bytemuck::cast_slice(&template.triangles));
    let inverse: Vec<f32> = bones.iter().flat_map(|j| j.joint_from_canonical.as_mat4().to_cols_array()).collect();
    let inverse = glb.floats(&inverse, "MAT4", 16);
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
    let mut primitive = json!({
        "attributes": { "POSITION": positions, "NORMAL": normals, "TEXCOORD_0": uvs, "JOINTS_0": joints, "WEIGHTS_0": weights },
        "indices": indices,
    });
    let mut document = json!({
        "scene": 0,
        "scenes": [{ "nodes": [0, bones.len()] }],
        "nodes": nodes,
        "skins": [{ "joints": (0..bones.len()).collect::<Vec<_>>(), "inverseBindMatrices": inverse, "skeleton": 0 }],
    });
    if !keys.is_empty() {
        document["animations"] = json!([animation(&mut glb, keys, bones.len())]);
    }
    if let Some(png) = contents.texture {
        primitive["material"] = json!(0);
        glb.material(&mut document, png, contents.is_lit);
    }
    document["meshes"] = json!([{ "primitives": [primitive] }]);
    glb.write(path, document)
}

fn animation(glb: &mut GlbWriter, keys: &[(i64, flyrig_types::Pose)], joints: usize) -> Value {
    let times = key_times(keys.iter().map(|(nanos, _)| *nanos));
    let times = glb.floats(&times, "SCALAR", 1);
    let (mut samplers, mut channels) = (Vec::new(), Vec::new());
    let mut channel = |node: usize, what: &str, output: usize| {
        samplers.push(json!({ "input": times, "output": output }));
        channels.push(json!({ "sampler": samplers.len() - 1, "target": { "node": node, "path": what } }));
    };
    let root: Vec<f32> = keys.iter().flat_map(|(_, pose)| pose.root_translation.as_vec3().to_array()).collect();
    channel(0, "translation", glb.floats(&root, "VEC3", 3));
    for joint in 0..joints {
        let turns: Vec<f32> =
            keys.iter().flat_map(|(_, pose)| pose.joint_rotations[joint].as_quat().to_array()).collect();
        channel(joint, "rotation", glb.floats(&turns, "VEC4", 4));
    }
    json!({ "samplers": samplers, "channels": channels })
}

/// Returns key times in seconds. Of times that single precision cannot tell apart, the earlier ones move back, so that all grow: a motion
/// that repeats jumps within a nanosecond.
fn key_times(nanos: impl Iterator<Item = i64>) -> Vec<f32> {
    let mut times: Vec<f32> = nanos.map(|nanos| (nanos as f64 * 1e-9) as f32).collect();
    let mut next = f32::INFINITY;
    for time in times.iter_mut().rev() {
        *time = time.min(next.next_down());
        next = *time;
    }
    times
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
        write_glb(&path, &template, GlbContents { track: Some(&track), ..GlbContents::default() }).unwrap();
        let human = load_gltf(&path).unwrap();
        assert_eq!(human.template.triangles, template.triangles);
        for (a, b) in human.template.positions.iter().zip(&template.positions) {
            assert!(a.distance(*b) < 1e-6);
        }
        let read = human.track.unwrap();
        assert_eq!(read.span_nanos(), track.span_nanos());
        for nanos in [0, 200_000_000, 500_000_000] {
            // The importer may reorder the joints, so the surfaces are compared.
            let (a, _) = skin_mesh(&human.template, &read.at(nanos));
            let (b, _) = skin_mesh(&template, &track.at(nanos));
            for (a, b) in a.iter().zip(&b) {
                assert!(a.distance(*b) < 1e-5, "{nanos}: {a} {b}");
            }
        }
        // A motion that repeats for minutes.
        let long = track.repeated_until(300_000_000_000);
        write_glb(&path, &template, GlbContents { track: Some(&long), ..GlbContents::default() }).unwrap();
        let read = load_gltf(&path).unwrap().track.unwrap();
        assert_eq!((read.keys().len(), read.span_nanos()), (long.keys().len(), long.span_nanos()));
        let (a, _) = skin_mesh(&human.template, &read.at(299_500_000_000));
        let (b, _) = skin_mesh(&template, &track.at(0));
        assert!(a.iter().zip(&b).all(|(a, b)| a.distance(*b) < 1e-4), "the later of two keys keeps its time");
        // A pose of another body.
        let single = Pose { root_translation: DVec3::ZERO, joint_rotations: vec![DQuat::IDENTITY] };
        let other = PoseTrack::new(vec![(0, single)]).unwrap();
        let refused = write_glb(&path, &template, GlbContents { track: Some(&other), ..GlbContents::default() })
            .unwrap_err()
            .to_string();
        assert!(refused.contains("a pose of 1 joints does not fit"), "{refused}");
    }
}

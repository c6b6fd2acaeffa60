//! Motion of glTF files that hold no body: skeletons exported without a skin.

use std::path::Path;

use glam::{DMat4, DQuat};

use crate::gltf_file::GltfFile;
use crate::gltf_import::joint_name;
use crate::gltf_limits::MAX_JOINTS;
use crate::gltf_nodes::Nodes;
use crate::motion_clip::{MotionClip, Moved};
use crate::{BodyError, load_gltf};

/// Reads the first animation that moves from a `.glb` or `.gltf` file as a motion for retargeting. Its rest pose is the bind pose of the
/// body, or that of the nodes in a file without a skin.
///
/// # Errors
/// As [`load_gltf`]; [`BodyError::Skeleton`] and [`BodyError::Gltf`] when no animation moves a joint.
pub fn load_gltf_motion(path: &Path) -> Result<MotionClip, BodyError> {
    let file = GltfFile::open(path)?;
    if file.document.skins().len() > 0 {
        drop(file);
        return load_gltf(path)?.motion();
    }
    let nodes = Nodes::new(&file)?;
    file.check_count("nodes of a file without a skin", nodes.order.len(), MAX_JOINTS)?;
    let rotation = |matrix: &DMat4| -> DQuat { matrix.to_scale_rotation_translation().1.normalize() };
    let place_of =
        |world: &[DMat4]| -> Vec<_> { nodes.order.iter().map(|&node| world[node].w_axis.truncate()).collect() };
    let rest = nodes.rest();
    let unturned: Vec<DQuat> = nodes.order.iter().map(|&node| rotation(&rest[node]).inverse()).collect();
    let mut frames = Vec::new();
    nodes.animate(&file, &nodes.order, |nanos, world| {
        let turned =
            nodes.order.iter().zip(&unturned).map(|(&node, rest)| (rotation(&world[node]) * *rest).normalize());
        let moved: Vec<Moved> =
            turned.zip(place_of(world)).map(|(turned, position)| Moved { position, turned }).collect();
        if moved.iter().any(|joint| !joint.position.is_finite() || !joint.turned.is_finite()) {
            return Err(file.fail("an animation scales a joint to nothing"));
        }
        frames.push((nanos, moved));
        Ok(())
    })?;
    if frames.is_empty() {
        return Err(file.fail("neither a skin nor an animation; export the body with its armature and its animation"));
    }
    let mut places = vec![0; nodes.order.len()];
    for (place, &node) in nodes.order.iter().enumerate() {
        places[node] = place;
    }
    Ok(MotionClip {
        what: path.display().to_string(),
        names: nodes.order.iter().map(|&node| joint_name(&file, node)).collect(),
        parents: nodes.order.iter().map(|&node| nodes.parents[node].map(|parent| places[parent])).collect(),
        axes_are_stated: true,
        origins: place_of(&rest),
        frames,
    })
}

//! Import of a skinned human from glTF 2.0 as template and pose track.

use std::path::Path;

use flyrig_types::{Pose, PoseTrack};
use glam::{DMat3, DMat4, DVec3};

use crate::gltf_file::GltfFile;
use crate::gltf_mesh::{Mesh, read_meshes};
use crate::gltf_nodes::{Nodes, Placement};
use crate::gltf_skins::BodySkins;
use crate::part::part_of_joints;
use crate::{BodyError, Joint, Skeleton, SkinWeights, Template};

/// Body and motion from one file.
#[derive(Debug, Clone)]
pub struct GltfHuman {
    /// Body; its skeleton rests in the file's node transforms.
    pub template: Template,
    /// First animation that moves, in the file's world (y up), metres.
    pub track: Option<PoseTrack>,
}

/// Reads the body of a `.glb` or `.gltf` file, all triangle meshes on the skins that share its joints, and the first animation
/// that moves it (the first that concerns it where all stand still).
///
/// Influences of a vertex are reduced to the strongest four. Transforms above the root joint, even
/// scale included, are folded into the root; a leading joint that moves nothing but its only child is folded
/// too. Joints keep their rest distance from their parents: animated translations of other joints than the
/// root, and animated scale, are not followed. Morph targets and animations of other nodes are ignored.
///
/// External buffers must lie in the folder of the file or below it. The limits in `gltf_limits.rs` bound the memory for any
/// file.
///
/// # Errors
/// [`BodyError::Io`]; [`BodyError::Gltf`] for a damaged file, one without skin or mesh, numbers that are not
/// finite, uneven scale, a buffer outside the folder, and sizes over a limit.
pub fn load_gltf(path: &Path) -> Result<GltfHuman, BodyError> {
    let file = GltfFile::open(path)?;
    let nodes = Nodes::new(&file)?;
    let BodySkins { mut joint_nodes, mut inverse_binds, skins } = BodySkins::new(&file, &nodes)?;
    let mut mesh = read_meshes(&file, &skins)?;
    let new_from_old = order_joints(&file, &nodes, &mesh.skin, &mut joint_nodes, &mut inverse_binds)?;
    for skin in &mut mesh.skin {
        for (joint, weight) in skin.joints.iter_mut().zip(skin.weights) {
            *joint = if weight > 0.0 { new_from_old[usize::from(*joint)] } else { 0 };
        }
    }

    let rest = placements(&file, &nodes.rest(), &joint_nodes)?;
    even_out(&mut mesh, &rest[0], &mut inverse_binds);
    let canonical_from_mesh = canonical_from_mesh(&file, &rest[0], &inverse_binds[0], &mesh)?;
    for (position, normal) in mesh.positions.iter_mut().zip(&mut mesh.normals) {
        *position = canonical_from_mesh.transform_point3(position.as_dvec3()).as_vec3();
        *normal = canonical_from_mesh.transform_vector3(normal.as_dvec3()).as_vec3().normalize_or_zero();
    }
    let mesh_from_canonical = canonical_from_mesh.inverse();
    let parents = joint_parents(&nodes, &joint_nodes);
    let pose = pose_of(&rest, &parents);
    let mut names: Vec<String> = joint_nodes.iter().map(|&node| joint_name(&file, node)).collect();
    for index in 1..names.len() {
        if names[..index].contains(&names[index]) {
            names[index] = format!("{} (node {})", names[index], joint_nodes[index]);
        }
    }
    let joints = joint_nodes.iter().enumerate().map(|(index, _)| Joint {
        name: names[index].clone(),
        parent: parents[index],
        rest_translation: match parents[index] {
            None => rest[index].translation,
            Some(p) => rest[p].rotation.inverse() * (rest[index].translation - rest[p].translation),
        },
        rest_rotation: pose.joint_rotations[index],
        // The scale of the world moves to the right of the rotation, where it can stay.
        joint_from_canonical: DMat4::from_scale(DVec3::splat(rest[index].scale))
            * inverse_binds[index]
            * mesh_from_canonical,
    });
    let skeleton = Skeleton::new(joints.collect()).map_err(|error| file.fail(error.to_string()))?;

    let mut keys = Vec::new();
    nodes.animate(&file, &joint_nodes, |nanos, world| {
        keys.push((nanos, pose_of(&placements(&file, world, &joint_nodes)?, &parents)));
        Ok(())
    })?;
    let track = match keys.is_empty() {
        true => None,
        false => Some(PoseTrack::new(keys).map_err(|error| file.fail(error.to_string()))?),
    };
    let part_of_joint = part_of_joints(&skeleton);
    let parts = mesh.skin.iter().map(|s| part_of_joint[usize::from(s.joints[0])]).collect();
    let name = path.file_stem().map_or_else(|| "glTF".to_owned(), |stem| stem.to_string_lossy().into_owned());
    let Mesh { positions, normals, uvs, triangles, skin } = mesh;
    Ok(GltfHuman { template: Template { name, positions, normals, uvs, triangles, skin, parts, skeleton }, track })
}

pub(crate) fn joint_name(file: &GltfFile<'_>, node: usize) -> String {
    let name = file.document.nodes().nth(node).and_then(|node| node.name().map(str::to_owned));
    name.unwrap_or_else(|| format!("node {node}"))
}

/// Orders joints with parents first and drops leading joints without effect; returns the new index of each old joint.
fn order_joints(
    file: &GltfFile<'_>,
    nodes: &Nodes,
    skin: &[SkinWeights],
    joint_nodes: &mut Vec<usize>,
    inverse_binds: &mut Vec<DMat4>,
) -> Result<Vec<u16>, BodyError> {
    let mut used = vec![false; joint_nodes.len()];
    for skin in skin {
        for (joint, weight) in skin.joints.iter().zip(skin.weights) {
            used[usize::from(*joint)] |= weight > 0.0;
        }
    }
    let mut ranks = vec![0; nodes.order.len()];
    for (rank, &node) in nodes.order.iter().enumerate() {
        ranks[node] = rank;
    }
    let mut old_from_new: Vec<usize> = (0..joint_nodes.len()).collect();
    old_from_new.sort_by_key(|&old| ranks[joint_nodes[old]]);
    loop {
        let ordered: Vec<usize> = old_from_new.iter().map(|&old| joint_nodes[old]).collect();
        let parents = joint_parents(nodes, &ordered);
        let roots: Vec<usize> = (0..ordered.len()).filter(|&i| parents[i].is_none()).collect();
        let mut children = vec![0; ordered.len()];
        for &parent in parents.iter().flatten() {
            children[parent] += 1;
        }
        let idle = |i: &usize| !used[old_from_new[*i]] && (children[*i] == 0 && roots.len() > 1 || children[*i] == 1);
        if let Some(root) = roots.iter().copied().find(idle) {
            old_from_new.remove(root);
            continue;
        }
        match roots.as_slice() {
            [_] => break,
            [] => return Err(file.fail("the skin has no joints")),
            [a, b, ..] => {
                let (a, b) = (joint_name(file, ordered[*a]), joint_name(file, ordered[*b]));
                return Err(file.fail(format!("joints '{a}' and '{b}' have no common parent joint; add a root bone")));
            }
        }
    }
    let mut new_from_old = vec![0; joint_nodes.len()];
    for (new, &old) in old_from_new.iter().enumerate() {
        new_from_old[old] = new as u16;
    }
    *joint_nodes = old_from_new.iter().map(|&old| joint_nodes[old]).collect();
    *inverse_binds = old_from_new.iter().map(|&old| inverse_binds[old]).collect();
    Ok(new_from_old)
}

/// Returns the nearest ancestor of each joint that is itself a joint.
pub(crate) fn joint_parents(nodes: &Nodes, joint_nodes: &[usize]) -> Vec<Option<usize>> {
    let mut joint_at = vec![None; nodes.parents.len()];
    for (joint, &node) in joint_nodes.iter().enumerate().rev() {
        joint_at[node] = Some(joint);
    }
    // One pass from the roots: a chain of nodes may be as long as the file allows.
    let mut nearest: Vec<Option<usize>> = vec![None; joint_at.len()];
    for &node in &nodes.order {
        nearest[node] = joint_at[node].or_else(|| nodes.parents[node].and_then(|parent| nearest[parent]));
    }
    joint_nodes.iter().map(|&node| nodes.parents[node].and_then(|parent| nearest[parent])).collect()
}

fn placements(file: &GltfFile<'_>, world: &[DMat4], joint_nodes: &[usize]) -> Result<Vec<Placement>, BodyError> {
    let placement = |&node: &usize| {
        Placement::from_matrix(&world[node]).ok_or_else(|| {
            let name = joint_name(file, node);
            file.fail(format!(
                "joint '{name}' is sheared, mirrored or scaled unevenly; apply its scale and export again"
            ))
        })
    };
    joint_nodes.iter().map(placement).collect()
}

fn pose_of(placements: &[Placement], parents: &[Option<usize>]) -> Pose {
    let local = |(placement, parent): (&Placement, &Option<usize>)| match parent {
        None => placement.rotation,
        Some(parent) => (placements[*parent].rotation.inverse() * placement.rotation).normalize(),
    };
    Pose {
        root_translation: placements[0].translation,
        joint_rotations: placements.iter().zip(parents).map(local).collect(),
    }
}

/// Scales a mesh whose axes have different steps (KHR_mesh_quantization allows it) so that it has one.
fn even_out(mesh: &mut Mesh, root: &Placement, inverse_binds: &mut [DMat4]) {
    let linear = DMat3::from_quat(root.rotation) * DMat3::from_mat4(inverse_binds[0]);
    let steps = DVec3::new(linear.x_axis.length(), linear.y_axis.length(), linear.z_axis.length());
    let stretch = steps / steps.x;
    if !(stretch.is_finite() && stretch.min_element() > 1e-6) || stretch.abs_diff_eq(DVec3::ONE, 0.01) {
        return;
    }
    for (position, normal) in mesh.positions.iter_mut().zip(&mut mesh.normals) {
        *position = (position.as_dvec3() * stretch).as_vec3();
        *normal = (normal.as_dvec3() / stretch).as_vec3();
    }
    inverse_binds.iter_mut().for_each(|matrix| *matrix *= DMat4::from_scale(stretch.recip()));
}

/// Returns the scale to metres and the quarter turns that bring the bind pose upright, for meshes stored along other axes than
/// the world's.
fn canonical_from_mesh(
    file: &GltfFile<'_>,
    root: &Placement,
    inverse_bind: &DMat4,
    mesh: &Mesh,
) -> Result<DMat4, BodyError> {
    let world_from_root = DMat4::from_rotation_translation(root.rotation, root.translation);
    let world_from_mesh = world_from_root * DMat4::from_scale(DVec3::splat(root.scale)) * *inverse_bind;
    let Some(Placement { rotation, scale, translation }) = Placement::from_matrix(&world_from_mesh) else {
        return Err(file.fail("the root's inverse bind matrix is sheared, mirrored or scaled unevenly"));
    };
    let up_in_mesh = rotation.inverse() * DVec3::Y;
    let front_in_mesh = rotation.inverse() * DVec3::Z;
    let y = nearest_axis(up_in_mesh);
    let z = nearest_axis(front_in_mesh - y * y.dot(front_in_mesh));
    let turn = DMat3::from_cols(y.cross(z), y, z).transpose();
    let turned = DMat4::from_mat3(turn * scale);
    // Quantised meshes have their middle at the origin and their place in the inverse bind matrices; others rest where
    // their nodes stand. The body stands on the floor.
    let lowest = |above: f64| {
        let heights = mesh.positions.iter().map(|p| turned.transform_point3(p.as_dvec3()).y + above);
        heights.fold(f64::INFINITY, f64::min).abs()
    };
    let moved = turn * (rotation.inverse() * translation);
    Ok(if lowest(moved.y) + 1e-6 < lowest(0.0) { DMat4::from_translation(moved) * turned } else { turned })
}

fn nearest_axis(v: DVec3) -> DVec3 {
    let a = v.abs();
    if a.x > a.y && a.x > a.z {
        DVec3::X * v.x.signum()
    } else if a.y > a.z {
        DVec3::Y * v.y.signum()
    } else {
        DVec3::Z * v.z.signum()
    }
}

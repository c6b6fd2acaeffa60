//! Import of a skinned human from glTF 2.0 as template and pose track.

use std::path::Path;

use flyrig_types::{Pose, PoseTrack};
use glam::{DMat3, DMat4, DVec3, Vec2, Vec3};

use crate::gltf_file::GltfFile;
use crate::gltf_limits::{MAX_INDICES, MAX_JOINT_SETS, MAX_JOINTS, MAX_VERTICES};
use crate::gltf_nodes::{Nodes, Placement};
use crate::part::part_of_joints;
use crate::{BodyError, Joint, Skeleton, SkinWeights, Template};

/// Body and motion from one file.
#[derive(Debug, Clone)]
pub struct GltfHuman {
    /// Body; its skeleton rests in the file's node transforms.
    pub template: Template,
    /// First animation, in the file's world (y up), metres.
    pub track: Option<PoseTrack>,
}

/// Reads the first skin of a `.glb` or `.gltf` file with all triangle meshes attached to it, and the first animation.
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
    let Some(skin) = file.document.skins().next() else {
        return Err(file.fail("no skin; export the body with its armature"));
    };
    file.check_count("joints of the skin", skin.joints().count(), MAX_JOINTS)?;
    let mut mesh = read_meshes(&file, &skin)?;
    let mut joint_nodes: Vec<usize> = skin.joints().map(|node| node.index()).collect();
    if let Some(joint) = mesh.skin.iter().flat_map(|s| s.joints).find(|&joint| usize::from(joint) >= joint_nodes.len())
    {
        return Err(file.fail(format!("a vertex names joint {joint} of {}", joint_nodes.len())));
    }
    let mut inverse_binds = vec![DMat4::IDENTITY; joint_nodes.len()];
    if let Some(accessor) = skin.inverse_bind_matrices() {
        let matrices = file.finite::<16>(&accessor, "the inverse bind matrices", MAX_JOINTS)?;
        if matrices.len() < joint_nodes.len() {
            return Err(file.fail("there are fewer inverse bind matrices than joints"));
        }
        inverse_binds = matrices[..joint_nodes.len()].iter().map(DMat4::from_cols_array).collect();
    }
    let new_from_old = order_joints(&file, &nodes, &mesh.skin, &mut joint_nodes, &mut inverse_binds)?;
    for skin in &mut mesh.skin {
        for (joint, weight) in skin.joints.iter_mut().zip(skin.weights) {
            *joint = if weight > 0.0 { new_from_old[usize::from(*joint)] } else { 0 };
        }
    }

    let rest = placements(&file, &nodes.rest(), &joint_nodes)?;
    let canonical_from_mesh = canonical_from_mesh(&file, &rest[0], &inverse_binds[0])?;
    for (position, normal) in mesh.positions.iter_mut().zip(&mut mesh.normals) {
        *position = canonical_from_mesh.transform_point3(position.as_dvec3()).as_vec3();
        *normal = canonical_from_mesh.transform_vector3(normal.as_dvec3()).as_vec3().normalize_or_zero();
    }
    let mesh_from_canonical = canonical_from_mesh.inverse();
    let parents = joint_parents(&nodes, &joint_nodes);
    let pose = pose_of(&rest, &parents);
    let joints = joint_nodes.iter().enumerate().map(|(index, &node)| Joint {
        name: joint_name(&file, node),
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

fn joint_name(file: &GltfFile<'_>, node: usize) -> String {
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
fn joint_parents(nodes: &Nodes, joint_nodes: &[usize]) -> Vec<Option<usize>> {
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

/// Returns the scale to metres and the quarter turns that bring the bind pose upright, for meshes stored along other axes than
/// the world's.
fn canonical_from_mesh(file: &GltfFile<'_>, root: &Placement, inverse_bind: &DMat4) -> Result<DMat4, BodyError> {
    let world_from_root = DMat4::from_rotation_translation(root.rotation, root.translation);
    let world_from_mesh = world_from_root * DMat4::from_scale(DVec3::splat(root.scale)) * *inverse_bind;
    let Some(Placement { rotation, scale, .. }) = Placement::from_matrix(&world_from_mesh) else {
        return Err(file.fail("the root's inverse bind matrix is sheared, mirrored or scaled unevenly"));
    };
    let up_in_mesh = rotation.inverse() * DVec3::Y;
    let front_in_mesh = rotation.inverse() * DVec3::Z;
    let y = nearest_axis(up_in_mesh);
    let z = nearest_axis(front_in_mesh - y * y.dot(front_in_mesh));
    let canonical_from_mesh = DMat3::from_cols(y.cross(z), y, z).transpose();
    Ok(DMat4::from_mat3(canonical_from_mesh * scale))
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

#[derive(Default)]
struct Mesh {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    uvs: Vec<Vec2>,
    triangles: Vec<[u32; 3]>,
    /// Influences with the joint numbers of the file's skin.
    skin: Vec<SkinWeights>,
}

/// Merges all triangle primitives of nodes with this skin.
fn read_meshes(file: &GltfFile<'_>, skin: &gltf::Skin<'_>) -> Result<Mesh, BodyError> {
    let mut mesh = Mesh::default();
    let uses = |node: &gltf::Node<'_>| node.skin().is_some_and(|s| s.index() == skin.index());
    let others = file.document.nodes().filter(|node| node.mesh().is_some() && !uses(node)).count();
    if others > 0 {
        tracing::warn!(path = %file.path.display(), others, "meshes without the first skin are left out");
    }
    check_sizes(file, file.document.nodes().filter(uses))?;
    for node in file.document.nodes().filter(uses) {
        let Some(source) = node.mesh() else { continue };
        for primitive in source.primitives() {
            let what = format!("primitive {} of mesh {}", primitive.index(), source.index());
            if primitive.mode() != gltf::mesh::Mode::Triangles {
                return Err(file.fail(format!("{what} is drawn as {:?}; export triangles", primitive.mode())));
            }
            read_primitive(file, &primitive, &what, &mut mesh)?;
        }
    }
    if mesh.triangles.is_empty() {
        return Err(file.fail("no mesh with triangles hangs on the skin"));
    }
    Ok(mesh)
}

/// Checks the total sizes of all meshes before anything is read: primitives may share data, and nodes a mesh.
fn check_sizes<'a>(file: &GltfFile<'_>, nodes: impl Iterator<Item = gltf::Node<'a>>) -> Result<(), BodyError> {
    let (mut vertices, mut corners) = (0usize, 0usize);
    for mesh in nodes.filter_map(|node| node.mesh()) {
        for primitive in mesh.primitives() {
            let what = |items: &str| format!("{items} up to primitive {} of mesh {}", primitive.index(), mesh.index());
            let count = primitive.get(&gltf::Semantic::Positions).map_or(0, |accessor| accessor.count());
            // An empty primitive counts too, so that this loop is bounded.
            vertices = vertices.saturating_add(count.max(1));
            corners = corners.saturating_add(primitive.indices().map_or(count, |accessor| accessor.count()));
            file.check_count(&what("vertices"), vertices, MAX_VERTICES)?;
            file.check_count(&what("triangle corners"), corners, MAX_INDICES)?;
        }
    }
    Ok(())
}

fn read_primitive(
    file: &GltfFile<'_>,
    primitive: &gltf::Primitive<'_>,
    what: &str,
    mesh: &mut Mesh,
) -> Result<(), BodyError> {
    use gltf::Semantic::{Joints, Normals, Positions, TexCoords, Weights};
    let first = mesh.positions.len();
    let missing = |name: &str| file.fail(format!("{what} has no {name}"));
    let check = |found: usize, expected: usize, name: &str| match found == expected {
        true => Ok(()),
        false => Err(file.fail(format!("{what} has {found} {name} for {expected} vertices"))),
    };
    let positions = primitive.get(&Positions).ok_or_else(|| missing("positions"))?;
    let positions = file.finite::<3>(&positions, &format!("the positions of {what}"), MAX_VERTICES)?;
    let count = positions.len();
    mesh.positions.extend(positions.iter().map(|&p| DVec3::from_array(p).as_vec3()));

    let indices: Vec<usize> = match primitive.indices() {
        Some(accessor) => {
            let indices = file.numbers::<1>(&accessor, &format!("the indices of {what}"), MAX_INDICES)?;
            indices.iter().map(|[i]| *i as usize).collect()
        }
        None => (0..count).collect(),
    };
    if let Some(index) = indices.iter().find(|&&index| index >= count) {
        return Err(file.fail(format!("{what} has index {index} but {count} vertices")));
    }
    let (triangles, _) = indices.as_chunks::<3>();
    mesh.triangles.extend(triangles.iter().map(|t| t.map(|index| (first + index) as u32)));

    match primitive.get(&Normals) {
        Some(accessor) => {
            let normals = file.finite::<3>(&accessor, &format!("the normals of {what}"), MAX_VERTICES)?;
            check(normals.len(), count, "normals")?;
            mesh.normals.extend(normals.iter().map(|&n| DVec3::from_array(n).as_vec3()));
        }
        None => {
            let mut normals = vec![Vec3::ZERO; count];
            for t in triangles {
                let [a, b, c] = t.map(|index| mesh.positions[first + index]);
                for &index in t {
                    normals[index] += (b - a).cross(c - a);
                }
            }
            mesh.normals.extend(normals);
        }
    }
    match primitive.get(&TexCoords(0)) {
        Some(accessor) => {
            let uvs = file.finite::<2>(&accessor, &format!("the texture coordinates of {what}"), MAX_VERTICES)?;
            check(uvs.len(), count, "texture coordinates")?;
            mesh.uvs.extend(uvs.iter().map(|&[u, v]| Vec2::new(u as f32, v as f32)));
        }
        None => mesh.uvs.resize(first + count, Vec2::ZERO),
    }

    let mut influences = vec![Vec::new(); count];
    for set in 0.. {
        let (Some(joints), Some(weights)) = (primitive.get(&Joints(set)), primitive.get(&Weights(set))) else { break };
        file.check_count(&format!("sets of joints of {what}"), set as usize + 1, MAX_JOINT_SETS as usize)?;
        let joints = file.finite::<4>(&joints, &format!("the joints of {what}"), MAX_VERTICES)?;
        let weights = file.finite::<4>(&weights, &format!("the weights of {what}"), MAX_VERTICES)?;
        check(joints.len(), count, "joint sets")?;
        check(weights.len(), count, "weight sets")?;
        for ((list, joints), weights) in influences.iter_mut().zip(&joints).zip(&weights) {
            list.extend(joints.iter().map(|&joint| joint as u16).zip(weights.iter().map(|&w| w as f32)));
        }
    }
    let mut loose = 0;
    for list in influences {
        mesh.skin.push(SkinWeights::strongest(&list).unwrap_or_else(|| {
            loose += 1;
            SkinWeights { joints: [0; 4], weights: [1.0, 0.0, 0.0, 0.0] }
        }));
    }
    if loose == count {
        return Err(file.fail(format!("{what} has no skin weights; export the body with its armature")));
    }
    if loose > 0 {
        tracing::warn!(path = %file.path.display(), loose, "vertices without weights follow the first joint");
    }
    Ok(())
}

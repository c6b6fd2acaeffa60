//! Meshes of a body in a glTF file.

use std::collections::BTreeMap;

use glam::{DMat4, DVec3, Vec2, Vec3};

use crate::gltf_file::GltfFile;
use crate::gltf_limits::{MAX_INDICES, MAX_JOINT_SETS, MAX_VERTICES};
use crate::gltf_skins::BodySkin;
use crate::{BodyError, SkinWeights};

/// Meshes of a body, merged.
#[derive(Default)]
pub(crate) struct Mesh {
    pub positions: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    pub uvs: Vec<Vec2>,
    pub triangles: Vec<[u32; 3]>,
    /// Influences with the joint numbers of the body's skins.
    pub skin: Vec<SkinWeights>,
}

/// Merges all triangle primitives of nodes with one of the body's skins.
pub(crate) fn read_meshes(file: &GltfFile<'_>, skins: &BTreeMap<usize, BodySkin>) -> Result<Mesh, BodyError> {
    let mut mesh = Mesh::default();
    let used = |node: gltf::Node<'_>| node.skin().is_some_and(|skin| skins.contains_key(&skin.index()));
    let loose = file.document.nodes().filter(|node| node.mesh().is_some() && node.skin().is_none()).count();
    if loose > 0 {
        tracing::warn!(path = %file.path.display(), loose, "meshes without a skin are left out");
    }
    check_sizes(file, file.document.nodes().filter(|node| used(node.clone())))?;
    for node in file.document.nodes() {
        let (Some(source), Some(skin)) = (node.mesh(), node.skin()) else { continue };
        let Some(skin) = skins.get(&skin.index()) else { continue };
        for primitive in source.primitives() {
            let what = format!("primitive {} of mesh {}", primitive.index(), source.index());
            if primitive.mode() != gltf::mesh::Mode::Triangles {
                return Err(file.fail(format!("{what} is drawn as {:?}; export triangles", primitive.mode())));
            }
            read_primitive(file, &primitive, &what, skin, &mut mesh)?;
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
    skin: &BodySkin,
    mesh: &mut Mesh,
) -> Result<(), BodyError> {
    use gltf::Semantic::{Normals, Positions, TexCoords};
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

    read_influences(file, primitive, what, skin, mesh, first)
}

/// Reads the influences of a primitive's vertices, which stand in `mesh` from `first` on, and brings the vertices into the body's
/// mesh space.
fn read_influences(
    file: &GltfFile<'_>,
    primitive: &gltf::Primitive<'_>,
    what: &str,
    skin: &BodySkin,
    mesh: &mut Mesh,
    first: usize,
) -> Result<(), BodyError> {
    use gltf::Semantic::{Joints, Weights};
    let count = mesh.positions.len() - first;
    let mut influences = vec![Vec::new(); count];
    for set in 0.. {
        let (Some(joints), Some(weights)) = (primitive.get(&Joints(set)), primitive.get(&Weights(set))) else { break };
        file.check_count(&format!("sets of joints of {what}"), set as usize + 1, MAX_JOINT_SETS as usize)?;
        let joints = file.finite::<4>(&joints, &format!("the joints of {what}"), MAX_VERTICES)?;
        let weights = file.finite::<4>(&weights, &format!("the weights of {what}"), MAX_VERTICES)?;
        for (found, name) in [(joints.len(), "joint sets"), (weights.len(), "weight sets")] {
            if found != count {
                return Err(file.fail(format!("{what} has {found} {name} for {count} vertices")));
            }
        }
        for ((list, joints), weights) in influences.iter_mut().zip(&joints).zip(&weights) {
            list.extend(joints.iter().map(|&joint| joint as u16).zip(weights.iter().map(|&w| w as f32)));
        }
    }
    let mut loose = 0;
    for (vertex, list) in influences.iter().enumerate() {
        let mut weights = SkinWeights::strongest(list).unwrap_or_else(|| {
            loose += 1;
            SkinWeights { joints: [0; 4], weights: [1.0, 0.0, 0.0, 0.0] }
        });
        // Some exporters leave nonsense beside weights of zero.
        let used = || weights.joints.iter().zip(weights.weights).filter(|(_, weight)| *weight > 0.0);
        if let Some((joint, _)) = used().find(|(joint, _)| usize::from(**joint) >= skin.joints.len()) {
            return Err(file.fail(format!("a vertex names joint {joint} of {}", skin.joints.len())));
        }
        if let Some(body_from_mesh) = &skin.body_from_mesh {
            let matrix = used().map(|(&joint, weight)| body_from_mesh[usize::from(joint)] * f64::from(weight));
            let matrix = matrix.fold(DMat4::ZERO, |sum, matrix| sum + matrix);
            let (position, normal) = (&mut mesh.positions[first + vertex], &mut mesh.normals[first + vertex]);
            *position = matrix.transform_point3(position.as_dvec3()).as_vec3();
            *normal = matrix.transform_vector3(normal.as_dvec3()).as_vec3();
        }
        for (joint, weight) in weights.joints.iter_mut().zip(weights.weights) {
            *joint = if weight > 0.0 { skin.joints[usize::from(*joint)] as u16 } else { 0 };
        }
        mesh.skin.push(weights);
    }
    if loose == count {
        return Err(file.fail(format!("{what} has no skin weights; export the body with its armature")));
    }
    if loose > 0 {
        tracing::warn!(path = %file.path.display(), loose, "vertices without weights follow the first joint");
    }
    Ok(())
}

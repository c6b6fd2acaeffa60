//! Skins of glTF files that together make one body: exporters hang face, body and hair on a skin each, over the same joints.

use std::collections::BTreeMap;

use glam::DMat4;

use crate::BodyError;
use crate::gltf_file::GltfFile;
use crate::gltf_json::shown;
use crate::gltf_limits::{MAX_JOINTS, MAX_SKINS};
use crate::gltf_nodes::Nodes;

/// Joints of all skins of a body, with one space for the meshes of all.
pub(crate) struct BodySkins {
    /// Node of each joint.
    pub joint_nodes: Vec<usize>,
    /// Joints from mesh space.
    pub inverse_binds: Vec<DMat4>,
    /// Skins by their index in the file.
    pub skins: BTreeMap<usize, BodySkin>,
}

/// Skin as part of a body.
pub(crate) struct BodySkin {
    /// Joint of the body for each of the skin's.
    pub joints: Vec<usize>,
    /// From the skin's mesh space to the body's, for each of the skin's joints; `None` where they are equal.
    pub body_from_mesh: Option<Vec<DMat4>>,
}

/// Skin of the file.
struct FileSkin {
    index: usize,
    joint_nodes: Vec<usize>,
    inverse_binds: Vec<DMat4>,
    vertices: usize,
}

impl BodySkins {
    /// Finds the body with most joints among the skins that hold meshes, in whatever order they stand. Skins that share
    /// a joint or hang on each other's joints are one body.
    ///
    /// # Errors
    /// [`BodyError::Gltf`] without a skin, over a limit, or with inverse bind matrices that are missing or cannot be inverted.
    pub fn new(file: &GltfFile<'_>, nodes: &Nodes) -> Result<Self, BodyError> {
        let count = |mesh: gltf::Mesh<'_>| {
            let positions = mesh.primitives().filter_map(|primitive| primitive.get(&gltf::Semantic::Positions));
            positions.map(|accessor| accessor.count()).fold(0, usize::saturating_add)
        };
        let counts: Vec<usize> = file.document.meshes().map(count).collect();
        let mut vertices: BTreeMap<usize, usize> = BTreeMap::new();
        for node in file.document.nodes() {
            if let (Some(skin), Some(mesh)) = (node.skin(), node.mesh()) {
                let sum = vertices.entry(skin.index()).or_insert(0);
                *sum = sum.saturating_add(counts[mesh.index()]);
            }
        }
        let all = file.document.skins().count();
        file.check_count("skins", all, MAX_SKINS)?;
        let no_mesh = vertices.is_empty();
        let used = file.document.skins().filter(|skin| no_mesh || vertices.contains_key(&skin.index()));
        let skins = used
            .map(|skin| FileSkin::new(file, &skin, vertices.get(&skin.index()).copied().unwrap_or(0)))
            .collect::<Result<Vec<_>, _>>()?;
        let bodies = bodies(nodes, &skins);
        let joints = |body: &&Vec<usize>| -> usize {
            let nodes = body.iter().flat_map(|&skin| &skins[skin].joint_nodes);
            nodes.collect::<std::collections::BTreeSet<_>>().len()
        };
        let size = |body: &&Vec<usize>| {
            (joints(body), body.iter().map(|&skin| skins[skin].vertices).fold(0, usize::saturating_add))
        };
        let Some(body) = bodies.iter().rev().max_by_key(size) else {
            return Err(file.fail("no skin; export the body with its armature"));
        };
        file.check_count("joints of the body", joints(&body), MAX_JOINTS)?;
        let others: Vec<String> = skins
            .iter()
            .enumerate()
            .filter(|(index, _)| !body.contains(index))
            .map(|(_, skin)| skin_name(file, skin.index))
            .collect();
        if !others.is_empty() {
            let taken = body.iter().map(|&skin| skin_name(file, skins[skin].index)).collect::<Vec<_>>();
            tracing::warn!(
                "{}: the body on skin {} is taken; left out, since they share no joints with it: {}",
                file.path.display(),
                taken.join(", "),
                others.join(", ")
            );
        }
        let mut parts: Vec<&FileSkin> = body.iter().map(|&skin| &skins[skin]).collect();
        parts.sort_by_key(|skin| std::cmp::Reverse(skin.joint_nodes.len()));
        let mut joined = Self { joint_nodes: Vec::new(), inverse_binds: Vec::new(), skins: BTreeMap::new() };
        let world = nodes.rest();
        for skin in parts {
            joined.join(skin, &world);
        }
        if joined.joint_nodes.is_empty() {
            return Err(file.fail("the skin has no joints"));
        }
        Ok(joined)
    }

    /// Adds a skin; `world` holds the nodes at rest.
    fn join(&mut self, skin: &FileSkin, world: &[DMat4]) {
        let mut known: BTreeMap<usize, usize> = self.joint_nodes.iter().copied().zip(0..).collect();
        let places: Vec<Option<usize>> = skin.joint_nodes.iter().map(|node| known.get(node).copied()).collect();
        let from_mesh = |joint: usize, own: usize| self.inverse_binds[joint].inverse() * skin.inverse_binds[own];
        // By a shared joint, or else as the nodes rest.
        let shared = places.iter().enumerate().find_map(|(own, &joint)| Some(from_mesh(joint?, own)));
        let common = shared.unwrap_or_else(|| match (self.joint_nodes.first(), skin.joint_nodes.first()) {
            (Some(&root), Some(&node)) => {
                let world_from_body = world[root] * self.inverse_binds[0];
                world_from_body.inverse() * world[node] * skin.inverse_binds[0]
            }
            _ => DMat4::IDENTITY,
        });
        let own_matrix = |(own, joint): (usize, &Option<usize>)| joint.map_or(common, |joint| from_mesh(joint, own));
        let body_from_mesh: Vec<DMat4> = places.iter().enumerate().map(own_matrix).collect();
        let is_same = body_from_mesh.iter().all(|matrix| matrix.abs_diff_eq(DMat4::IDENTITY, 1e-9));
        let mut joints = Vec::with_capacity(places.len());
        for (&node, inverse_bind) in skin.joint_nodes.iter().zip(&skin.inverse_binds) {
            let joint = *known.entry(node).or_insert(self.joint_nodes.len());
            if joint == self.joint_nodes.len() {
                self.joint_nodes.push(node);
                self.inverse_binds.push(*inverse_bind * common.inverse());
            }
            joints.push(joint);
        }
        let body_from_mesh = (!is_same).then_some(body_from_mesh);
        self.skins.insert(skin.index, BodySkin { joints, body_from_mesh });
    }
}

impl FileSkin {
    fn new(file: &GltfFile<'_>, skin: &gltf::Skin<'_>, vertices: usize) -> Result<Self, BodyError> {
        file.check_count("joints of the skin", skin.joints().count(), MAX_JOINTS)?;
        let joint_nodes: Vec<usize> = skin.joints().map(|node| node.index()).collect();
        let mut inverse_binds = vec![DMat4::IDENTITY; joint_nodes.len()];
        if let Some(accessor) = skin.inverse_bind_matrices() {
            let matrices = file.finite::<16>(&accessor, "the inverse bind matrices", MAX_JOINTS)?;
            if matrices.len() < joint_nodes.len() {
                return Err(file.fail("there are fewer inverse bind matrices than joints"));
            }
            inverse_binds = matrices[..joint_nodes.len()].iter().map(DMat4::from_cols_array).collect();
        }
        if let Some(joint) = inverse_binds.iter().position(|matrix| !matrix.inverse().is_finite()) {
            let name = skin_name(file, skin.index());
            return Err(file.fail(format!("inverse bind matrix {joint} of skin {name} cannot be inverted")));
        }
        Ok(Self { index: skin.index(), joint_nodes, inverse_binds, vertices })
    }
}

fn skin_name(file: &GltfFile<'_>, index: usize) -> String {
    let name = file.document.skins().nth(index).and_then(|skin| skin.name().map(shown));
    name.map_or_else(|| index.to_string(), |name| format!("{index} '{name}'"))
}

/// Groups skins: those with a joint in common, and those with a joint below a joint of the other.
fn bodies(nodes: &Nodes, skins: &[FileSkin]) -> Vec<Vec<usize>> {
    // The body of each skin, by its first skin.
    let mut body: Vec<usize> = (0..skins.len()).collect();
    let mut merge = |a: usize, b: usize| {
        if body[a] == body[b] {
            return;
        }
        let (from, to) = (body[a].max(body[b]), body[a].min(body[b]));
        body.iter_mut().filter(|body| **body == from).for_each(|body| *body = to);
    };
    let mut skin_at: Vec<Option<usize>> = vec![None; nodes.parents.len()];
    for (index, skin) in skins.iter().enumerate() {
        for &node in &skin.joint_nodes {
            match skin_at[node] {
                Some(other) => merge(index, other),
                None => skin_at[node] = Some(index),
            }
        }
    }
    // Skin of the nearest joint above each node.
    let mut above: Vec<Option<usize>> = vec![None; nodes.parents.len()];
    for &node in &nodes.order {
        let nearest = nodes.parents[node].and_then(|parent| above[parent]);
        if let (Some(own), Some(nearest)) = (skin_at[node], nearest) {
            merge(own, nearest);
        }
        above[node] = skin_at[node].or(nearest);
    }
    let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (skin, first) in body.iter().enumerate() {
        groups.entry(*first).or_default().push(skin);
    }
    groups.into_values().collect()
}

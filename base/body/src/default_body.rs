//! Built-in body: MakeHuman's CC0 base mesh in any shape, with a skeleton refitted to it.

use glam::{DMat4, DQuat, DVec3, Vec2, Vec3};

use crate::body_asset::{BodyAsset, TargetKind, body_asset};
use crate::part::part_of_joints;
use crate::{BodyError, Joint, ShapeParams, Skeleton, SkinWeights, Template};

/// Name of the built-in body's templates.
const BUILT_IN: &str = "built-in body";

impl Template {
    /// Returns whether this is the built-in body, in any shape ([`default_template`]).
    #[must_use]
    pub fn is_built_in(&self) -> bool {
        self.name == BUILT_IN && body_asset().is_ok_and(|asset| asset.corner_vertex.len() == self.positions.len())
    }
}

/// Parameter of the built-in body's shape.
#[derive(Debug, Clone, PartialEq)]
pub struct ShapeTarget {
    /// Key in [`ShapeParams`].
    pub name: String,
    /// Smallest weight.
    pub min: f32,
    /// Largest weight.
    pub max: f32,
    /// Weight of the average body.
    pub default: f32,
}

/// Returns the parameters of [`default_template`], macro targets first.
///
/// # Errors
/// [`BodyError::Asset`].
pub fn shape_targets() -> Result<Vec<ShapeTarget>, BodyError> {
    let asset = body_asset()?;
    let macros = asset.axes.keys().map(|name| ShapeTarget { name: name.clone(), min: 0.0, max: 1.0, default: 0.5 });
    let mut targets: Vec<_> = macros.collect();
    for target in &asset.targets {
        if let TargetKind::Local { name, .. } = &target.kind
            && !targets.iter().any(|known| known.name == *name)
        {
            targets.push(ShapeTarget { name: name.clone(), min: -1.0, max: 1.0, default: 0.0 });
        }
    }
    Ok(targets)
}

/// Creates the built-in body in the given shape: 14,517 vertices, 26,756 triangles, 31 joints with the names of the
/// CMU motion capture skeleton. It stands on y = 0 in an A pose; at rest all joints have the canonical axes, and their origins are
/// measured from the shaped mesh.
///
/// # Errors
/// [`BodyError::UnknownTarget`] names the nearest targets, [`BodyError::TargetWeight`] the range,
/// [`BodyError::Asset`].
pub fn default_template(shape: &ShapeParams) -> Result<Template, BodyError> {
    let asset = body_asset()?;
    check_shape(shape)?;
    let mut vertices = shaped_vertices(asset, shape);
    let floor = vertices[..asset.body_vertices].iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
    for vertex in &mut vertices {
        vertex.y -= floor;
    }
    let body_normals = vertex_normals(asset, &vertices);
    let skeleton = fitted_skeleton(asset, &vertices)?;
    let part_of_joint = part_of_joints(&skeleton);
    let corners = || asset.corner_vertex.iter().map(|&v| usize::from(v));
    let skin: Vec<SkinWeights> = corners()
        .map(|v| SkinWeights {
            joints: asset.skin_joints[v].map(u16::from),
            weights: asset.skin_weights[v].map(|w| f32::from(w) / f32::from(u16::MAX)),
        })
        .collect();
    Ok(Template {
        name: BUILT_IN.to_owned(),
        positions: corners().map(|v| vertices[v]).collect(),
        normals: corners().map(|v| body_normals[v]).collect(),
        // glTF's v runs down.
        uvs: asset.uvs.iter().map(|&[u, v]| Vec2::new(u, 1.0 - v)).collect(),
        triangles: asset.triangles.iter().map(|t| t.map(u32::from)).collect(),
        parts: skin.iter().map(|s| part_of_joint[usize::from(s.joints[0])]).collect(),
        skin,
        skeleton,
    })
}

fn check_shape(shape: &ShapeParams) -> Result<(), BodyError> {
    let targets = shape_targets()?;
    for (name, &weight) in &shape.0 {
        let Some(target) = targets.iter().find(|target| target.name == *name) else {
            let mut names: Vec<_> = targets.iter().map(|target| target.name.as_str()).collect();
            names.sort_by_key(|known| strsim::damerau_levenshtein(known, name));
            names.truncate(3);
            return Err(BodyError::UnknownTarget { name: name.clone(), nearest: names.join(", ") });
        };
        if !(target.min..=target.max).contains(&weight) {
            let ShapeTarget { name, min, max, .. } = target.clone();
            return Err(BodyError::TargetWeight { name, weight, min, max });
        }
    }
    Ok(())
}

fn shaped_vertices(asset: &BodyAsset, shape: &ShapeParams) -> Vec<Vec3> {
    let given = |name: &str| shape.0.get(name).copied();
    let mut vertices: Vec<Vec3> = asset.vertices.iter().map(|&v| Vec3::from(v)).collect();
    for target in &asset.targets {
        let weight = match &target.kind {
            TargetKind::Local { name, sign } => (given(name).unwrap_or(0.0) * sign).max(0.0),
            TargetKind::Macro(tags) => tags.iter().map(|tag| tag_weight(asset, tag, &given)).product(),
        };
        if weight > 0.0 {
            for (vertex, moved) in target.moves() {
                vertices[vertex] += weight * Vec3::from(moved);
            }
        }
    }
    vertices
}

/// Evaluates the hat function of a tag on its macro axis: 1 at its own value, falling to 0 at its neighbours'.
fn tag_weight(asset: &BodyAsset, tag: &str, given: &impl Fn(&str) -> Option<f32>) -> f32 {
    for (axis, peaks) in &asset.axes {
        if let Some(index) = peaks.iter().position(|(_, name)| name == tag) {
            let value = given(axis).unwrap_or(0.5);
            let own = peaks[index].0;
            let neighbour = if value < own { index.checked_sub(1) } else { Some(index + 1) };
            return match neighbour.and_then(|i| peaks.get(i)) {
                Some((other, _)) => (1.0 - (value - own).abs() / (other - own).abs()).max(0.0),
                None => 1.0,
            };
        }
    }
    0.0
}

/// Computes area-weighted vertex normals across UV seams.
fn vertex_normals(asset: &BodyAsset, vertices: &[Vec3]) -> Vec<Vec3> {
    let mut normals = vec![Vec3::ZERO; vertices.len()];
    for triangle in &asset.triangles {
        let [a, b, c] = triangle.map(|corner| usize::from(asset.corner_vertex[usize::from(corner)]));
        let normal = (vertices[b] - vertices[a]).cross(vertices[c] - vertices[a]);
        for vertex in [a, b, c] {
            normals[vertex] += normal;
        }
    }
    normals.into_iter().map(|normal| normal.normalize_or(Vec3::Y)).collect()
}

fn fitted_skeleton(asset: &BodyAsset, vertices: &[Vec3]) -> Result<Skeleton, BodyError> {
    let origins: Vec<DVec3> = asset
        .joints
        .iter()
        .map(|joint| {
            joint.vertices.iter().map(|&v| vertices[v].as_dvec3()).sum::<DVec3>() / joint.vertices.len() as f64
        })
        .collect();
    let joints = asset.joints.iter().zip(&origins).map(|(joint, &origin)| Joint {
        name: joint.name.clone(),
        parent: joint.parent,
        rest_translation: origin - joint.parent.and_then(|parent| origins.get(parent)).copied().unwrap_or(DVec3::ZERO),
        rest_rotation: DQuat::IDENTITY,
        joint_from_canonical: DMat4::from_translation(-origin),
    });
    Skeleton::new(joints.collect())
}

//! Node hierarchy of a glTF file: transforms at rest and in an animation.

use glam::{DMat3, DMat4, DQuat, DVec3};
use gltf::animation::{Interpolation, Property};

use crate::BodyError;
use crate::gltf_file::GltfFile;

/// Between two keys of a cubic curve poses are taken this often.
const CUBIC_STEP_NANOS: i64 = 1_000_000_000 / 120;

/// Translation, rotation, scale of a node in its parent.
#[derive(Debug, Clone, Copy)]
struct Local {
    translation: DVec3,
    rotation: DQuat,
    scale: DVec3,
}

/// All nodes, in file order.
pub(crate) struct Nodes {
    locals: Vec<Local>,
    pub parents: Vec<Option<usize>>,
    /// Parents before children.
    pub order: Vec<usize>,
}

/// A rotation, a translation and one scale: what a joint may be in the world.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Placement {
    pub rotation: DQuat,
    pub translation: DVec3,
    pub scale: f64,
}

impl Nodes {
    pub fn new(file: &GltfFile<'_>) -> Result<Self, BodyError> {
        let count = file.document.nodes().count();
        let mut parents = vec![None; count];
        let mut locals = Vec::with_capacity(count);
        for node in file.document.nodes() {
            for child in node.children() {
                if parents[child.index()].replace(node.index()).is_some() {
                    return Err(file.fail(format!("node {} has two parents", child.index())));
                }
            }
            let (t, r, s) = node.transform().decomposed();
            let rotation = DQuat::from_array(r.map(f64::from));
            locals.push(Local {
                translation: DVec3::from_array(t.map(f64::from)),
                rotation: if rotation.length_squared() > 1e-12 { rotation.normalize() } else { DQuat::IDENTITY },
                scale: DVec3::from_array(s.map(f64::from)),
            });
        }
        let mut children = vec![Vec::new(); count];
        let mut order = Vec::with_capacity(count);
        for (node, parent) in parents.iter().enumerate() {
            match parent {
                Some(parent) => children[*parent].push(node),
                None => order.push(node),
            }
        }
        let mut next = 0;
        while let Some(&node) = order.get(next) {
            order.extend(&children[node]);
            next += 1;
        }
        // With one parent each, nodes that no root reaches hang in a circle.
        if order.len() < count {
            return Err(file.fail("the node hierarchy runs in a circle"));
        }
        Ok(Self { locals, parents, order })
    }

    /// `world_from_node` of every node at rest.
    pub fn rest(&self) -> Vec<DMat4> {
        self.world(&self.locals)
    }

    fn world(&self, locals: &[Local]) -> Vec<DMat4> {
        let mut world = vec![DMat4::IDENTITY; locals.len()];
        for &node in &self.order {
            let Local { translation, rotation, scale } = locals[node];
            let parent_from_node = DMat4::from_scale_rotation_translation(scale, rotation, translation);
            world[node] = self.parents[node].map_or(DMat4::IDENTITY, |parent| world[parent]) * parent_from_node;
        }
        world
    }

    /// Time in nanoseconds and `world_from_node` of every node at each key of the first animation.
    /// Empty when there is no animation or it moves no node.
    pub fn animated(&self, file: &GltfFile<'_>) -> Result<Vec<(i64, Vec<DMat4>)>, BodyError> {
        let Some(animation) = file.document.animations().next() else { return Ok(Vec::new()) };
        let mut curves = Vec::new();
        for channel in animation.channels() {
            let what = format!("animation channel {}", channel.index());
            let property = channel.target().property();
            let output = channel.sampler().output();
            let values: Vec<[f64; 4]> = match property {
                Property::Rotation => file.finite::<4>(&output, &what)?,
                Property::Translation | Property::Scale => {
                    file.finite::<3>(&output, &what)?.into_iter().map(|[x, y, z]| [x, y, z, 0.0]).collect()
                }
                Property::MorphTargetWeights => continue,
            };
            let times = file.finite::<1>(&channel.sampler().input(), &what)?;
            let nanos: Vec<i64> = times.iter().map(|[secs]| (secs * 1e9).round() as i64).collect();
            if nanos.is_empty() || nanos.windows(2).any(|pair| pair[0] >= pair[1]) {
                return Err(file.fail(format!("the key times of {what} do not grow")));
            }
            let interpolation = channel.sampler().interpolation();
            let values_per_key = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
            if values.len() != nanos.len() * values_per_key {
                let (values, keys) = (values.len(), nanos.len());
                return Err(file.fail(format!("{what} has {values} values for {keys} keys")));
            }
            curves.push(Curve { node: channel.target().node().index(), property, nanos, values, interpolation });
        }
        let mut nanos: Vec<i64> = curves.iter().flat_map(Curve::times_needed).collect();
        nanos.sort_unstable();
        nanos.dedup();
        let pose = |at: i64| {
            let mut locals = self.locals.clone();
            for curve in &curves {
                let value = curve.at(at);
                let xyz = DVec3::new(value[0], value[1], value[2]);
                match curve.property {
                    Property::Rotation => locals[curve.node].rotation = unit(value),
                    Property::Scale => locals[curve.node].scale = xyz,
                    _ => locals[curve.node].translation = xyz,
                }
            }
            (at, self.world(&locals))
        };
        Ok(nanos.into_iter().map(pose).collect())
    }
}

impl Placement {
    /// None when the matrix shears, mirrors or scales its axes differently (by more than 1 %).
    pub fn from_matrix(matrix: &DMat4) -> Option<Self> {
        let linear = DMat3::from_mat4(*matrix);
        let scale = linear.determinant().cbrt();
        if !(scale.is_finite() && scale > 1e-9) {
            return None;
        }
        let rotation = linear * (1.0 / scale);
        let error = rotation.transpose() * rotation - DMat3::IDENTITY;
        let even = error.to_cols_array().iter().all(|x| x.abs() < 0.02);
        let translation = matrix.w_axis.truncate();
        even.then(|| Self { rotation: DQuat::from_mat3(&rotation).normalize(), translation, scale })
    }
}

struct Curve {
    node: usize,
    property: Property,
    nanos: Vec<i64>,
    /// Per key one value, or in-tangent, value and out-tangent.
    values: Vec<[f64; 4]>,
    interpolation: Interpolation,
}

impl Curve {
    /// Where a track with straight pieces has to have keys to follow this curve.
    fn times_needed(&self) -> Vec<i64> {
        let mut times = self.nanos.clone();
        for pair in self.nanos.windows(2) {
            match self.interpolation {
                Interpolation::Linear => {}
                Interpolation::Step => times.push((pair[1] - 1).max(pair[0])),
                Interpolation::CubicSpline => {
                    let pieces = (pair[1] - pair[0]) / CUBIC_STEP_NANOS + 1;
                    // A gap of minutes between two keys does not need thousands of poses.
                    let pieces = pieces.min(1000);
                    times.extend((1..pieces).map(|i| pair[0] + (pair[1] - pair[0]) * i / pieces));
                }
            }
        }
        times
    }

    fn at(&self, nanos: i64) -> [f64; 4] {
        let next = self.nanos.partition_point(|&t| t <= nanos);
        let cubic = self.interpolation == Interpolation::CubicSpline;
        let value = |key: usize| self.values[if cubic { key * 3 + 1 } else { key }];
        if next == 0 {
            return value(0);
        }
        let key = next - 1;
        if next == self.nanos.len() || self.interpolation == Interpolation::Step {
            return value(key);
        }
        let span = (self.nanos[next] - self.nanos[key]) as f64;
        let t = (nanos - self.nanos[key]) as f64 / span;
        let (a, b) = (value(key), value(next));
        if cubic {
            // Hermite spline of the glTF 2.0 specification, appendix C; tangents are per second.
            let (out_tangent, in_tangent) = (self.values[key * 3 + 2], self.values[next * 3]);
            let secs = span * 1e-9;
            let (t2, t3) = (t * t, t * t * t);
            return std::array::from_fn(|i| {
                (2.0 * t3 - 3.0 * t2 + 1.0) * a[i]
                    + secs * (t3 - 2.0 * t2 + t) * out_tangent[i]
                    + (3.0 * t2 - 2.0 * t3) * b[i]
                    + secs * (t3 - t2) * in_tangent[i]
            });
        }
        match self.property {
            Property::Rotation => unit(a).slerp(unit(b), t).to_array(),
            _ => std::array::from_fn(|i| a[i] + (b[i] - a[i]) * t),
        }
    }
}

fn unit(xyzw: [f64; 4]) -> DQuat {
    let q = DQuat::from_array(xyzw);
    if q.length_squared() > 1e-12 { q.normalize() } else { DQuat::IDENTITY }
}

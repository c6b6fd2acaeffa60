//! Node hierarchy of a glTF file: transforms at rest and in an animation.

use glam::{DMat3, DMat4, DQuat, DVec3};
use gltf::animation::{Interpolation, Property};

use crate::BodyError;
use crate::gltf_file::GltfFile;
use crate::gltf_json::shown;
use crate::gltf_limits::{MAX_ANIMATION_KEYS, MAX_KEY_SECS, MAX_NODES, MAX_POSED_NODES};

/// Interval of poses between two keys of a cubic curve, nanoseconds.
const CUBIC_STEP_NANOS: i64 = 1_000_000_000 / 120;

/// Least rotation of a joint, radians, and least way as a part of the longest bone by which an animation moves.
const MOVES_RAD: f64 = 0.05;
const MOVES_PART: f64 = 0.02;

/// Animations that a message names.
const SHOWN: usize = 8;

/// Transform of a node in its parent: translation, rotation, scale.
#[derive(Debug, Clone, Copy)]
struct Local {
    translation: DVec3,
    rotation: DQuat,
    scale: DVec3,
}

/// All nodes of a file, in file order.
pub(crate) struct Nodes {
    locals: Vec<Local>,
    pub parents: Vec<Option<usize>>,
    /// Node indices, parents before children.
    pub order: Vec<usize>,
}

/// Permitted pose of a joint in the world: rotation, translation and one scale.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Placement {
    pub rotation: DQuat,
    pub translation: DVec3,
    pub scale: f64,
}

impl Nodes {
    pub fn new(file: &GltfFile<'_>) -> Result<Self, BodyError> {
        let count = file.document.nodes().count();
        file.check_count("nodes", count, MAX_NODES)?;
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
        // Each node has one parent, so nodes that no root reaches form a cycle.
        if order.len() < count {
            return Err(file.fail("the node hierarchy runs in a circle"));
        }
        Ok(Self { locals, parents, order })
    }

    /// Returns `world_from_node` of all nodes at rest.
    pub fn rest(&self) -> Vec<DMat4> {
        let mut world = vec![DMat4::IDENTITY; self.locals.len()];
        self.update_world(&self.order, &self.locals, &mut world);
        world
    }

    /// Computes `world_from_node` of some nodes; the parent of each stands before it in `order`.
    fn update_world(&self, order: &[usize], locals: &[Local], world: &mut [DMat4]) {
        for &node in order {
            let Local { translation, rotation, scale } = locals[node];
            let parent_from_node = DMat4::from_scale_rotation_translation(scale, rotation, translation);
            world[node] = self.parents[node].map_or(DMat4::IDENTITY, |parent| world[parent]) * parent_from_node;
        }
    }

    /// Returns the joints and the nodes above them, parents before children.
    fn moving(&self, joint_nodes: &[usize]) -> Vec<usize> {
        let mut moves = vec![false; self.parents.len()];
        for &joint in joint_nodes {
            let mut next = Some(joint);
            while let Some(node) = next.filter(|&node| !moves[node]) {
                moves[node] = true;
                next = self.parents[node];
            }
        }
        self.order.iter().copied().filter(|&node| moves[node]).collect()
    }

    /// Calls `pose` with the time in nanoseconds and `world_from_node` of the joints and the nodes above them, for each
    /// key of the chosen animation in order of time; not at all without an animation that concerns a joint. Matrices of other nodes
    /// have no meaning.
    pub fn animate(
        &self,
        file: &GltfFile<'_>,
        joint_nodes: &[usize],
        mut pose: impl FnMut(i64, &[DMat4]) -> Result<(), BodyError>,
    ) -> Result<(), BodyError> {
        let moving = self.moving(joint_nodes);
        let curves = self.choose(file, &moving)?;
        let (mut locals, mut world) = (self.locals.clone(), vec![DMat4::IDENTITY; self.locals.len()]);
        for at in pose_times(file, &curves, moving.len())? {
            for curve in &curves {
                let value = curve.at(at);
                let xyz = DVec3::new(value[0], value[1], value[2]);
                match curve.property {
                    Property::Rotation => locals[curve.node].rotation = unit(value),
                    Property::Scale => locals[curve.node].scale = xyz,
                    _ => locals[curve.node].translation = xyz,
                }
            }
            self.update_world(&moving, &locals, &mut world);
            pose(at, &world)?;
        }
        Ok(())
    }

    /// Returns the first animation that moves these nodes, or else the first that concerns them. Says which, where there are several.
    fn choose(&self, file: &GltfFile<'_>, moving: &[usize]) -> Result<Vec<Curve>, BodyError> {
        let size = moving.iter().map(|&node| self.locals[node].translation.length()).fold(0.0, f64::max);
        let mut keys = 0usize;
        let mut still: Option<(usize, Vec<Curve>)> = None;
        let mut chosen = None;
        for animation in file.document.animations() {
            // Many animations may share their keys; those that are looked at stay within the limit of one.
            if keys > 0 && keys.saturating_add(count_keys(&animation)) > MAX_ANIMATION_KEYS {
                break;
            }
            let curves = self.curves(file, &animation, moving, &mut keys)?;
            if curves.iter().any(|curve| curve.moves(size)) {
                chosen = Some((animation.index(), curves));
                break;
            }
            still = still.or((!curves.is_empty()).then(|| (animation.index(), curves)));
        }
        let Some((index, curves)) = chosen.or(still) else { return Ok(Vec::new()) };
        let names: Vec<String> =
            file.document.animations().take(SHOWN).map(|animation| animation_name(&animation)).collect();
        let count = file.document.animations().count();
        if count > 1 {
            let name =
                file.document.animations().nth(index).map(|animation| animation_name(&animation)).unwrap_or_default();
            tracing::info!(
                "{}: animation {name} is taken, number {} of {count} ({}{}), the first that moves the body",
                file.path.display(),
                index + 1,
                names.join(", "),
                if count > names.len() { ", ..." } else { "" }
            );
        }
        Ok(curves)
    }

    /// Reads the channels of an animation that move one of these nodes, and adds the number of their keys to `keys`.
    fn curves(
        &self,
        file: &GltfFile<'_>,
        animation: &gltf::Animation<'_>,
        moving: &[usize],
        keys: &mut usize,
    ) -> Result<Vec<Curve>, BodyError> {
        let mut is_free: Vec<Option<[bool; 3]>> = vec![None; self.parents.len()];
        for &node in moving {
            is_free[node] = Some([true; 3]);
        }
        // Everything is counted before it is read.
        let mut channels = Vec::new();
        for channel in animation.channels() {
            let what = format!("animation channel {}", channel.index());
            let node = channel.target().node().index();
            let slot = match channel.target().property() {
                Property::Translation => 0,
                Property::Rotation => 1,
                Property::Scale => 2,
                Property::MorphTargetWeights => continue,
            };
            let Some(is_free) = &mut is_free[node] else { continue };
            // Without this, channels that share their data would multiply it.
            if !std::mem::take(&mut is_free[slot]) {
                return Err(file.fail(format!("{what} moves the same property of node {node} as another one")));
            }
            *keys = keys.saturating_add(channel.sampler().input().count());
            file.check_count(&format!("keys up to {what}"), *keys, MAX_ANIMATION_KEYS)?;
            channels.push((channel, node, what));
        }
        let curve = |(channel, node, what): (gltf::animation::Channel<'_>, usize, String)| {
            let (property, interpolation) = (channel.target().property(), channel.sampler().interpolation());
            let (input, output) = (channel.sampler().input(), channel.sampler().output());
            let values_per_key = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
            let (keys, values) = (input.count(), output.count());
            if values != keys * values_per_key {
                return Err(file.fail(format!("{what} has {values} values for {keys} keys")));
            }
            let values: Vec<[f64; 4]> = match property {
                Property::Rotation => file.finite::<4>(&output, &what, values)?,
                _ => file.finite::<3>(&output, &what, values)?.into_iter().map(|[x, y, z]| [x, y, z, 0.0]).collect(),
            };
            let times = file.finite::<1>(&input, &what, keys)?;
            if let Some([secs]) = times.iter().find(|[secs]| secs.abs() > MAX_KEY_SECS) {
                return Err(file.fail(format!("{what} has a key at {secs} s, at most {MAX_KEY_SECS} s are allowed")));
            }
            let nanos: Vec<i64> = times.iter().map(|[secs]| (secs * 1e9).round() as i64).collect();
            if nanos.is_empty() || nanos.windows(2).any(|pair| pair[0] >= pair[1]) {
                return Err(file.fail(format!("the key times of {what} do not grow")));
            }
            Ok(Curve { node, property, nanos, values, interpolation })
        };
        channels.into_iter().map(curve).collect()
    }
}

fn count_keys(animation: &gltf::Animation<'_>) -> usize {
    animation.channels().map(|channel| channel.sampler().input().count()).fold(0, usize::saturating_add)
}

fn animation_name(animation: &gltf::Animation<'_>) -> String {
    animation.name().map_or_else(|| format!("{} (unnamed)", animation.index()), |name| format!("'{}'", shown(name)))
}

/// Returns the times of the track's poses, increasing, so that linear interpolation follows all curves.
fn pose_times(file: &GltfFile<'_>, curves: &[Curve], moving: usize) -> Result<Vec<i64>, BodyError> {
    let limit = MAX_POSED_NODES / moving.max(1);
    let what = format!("poses of an animation of {moving} nodes");
    let mut nanos = Vec::new();
    for curve in curves {
        // Counted first: a cubic curve has up to a thousand per key.
        file.check_count(&what, curve.count_needed(), limit)?;
        nanos.extend(curve.times_needed());
        // Merges the sorted runs.
        nanos.sort();
        nanos.dedup();
        file.check_count(&what, nanos.len(), limit)?;
    }
    Ok(nanos)
}

impl Placement {
    /// Decomposes a matrix; `None` when it shears, mirrors or scales its axes differently (by more than 1 %).
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
    /// One value per key, or in-tangent, value and out-tangent.
    values: Vec<[f64; 4]>,
    interpolation: Interpolation,
}

impl Curve {
    /// Returns the number of linear pieces that follow a cubic curve between two keys.
    fn pieces(pair: &[i64]) -> i64 {
        // A gap of minutes between two keys does not need thousands of poses.
        ((pair[1] - pair[0]) / CUBIC_STEP_NANOS + 1).min(1000)
    }

    /// Returns the length of [`Self::times_needed`].
    fn count_needed(&self) -> usize {
        let between = match self.interpolation {
            Interpolation::Linear => 0,
            Interpolation::Step => self.nanos.len() - 1,
            Interpolation::CubicSpline => self.nanos.windows(2).map(|pair| (Self::pieces(pair) - 1) as usize).sum(),
        };
        self.nanos.len() + between
    }

    /// Returns the times at which a linearly interpolated track needs keys to follow this curve.
    fn times_needed(&self) -> Vec<i64> {
        let mut times = self.nanos.clone();
        for pair in self.nanos.windows(2) {
            match self.interpolation {
                Interpolation::Linear => {}
                Interpolation::Step => times.push((pair[1] - 1).max(pair[0])),
                Interpolation::CubicSpline => {
                    let pieces = Self::pieces(pair);
                    times.extend((1..pieces).map(|i| pair[0] + (pair[1] - pair[0]) * i / pieces));
                }
            }
        }
        times
    }

    /// Returns the value of a key.
    fn value(&self, key: usize) -> [f64; 4] {
        self.values[if self.interpolation == Interpolation::CubicSpline { key * 3 + 1 } else { key }]
    }

    /// Returns whether the node turns or goes visibly, in a skeleton whose longest bone is `size` long.
    fn moves(&self, size: f64) -> bool {
        let first = self.value(0);
        (1..self.nanos.len()).map(|key| self.value(key)).any(|value| match self.property {
            Property::Rotation => unit(first).angle_between(unit(value)) > MOVES_RAD,
            Property::Translation => {
                DVec3::from_slice(&first).distance(DVec3::from_slice(&value)) > MOVES_PART * size.max(1e-9)
            }
            _ => false,
        })
    }

    fn at(&self, nanos: i64) -> [f64; 4] {
        let next = self.nanos.partition_point(|&t| t <= nanos);
        let cubic = self.interpolation == Interpolation::CubicSpline;
        let value = |key: usize| self.value(key);
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

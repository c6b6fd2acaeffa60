//! Corrections of the pose itself, so that its errors are not taken for cloth.

use flyrig_body::{Skeleton, SkinWeights, skin_jacobian_f64};
use flyrig_types::Pose;
use glam::{DMat3, DMat4, DQuat, DVec3};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Joints that move less of the body than this share of the nodes are left alone: a finger's turn cannot be told.
const LEAST_SHARE: f64 = 0.008;
/// No joint is turned by more, radians, and the root is not shifted farther, metres.
const MAX_TURN: f64 = 0.35;
const MAX_SHIFT_M: f64 = 0.15;

/// How freely the pose may be corrected: `(turn |ω|² + hold |ω - ω_before|²)` a joint and the same for the root's shift
/// are added to the loss. No joint is turned by more than 0.35 radians, and the root not shifted by more than 0.15 metres:
/// unlike the nodes' limits these are a person's, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseFreedom {
    /// Price of a joint's turn, units of loss a square radian.
    pub turn: f64,
    /// Price of the root's shift, units of loss a square metre.
    pub shift: f64,
    /// Price of a change from the last frame's correction, as a multiple of the two above.
    pub hold: f64,
}

impl Default for PoseFreedom {
    fn default() -> Self {
        Self { turn: 100.0, shift: 1e4, hold: 1.0 }
    }
}

/// What is added to a pose.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PoseCorrection {
    /// Added to the root's place, world metres.
    pub shift: DVec3,
    /// Rotation vector of each joint in its own axes, radians.
    pub turns: Vec<DVec3>,
}

impl PoseCorrection {
    /// The corrected pose.
    #[must_use]
    pub fn apply(&self, pose: &Pose) -> Pose {
        let turned = |(joint, rotation): (usize, &DQuat)| match self.turns.get(joint) {
            Some(turn) if *turn != DVec3::ZERO => (*rotation * DQuat::from_scaled_axis(*turn)).normalize(),
            _ => *rotation,
        };
        Pose {
            root_translation: pose.root_translation + self.shift,
            joint_rotations: pose.joint_rotations.iter().enumerate().map(turned).collect(),
        }
    }
}

/// The correction over time.
#[derive(Debug)]
pub(super) struct PoseFix {
    freedom: PoseFreedom,
    parents: Vec<Option<usize>>,
    /// Joints that may turn.
    joints: Vec<usize>,
    nodes: Vec<(DVec3, SkinWeights)>,
    pub now: PoseCorrection,
    before: PoseCorrection,
}

/// What each unknown of the pose does to each node: nodes' canonical motion `M p`, with the root's shift as unknown 0
/// and the free joints after it.
pub(super) struct Basis {
    /// By node: (unknown, derivative).
    pub of_node: Vec<Vec<(usize, DMat3)>>,
    pub unknowns: usize,
}

impl PoseFix {
    pub(super) fn new(skeleton: &Skeleton, nodes: Vec<(DVec3, SkinWeights)>, freedom: PoseFreedom) -> Self {
        let parents: Vec<Option<usize>> = skeleton.joints().iter().map(|joint| joint.parent).collect();
        let mut share = vec![0.0; parents.len()];
        for (_, skin) in &nodes {
            for (&joint, &weight) in skin.joints.iter().zip(&skin.weights) {
                let mut at = Some(usize::from(joint));
                while let Some(joint) = at.filter(|&joint| joint < parents.len()) {
                    share[joint] += f64::from(weight) / nodes.len() as f64;
                    at = parents[joint];
                }
            }
        }
        let joints = (0..parents.len()).filter(|&joint| share[joint] > LEAST_SHARE).collect();
        let now = PoseCorrection { shift: DVec3::ZERO, turns: vec![DVec3::ZERO; parents.len()] };
        Self { freedom, parents, joints, nodes, before: now.clone(), now }
    }

    pub(super) fn reset(&mut self) {
        self.now.shift = DVec3::ZERO;
        self.now.turns.fill(DVec3::ZERO);
        self.before = self.now.clone();
    }

    /// A frame is over.
    pub(super) fn next_frame(&mut self) {
        self.before = self.now.clone();
    }

    fn prices(&self) -> impl Iterator<Item = f64> + '_ {
        std::iter::once(self.freedom.shift).chain(self.joints.iter().map(|_| self.freedom.turn))
    }

    fn values<'a>(&'a self, of: &'a PoseCorrection) -> impl Iterator<Item = DVec3> + 'a {
        std::iter::once(of.shift).chain(self.joints.iter().map(|&joint| of.turns[joint]))
    }

    /// Price of the correction, and its half second derivative a unknown.
    pub(super) fn loss(&self) -> f64 {
        let pairs = self.values(&self.now).zip(self.values(&self.before)).zip(self.prices());
        pairs
            .map(|((now, old), price)| {
                price * (now.length_squared() + self.freedom.hold * (now - old).length_squared())
            })
            .sum()
    }

    pub(super) fn gradient(&self) -> Vec<DVec3> {
        let pairs = self.values(&self.now).zip(self.values(&self.before)).zip(self.prices());
        pairs.map(|((now, old), price)| 2.0 * price * (now + self.freedom.hold * (now - old))).collect()
    }

    pub(super) fn stiffness(&self) -> Vec<f64> {
        self.prices().map(|price| 2.0 * price * (1.0 + self.freedom.hold)).collect()
    }

    /// Adds `share` of a step of the unknowns.
    pub(super) fn step(&mut self, step: &[DVec3], share: f64) {
        let Some((shift, turns)) = step.split_first() else { return };
        self.now.shift = (self.now.shift + *shift * share).clamp_length_max(MAX_SHIFT_M);
        for (&joint, turn) in self.joints.iter().zip(turns) {
            let value = &mut self.now.turns[joint];
            *value = (*value + *turn * share).clamp_length_max(MAX_TURN);
        }
    }

    /// At an instant's skinning and joint matrices (`world_from_joint`), with the nodes moved by `translations`. Empty
    /// when the matrices do not fit.
    pub(super) fn basis(&self, world_from_canonical: &[DMat4], world_from_joint: &[DMat4], moved: &[DVec3]) -> Basis {
        let unknowns = 1 + self.joints.len();
        let mut number = vec![None; self.parents.len()];
        for (k, &joint) in self.joints.iter().enumerate() {
            number[joint] = Some(k + 1);
        }
        let fits = world_from_joint.len() == self.parents.len() && world_from_canonical.len() == self.parents.len();
        let of_node = |((point, skin), moved): (&(DVec3, SkinWeights), &DVec3)| {
            let canonical_from_world = skin_jacobian_f64(world_from_canonical, skin).inverse();
            if !fits || !canonical_from_world.is_finite() {
                return Vec::new();
            }
            // Below each joint: the sum of w and of w * place.
            let mut levers: Vec<(usize, f64, DVec3)> = Vec::new();
            for (&joint, &weight) in skin.joints.iter().zip(&skin.weights) {
                let (joint, weight) = (usize::from(joint), f64::from(weight));
                if weight <= 0.0 || joint >= self.parents.len() {
                    continue;
                }
                let place = world_from_canonical[joint].transform_point3(*point + *moved) * weight;
                let mut at = Some(joint);
                while let Some(joint) = at {
                    match levers.iter_mut().find(|(known, ..)| *known == joint) {
                        Some((_, sum, places)) => {
                            *sum += weight;
                            *places += place;
                        }
                        None => levers.push((joint, weight, place)),
                    }
                    at = self.parents[joint];
                }
            }
            let mut entries = vec![(0, canonical_from_world)];
            for (joint, weight, places) in levers {
                let Some(unknown) = number[joint] else { continue };
                let (axes, origin) = (world_from_joint[joint], world_from_joint[joint].w_axis.truncate());
                let lever = places - origin * weight;
                // Ω x lever, Ω in the world.
                let cross = |axis: DVec3| axis.cross(lever);
                let turned = DMat3::from_cols(
                    cross(axes.x_axis.truncate()),
                    cross(axes.y_axis.truncate()),
                    cross(axes.z_axis.truncate()),
                );
                entries.push((unknown, canonical_from_world * turned));
            }
            entries
        };
        Basis { of_node: self.nodes.iter().zip(moved).map(of_node).collect(), unknowns }
    }
}

impl Basis {
    /// `x + M p`.
    pub(super) fn moved(&self, x: &[DVec3], p: &[DVec3]) -> Vec<DVec3> {
        let one = |(x, entries): (&DVec3, &Vec<(usize, DMat3)>)| {
            entries.iter().fold(*x, |sum, (unknown, m)| sum + *m * p[*unknown])
        };
        x.iter().zip(&self.of_node).map(one).collect()
    }

    /// `M^T g`.
    pub(super) fn gathered(&self, g: &[DVec3]) -> Vec<DVec3> {
        let mut sums = vec![DVec3::ZERO; self.unknowns];
        for (g, entries) in g.iter().zip(&self.of_node) {
            for (unknown, m) in entries {
                sums[*unknown] += m.transpose() * *g;
            }
        }
        sums
    }

    /// Factors of about `M^T H M + stiffness`, with each node's row of H added up into `rows`: neighbours move alike.
    pub(super) fn factors(&self, rows: &[DMat3], stiffness: &[f64]) -> Option<Cholesky<f64, Dyn>> {
        let size = 3 * self.unknowns;
        let mut dense = DMatrix::zeros(size, size);
        for (row, entries) in rows.iter().zip(&self.of_node) {
            for (a, ma) in entries {
                let left = ma.transpose() * *row;
                for (b, mb) in entries {
                    let block = left * *mb;
                    for c in 0..3 {
                        for r in 0..3 {
                            dense[(3 * a + r, 3 * b + c)] += block.col(c)[r];
                        }
                    }
                }
            }
        }
        for (k, price) in stiffness.iter().enumerate() {
            for axis in 0..3 {
                dense[(3 * k + axis, 3 * k + axis)] += price;
            }
        }
        Cholesky::new(dense)
    }
}

/// `factors^-1 r`; r itself, scaled, without factors.
pub(super) fn solve_dense(factors: Option<&Cholesky<f64, Dyn>>, r: &[DVec3], stiffness: &[f64]) -> Vec<DVec3> {
    match factors {
        Some(factors) => {
            let flat = DVector::from_iterator(3 * r.len(), r.iter().flat_map(DVec3::to_array));
            factors.solve(&flat).as_slice().chunks_exact(3).map(DVec3::from_slice).collect()
        }
        None => r.iter().zip(stiffness).map(|(r, price)| *r / price.max(1e-30)).collect(),
    }
}

#[cfg(test)]
#[path = "pose_fix_tests.rs"]
mod tests;

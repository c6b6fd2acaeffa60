//! Forward kinematics and linear blend skinning of a template.

use alloc::vec::Vec;

use crate::{Motion, StreamTemplate, planes::Influences};

/// Gaussians overlap enough to close a surface that is longer than at rest by this factor.
const CLOSED: f32 = 1.25;
/// Most that a Gaussian grows, as a factor.
const MOST_GROWTH: f32 = 4.0;

/// Gaussians in the world; both lists have one element a Gaussian.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Posed {
    /// Centre, metres, and standard deviation, metres.
    pub center_scale: Vec<[f32; 4]>,
    /// Unit normal; w: 0.
    pub normal: Vec<[f32; 4]>,
}

/// Three rows of an affine motion.
type Rows = [[f32; 4]; 3];

impl StreamTemplate {
    /// Poses the Gaussians: world = LBS(x + sum of w t) (FlyHuman Eq. 1 and 2). They grow where the surface around them is longer
    /// than at rest. A motion that lacks joints or nodes leaves them at rest.
    pub fn pose(&self, motion: &Motion, posed: &mut Posed) {
        let matrices = self.world_from_canonical(motion);
        posed.center_scale.clear();
        posed.normal.clear();
        for (i, (&[x, y, z, scale], normal)) in self.center_scale.iter().zip(&self.normals).enumerate() {
            let mut point = [x, y, z];
            let mut growth = 1.0;
            if let Some(nodes) = self.node_weights.get(i) {
                for (node, share) in nodes.index.into_iter().zip(nodes.shares()) {
                    if let Some(by) = motion.nodes.get(node as usize) {
                        for k in 0..3 {
                            point[k] += share * by[k];
                        }
                    }
                }
                growth = self.growth(motion, nodes);
            }
            let mut rows: Rows = [[0.0; 4]; 3];
            let skin = &self.skin[i];
            for (joint, share) in skin.index.into_iter().zip(skin.shares()).filter(|(_, share)| *share > 0.0) {
                for (row, of_joint) in rows.iter_mut().zip(&matrices[joint as usize]) {
                    for k in 0..4 {
                        row[k] += share * of_joint[k];
                    }
                }
            }
            let [px, py, pz] = rows.map(|[a, b, c, d]| a * point[0] + b * point[1] + c * point[2] + d);
            posed.center_scale.push([px, py, pz, growth * scale]);
            let turned = rows.map(|[a, b, c, _]| a * normal[0] + b * normal[1] + c * normal[2]);
            let squared = turned.iter().map(|v| v * v).sum::<f32>();
            let by = if squared > 1e-20 { 1.0 / libm::sqrtf(squared) } else { 0.0 };
            posed.normal.push([turned[0] * by, turned[1] * by, turned[2] * by, 0.0]);
        }
    }

    /// Returns the factor by which a Gaussian grows with the surface between its nodes: the formula and the constants of
    /// `displacement` in the crate `body`, which this crate cannot use (`no_std`).
    fn growth(&self, motion: &Motion, nodes: &Influences) -> f32 {
        let (mut then, mut now) = (0.0, 0.0);
        for (a, b) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
            if nodes.weight[a] == 0 || nodes.weight[b] == 0 {
                continue;
            }
            let (a, b) = (nodes.index[a] as usize, nodes.index[b] as usize);
            let (Some(first), Some(other)) = (self.node_places.get(a), self.node_places.get(b)) else { continue };
            let still = [0.0; 3];
            let (from, to) = (motion.nodes.get(a).unwrap_or(&still), motion.nodes.get(b).unwrap_or(&still));
            for k in 0..3 {
                let apart = other[k] - first[k];
                let moved = apart + to[k] - from[k];
                (then, now) = (then + apart * apart, now + moved * moved);
            }
        }
        let longer = if then > 0.0 && now.is_finite() { libm::sqrtf(now / then) / CLOSED } else { 1.0 };
        longer.clamp(1.0, MOST_GROWTH)
    }

    /// Skinning matrices of all joints.
    fn world_from_canonical(&self, motion: &Motion) -> Vec<Rows> {
        let mut world: Vec<Rows> = Vec::with_capacity(self.joints.len());
        for (i, joint) in self.joints.iter().enumerate() {
            let rotation = motion.joint_rotations.get(i).copied().unwrap_or([0.0, 0.0, 0.0, 1.0]);
            let rows = match joint.parent {
                None => rigid(rotation, motion.root_translation),
                Some(parent) => product(&world[usize::from(parent)], &rigid(rotation, joint.translation)),
            };
            world.push(rows);
        }
        world.iter().zip(&self.joints).map(|(world, joint)| product(world, &joint.joint_from_canonical)).collect()
    }
}

/// Of a unit quaternion x, y, z, w and a translation.
fn rigid([x, y, z, w]: [f32; 4], [tx, ty, tz]: [f32; 3]) -> Rows {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w), tx],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w), ty],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y), tz],
    ]
}

fn product(a: &Rows, b: &Rows) -> Rows {
    a.map(|row| {
        core::array::from_fn(|k| {
            let moved = if k == 3 { row[3] } else { 0.0 };
            row[0] * b[0][k] + row[1] * b[1][k] + row[2] * b[2][k] + moved
        })
    })
}

//! Forward kinematics and linear blend skinning of a template.

use alloc::vec::Vec;

use flyrig_model::{quaternion, stretch};

use crate::{motion::Motion, planes::spread, template::StreamTemplate};

/// Posed Gaussians in the world; both lists have one element per Gaussian.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Posed {
    /// Centre, metres, and standard deviation, metres.
    pub center_scale: Vec<[f32; 4]>,
    /// Unit normal; w: 0.
    pub normal: Vec<[f32; 4]>,
}

/// Node in canonical space.
#[derive(Clone, Copy)]
struct Node {
    /// Position, metres.
    place: [f32; 3],
    /// Translation from its position at rest, metres.
    by: [f32; 3],
}

impl Node {
    fn new(rest: [f32; 3], motion: &Motion, node: usize) -> Self {
        let by = motion.nodes.get(node).copied().unwrap_or_default();
        Self { place: core::array::from_fn(|k| rest[k] + by[k]), by }
    }
}

/// Three rows of an affine transform.
type Rows = [[f32; 4]; 3];

impl StreamTemplate {
    /// Poses the Gaussians: world = LBS(x + sum of w t) (FlyHuman Eq. 1 and 2). They grow where the surface around them is stretched. Joints
    /// and nodes that the motion lacks stay at rest.
    pub fn pose(&self, motion: &Motion, posed: &mut Posed) {
        let matrices = self.world_from_canonical(motion);
        let nodes: Vec<Node> =
            self.node_places.iter().enumerate().map(|(i, place)| Node::new(*place, motion, i)).collect();
        posed.center_scale.resize(self.gaussians(), [0.0; 4]);
        posed.normal.resize(self.gaussians(), [0.0; 4]);
        let at_rest = self.center_scale.iter().zip(&self.normals).zip(&self.skin);
        let into = posed.center_scale.iter_mut().zip(&mut posed.normal);
        for (i, (((&[x, y, z, scale], normal), skin), (center_scale, turned))) in at_rest.zip(into).enumerate() {
            let mut point = [x, y, z];
            let mut growth = 1.0;
            if let (Some(on), Some(rest)) = (self.node_weights.get(i), self.rest_spread.get(i)) {
                for (node, share) in on.shares() {
                    for (value, by) in point.iter_mut().zip(nodes[node].by) {
                        *value += share * by;
                    }
                }
                growth = stretch::growth(*rest, spread(on, |node| nodes[node].place), libm::sqrtf);
            }
            let mut rows: Rows = [[0.0; 4]; 3];
            for (joint, share) in skin.shares() {
                for (row, of_joint) in rows.iter_mut().zip(&matrices[joint]) {
                    for k in 0..4 {
                        row[k] += share * of_joint[k];
                    }
                }
            }
            let [px, py, pz] = rows.map(|[a, b, c, d]| a * point[0] + b * point[1] + c * point[2] + d);
            *center_scale = [px, py, pz, growth * scale];
            let [nx, ny, nz] = rows.map(|[a, b, c, _]| a * normal[0] + b * normal[1] + c * normal[2]);
            let squared = nx * nx + ny * ny + nz * nz;
            let by = if squared > 1e-20 { 1.0 / libm::sqrtf(squared) } else { 0.0 };
            *turned = [nx * by, ny * by, nz * by, 0.0];
        }
    }

    /// Returns the skinning matrices of all joints.
    pub(crate) fn world_from_canonical(&self, motion: &Motion) -> Vec<Rows> {
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

/// Returns the rigid transform of a unit quaternion x, y, z, w and a translation.
fn rigid(rotation: [f32; 4], [tx, ty, tz]: [f32; 3]) -> Rows {
    let [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = quaternion::matrix(rotation);
    [[xx, xy, xz, tx], [yx, yy, yz, ty], [zx, zy, zz, tz]]
}

fn product(a: &Rows, b: &Rows) -> Rows {
    a.map(|row| {
        core::array::from_fn(|k| {
            let moved = if k == 3 { row[3] } else { 0.0 };
            row[0] * b[0][k] + row[1] * b[1][k] + row[2] * b[2][k] + moved
        })
    })
}

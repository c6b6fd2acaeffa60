//! Small person for tests.

use std::vec::Vec;

use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

use crate::{EncodedTemplate, Motion, Stamp, StreamJoint, TemplateSource};

/// Lists of a person that a source borrows.
pub(crate) struct Person {
    pub joints: Vec<StreamJoint>,
    pub center_scale: Vec<[f32; 4]>,
    pub normals: Vec<[f32; 3]>,
    pub skin: Vec<([u32; 4], [f32; 4])>,
    pub node_weights: Vec<([u32; 4], [f32; 4])>,
    pub nodes: Vec<[f32; 3]>,
}

impl Person {
    /// Creates a tube of three joints, 1.5 m tall.
    pub fn tube(count: usize, nodes: usize) -> Self {
        let mut random = StdRng::seed_from_u64(11);
        let joint = |i: usize| StreamJoint {
            parent: i.checked_sub(1).map(|p| p as u16),
            translation: if i == 0 { [0.0; 3] } else { [0.0, 0.5, 0.0] },
            joint_from_canonical: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, -0.5 * i as f32], [0.0, 0.0, 1.0, 0.0]],
        };
        let mut person = Self {
            joints: (0..3).map(joint).collect(),
            center_scale: Vec::new(),
            normals: Vec::new(),
            skin: Vec::new(),
            node_weights: Vec::new(),
            nodes: (0..nodes).map(|_| [random.random(), random.random(), random.random()]).collect(),
        };
        for _ in 0..count {
            let (angle, y) = (random.random_range(0.0..std::f32::consts::TAU), random.random_range(0.0f32..1.5));
            let (x, z) = (angle.cos(), angle.sin());
            person.center_scale.push([0.2 * x, y, 0.2 * z, random.random_range(0.002..0.004)]);
            person.normals.push([x, 0.0, z]);
            let joint = (y / 0.5) as u32;
            let share = (y / 0.5).fract();
            person.skin.push(([joint, (joint + 1).min(2), 0, 0], [1.0 - share, share, 0.0, 0.0]));
            if nodes > 0 {
                let indices = [0; 4].map(|_| random.random_range(0..nodes as u32));
                person.node_weights.push((indices, random.random()));
            }
        }
        person
    }

    pub fn source(&self) -> TemplateSource<'_> {
        TemplateSource {
            joints: &self.joints,
            center_scale: &self.center_scale,
            normals: &self.normals,
            skin: &self.skin,
            node_weights: &self.node_weights,
            nodes: &self.nodes,
        }
    }

    pub fn encode(&self) -> EncodedTemplate {
        self.source().encode().unwrap()
    }

    /// Returns a random motion in the source's order.
    pub fn motion(&self, seed: u64) -> Motion {
        let mut random = StdRng::seed_from_u64(seed);
        let rotations = self.joints.iter().map(|_| {
            let v: [f32; 4] = [0; 4].map(|_| random.random_range(-0.4f32..0.4));
            let v = [v[0], v[1], v[2], 1.0];
            let length = v.iter().map(|v| v * v).sum::<f32>().sqrt();
            v.map(|v| v / length)
        });
        let joint_rotations = rotations.collect();
        Motion {
            stamp: Stamp { person: 3, frame: seed, capture_nanos: 5, template: 0 },
            root_translation: [1.0, -2.0, 0.5],
            joint_rotations,
            nodes: self.nodes.iter().map(|_| [0; 3].map(|_| random.random_range(-0.02..0.02))).collect(),
        }
    }

    /// Returns smooth colours with some grain, in the source's order, that drift with `time`.
    pub fn colors(&self, time: f32) -> Vec<[f32; 4]> {
        let color = |(i, splat): (usize, &[f32; 4])| {
            let [x, y, z, _] = *splat;
            let grain = 0.02 * ((i * 7919 % 101) as f32 / 101.0);
            let wave = |by: f32| 0.4 + 0.3 * (by * (x + 2.0 * y + 3.0 * z) + time).sin() + grain;
            [wave(3.0), wave(5.0), wave(9.0), 1.0]
        };
        self.center_scale.iter().enumerate().map(color).collect()
    }
}

/// Calls `each` with the message as it is, cut short at every tenth byte, and with bytes changed at random.
pub(crate) fn damaged(bytes: &[u8], rounds: usize, mut each: impl FnMut(&[u8])) {
    let mut random = StdRng::seed_from_u64(12);
    for end in (0..bytes.len()).step_by(10) {
        each(&bytes[..end]);
    }
    for _ in 0..rounds {
        let mut changed = bytes.to_vec();
        for _ in 0..random.random_range(1..8) {
            // Headers more often than payloads.
            let end = if random.random() { changed.len() } else { changed.len().min(64) };
            let at = random.random_range(0..end);
            changed[at] = if random.random() { random.random() } else { 255 };
        }
        each(&changed);
    }
    each(&[]);
}

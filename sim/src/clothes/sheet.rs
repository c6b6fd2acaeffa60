//! Surfaces on the body: subdivision, smoothing, cutting and thickening.

use std::collections::HashMap;

use flyrig_body::{Part, SkinWeights, Template};
use glam::{Vec2, Vec3};

/// Vertex of a surface on the body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Node {
    /// Canonical position of the surface, metres.
    pub position: Vec3,
    /// Canonical position of the body point that carries it, metres.
    pub body: Vec3,
    /// Position of that point on the average body, by which everything is cut and painted, metres.
    pub average: Vec3,
    pub uv: Vec2,
    pub skin: SkinWeights,
    pub part: Part,
    /// Free length, metres; 0 where it is fixed (see [`crate::clothes::loose`]).
    pub free_m: f32,
}

impl Node {
    fn mix(&self, other: &Self, t: f32) -> Self {
        Self {
            position: self.position.lerp(other.position, t),
            body: self.body.lerp(other.body, t),
            average: self.average.lerp(other.average, t),
            uv: self.uv.lerp(other.uv, t),
            skin: mix_skin(&self.skin, &other.skin, t),
            part: if t < 0.5 { self.part } else { other.part },
            free_m: self.free_m + (other.free_m - self.free_m) * t,
        }
    }
}

/// Triangle mesh of nodes.
#[derive(Debug, Clone, Default)]
pub(crate) struct Sheet {
    pub nodes: Vec<Node>,
    pub triangles: Vec<[u32; 3]>,
}

impl Sheet {
    /// Returns the body itself; `average` holds the positions of the average body.
    pub(crate) fn of_body(template: &Template, average: &[Vec3]) -> Self {
        let nodes = template
            .positions
            .iter()
            .zip(average)
            .enumerate()
            .map(|(i, (&position, &average))| Node {
                position,
                body: position,
                average,
                uv: template.uvs[i],
                skin: template.skin[i],
                part: template.parts[i],
                free_m: 0.0,
            })
            .collect();
        Self { nodes, triangles: template.triangles.clone() }
    }

    /// Divides each triangle into four.
    pub(crate) fn subdivided(&self) -> Self {
        let mut nodes = self.nodes.clone();
        let mut middles = HashMap::new();
        let mut triangles = Vec::with_capacity(self.triangles.len() * 4);
        for &[a, b, c] in &self.triangles {
            let [ab, bc, ca] = [(a, b), (b, c), (c, a)].map(|(from, to)| {
                *middles.entry((from.min(to), from.max(to))).or_insert_with(|| {
                    // In a fixed order, so that both sides of a UV seam give the same bits.
                    let (low, high) = (&self.nodes[from as usize], &self.nodes[to as usize]);
                    let ordered = low.body.to_array() <= high.body.to_array();
                    nodes.push(if ordered { low.mix(high, 0.5) } else { high.mix(low, 0.5) });
                    nodes.len() as u32 - 1
                })
            });
            triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        Self { nodes, triangles }
    }

    /// Returns the class of each node by its body point, and the number of classes.
    pub(crate) fn welded(&self) -> (Vec<u32>, usize) {
        let mut classes = HashMap::new();
        let class = self
            .nodes
            .iter()
            .map(|node| {
                let next = classes.len() as u32;
                let key = [node.body, node.position].map(|p| p.to_array().map(f32::to_bits));
                *classes.entry(key).or_insert(next)
            })
            .collect();
        (class, classes.len())
    }

    /// Returns the positions after `rounds` of averaging with their neighbours (UV seams stay closed).
    pub(crate) fn smoothed(&self, rounds: usize) -> Vec<Vec3> {
        let (class, count) = self.welded();
        let mut positions = vec![Vec3::ZERO; count];
        for (node, &class) in self.nodes.iter().zip(&class) {
            positions[class as usize] = node.position;
        }
        for _ in 0..rounds {
            let mut sums = vec![(Vec3::ZERO, 0.0f32); count];
            for triangle in &self.triangles {
                let [a, b, c] = triangle.map(|v| class[v as usize] as usize);
                for (of, to) in [(a, b), (b, c), (c, a), (b, a), (c, b), (a, c)] {
                    sums[of].0 += positions[to];
                    sums[of].1 += 1.0;
                }
            }
            for (position, (sum, weight)) in positions.iter_mut().zip(sums) {
                if weight > 0.0 {
                    *position = position.lerp(sum / weight, 0.6);
                }
            }
        }
        class.iter().map(|&c| positions[c as usize]).collect()
    }

    /// Returns area-weighted unit normals for given positions of the nodes.
    pub(crate) fn normals(&self, positions: &[Vec3]) -> Vec<Vec3> {
        let (class, count) = self.welded();
        let mut normals = vec![Vec3::ZERO; count];
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|v| positions[v as usize]);
            let normal = (b - a).cross(c - a);
            for &vertex in triangle {
                normals[class[vertex as usize] as usize] += normal;
            }
        }
        class.iter().map(|&c| normals[c as usize].normalize_or(Vec3::Y)).collect()
    }

    /// Returns the part where `inside` (per node) is positive, cut along its zero line.
    pub(crate) fn cut(&self, inside: &[f32]) -> Self {
        let mut cut = Self::default();
        let mut kept: HashMap<u32, u32> = HashMap::new();
        let mut crossings: HashMap<(u32, u32), u32> = HashMap::new();
        for triangle in &self.triangles {
            let mut corners: Vec<u32> = Vec::with_capacity(4);
            for i in 0..3 {
                let (from, to) = (triangle[i], triangle[(i + 1) % 3]);
                let (f, t) = (inside[from as usize], inside[to as usize]);
                if f > 0.0 {
                    corners.push(*kept.entry(from).or_insert_with(|| {
                        cut.nodes.push(self.nodes[from as usize]);
                        cut.nodes.len() as u32 - 1
                    }));
                }
                if (f > 0.0) != (t > 0.0) {
                    let (low, high) = (from.min(to), from.max(to));
                    corners.push(*crossings.entry((low, high)).or_insert_with(|| {
                        let (l, h) = (inside[low as usize], inside[high as usize]);
                        let at = (l / (l - h)).clamp(0.02, 0.98);
                        cut.nodes.push(self.nodes[low as usize].mix(&self.nodes[high as usize], at));
                        cut.nodes.len() as u32 - 1
                    }));
                }
            }
            for i in 2..corners.len() {
                cut.triangles.push([corners[0], corners[i - 1], corners[i]]);
            }
        }
        cut
    }

    /// Returns the triangles for which `keep` holds.
    pub(crate) fn filtered(&self, keep: impl Fn([&Node; 3]) -> bool) -> Self {
        let kept = self.triangles.iter().filter(|t| keep(t.map(|v| &self.nodes[v as usize]))).copied().collect();
        Self { nodes: self.nodes.clone(), triangles: kept }
    }

    /// Returns the edges with a triangle on one side only, in that triangle's direction; UV seams are no boundary.
    pub(crate) fn boundary(&self) -> Vec<[u32; 2]> {
        let (class, _) = self.welded();
        let directed = |[a, b]: [u32; 2]| (class[a as usize], class[b as usize]);
        let edges = || self.triangles.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
        let all: std::collections::HashSet<(u32, u32)> = edges().map(directed).collect();
        edges()
            .filter(|&edge| {
                let (a, b) = directed(edge);
                !all.contains(&(b, a))
            })
            .collect()
    }

    /// Turns the cloth in at its boundary, down to the body, which gives a hem its thickness.
    pub(crate) fn add_lip(&mut self) {
        let mut inner: HashMap<u32, u32> = HashMap::new();
        for edge in self.boundary() {
            let [a, b] = edge;
            let [c, d] = edge.map(|v| {
                *inner.entry(v).or_insert_with(|| {
                    let node = self.nodes[v as usize];
                    self.nodes.push(Node { position: node.position.lerp(node.body, 0.85), ..node });
                    self.nodes.len() as u32 - 1
                })
            });
            self.triangles.extend([[b, a, c], [b, c, d]]);
        }
    }

    /// Extrudes `rows` rows of cloth from the boundary's edges whose ends are both in `keep`; `at` returns the position
    /// of a boundary node's row, 0 at the edge and 1 at the far end.
    pub(crate) fn extrude(&mut self, rows: u32, keep: impl Fn(&Node) -> bool, at: impl Fn(&Node, f32) -> Vec3) {
        let mut columns: HashMap<u32, u32> = HashMap::new();
        for edge in self.boundary() {
            if edge.iter().any(|&v| !keep(&self.nodes[v as usize])) {
                continue;
            }
            let [a, b] = edge.map(|v| {
                *columns.entry(v).or_insert_with(|| {
                    let node = self.nodes[v as usize];
                    let first = self.nodes.len() as u32;
                    for row in 0..=rows {
                        let position = if row == 0 { node.position } else { at(&node, row as f32 / rows as f32) };
                        self.nodes.push(Node { position, ..node });
                    }
                    first
                })
            });
            for row in 0..rows {
                let (p, q, r, s) = (a + row, b + row, a + row + 1, b + row + 1);
                self.triangles.extend([[q, p, r], [q, r, s]]);
            }
        }
    }

    /// Turns the cloth in at its boundary by `thick_m` along its normals: the hem of hanging cloth.
    pub(crate) fn add_rim(&mut self, thick_m: f32) {
        let positions: Vec<Vec3> = self.nodes.iter().map(|node| node.position).collect();
        let normals = self.normals(&positions);
        let mut inner: HashMap<u32, u32> = HashMap::new();
        for edge in self.boundary() {
            let [a, b] = edge;
            let [c, d] = edge.map(|v| {
                *inner.entry(v).or_insert_with(|| {
                    let node = self.nodes[v as usize];
                    self.nodes.push(Node { position: node.position - normals[v as usize] * thick_m, ..node });
                    self.nodes.len() as u32 - 1
                })
            });
            self.triangles.extend([[b, a, c], [b, c, d]]);
        }
    }

    /// Adds a grid of `rows` by `columns` cells from nodes row by row; seen from outside, columns run counter-clockwise
    /// and rows upwards.
    pub(crate) fn add_grid(&mut self, rows: u32, columns: u32, mut node: impl FnMut(f32, f32) -> Node) {
        let first = self.nodes.len() as u32;
        for row in 0..=rows {
            for column in 0..=columns {
                self.nodes.push(node(row as f32 / rows as f32, column as f32 / columns as f32));
            }
        }
        for row in 0..rows {
            for column in 0..columns {
                let a = first + row * (columns + 1) + column;
                let (b, c, d) = (a + 1, a + columns + 1, a + columns + 2);
                self.triangles.extend([[a, b, c], [b, d, c]]);
            }
        }
    }

    /// Drops nodes that no triangle uses.
    pub(crate) fn compacted(&self) -> Self {
        let mut compact = Self::default();
        let mut index: HashMap<u32, u32> = HashMap::new();
        for triangle in &self.triangles {
            compact.triangles.push(triangle.map(|v| {
                *index.entry(v).or_insert_with(|| {
                    compact.nodes.push(self.nodes[v as usize]);
                    compact.nodes.len() as u32 - 1
                })
            }));
        }
        compact
    }
}

/// Interpolates weights, `t` of the way from `a` to `b`.
pub(crate) fn mix_skin(a: &SkinWeights, b: &SkinWeights, t: f32) -> SkinWeights {
    let mut sums: Vec<(u16, f32)> = Vec::with_capacity(8);
    for (skin, share) in [(a, 1.0 - t), (b, t)] {
        for (&joint, &weight) in skin.joints.iter().zip(&skin.weights) {
            match sums.iter_mut().find(|(known, _)| *known == joint) {
                Some((_, sum)) => *sum += weight * share,
                None => sums.push((joint, weight * share)),
            }
        }
    }
    sums.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    sums.truncate(4);
    let total: f32 = sums.iter().map(|(_, weight)| weight).sum();
    let mut mixed = SkinWeights::default();
    for (slot, (joint, weight)) in sums.into_iter().enumerate().filter(|(_, (_, weight))| *weight > 0.0) {
        mixed.joints[slot] = joint;
        mixed.weights[slot] = weight / total;
    }
    mixed
}

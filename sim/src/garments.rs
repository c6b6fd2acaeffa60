//! Clothes and hair: offset surfaces cut out of the body.

use flyrig_body::Part;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::look::{HairCut, Look};
use crate::noise::{Noise, lerp, smoothstep};
use crate::regions::{ANKLE_TOP_M, above_hairline, along_arm, below_neckline, is_ear};
use crate::sheet::{Node, Sheet};

/// Hem of a top and waist of trousers, metres above the sole on the average body.
const TOP_HEM_M: f32 = 0.845;
const WAIST_M: f32 = 0.925;
const TROUSER_HEM_M: f32 = 0.062;

/// The body twice as fine, and two smoothed copies of it as the base of loose cloth.
pub(crate) struct Tailor {
    body: Sheet,
    normals: Vec<Vec3>,
    loose: Vec<Vec3>,
    loose_normals: Vec<Vec3>,
    noise: Noise,
}

fn is_arm(part: Part) -> bool {
    matches!(part, Part::LeftArm | Part::RightArm)
}

fn is_hand(part: Part) -> bool {
    matches!(part, Part::LeftHand | Part::RightHand)
}

/// Metres inside the top's cloth.
pub(crate) fn inside_top(look: &Look, node: &Node) -> f32 {
    let p = node.average;
    if p.y > 1.42 || is_hand(node.part) {
        return -0.05;
    }
    let mut inside = below_neckline(p, look.v_neck_m).min(p.y - TOP_HEM_M);
    let on_arm = is_arm(node.part) || p.x.abs() > 0.20 && p.y > 0.95;
    if on_arm {
        let (along, _) = along_arm(p);
        inside = if p.y < TOP_HEM_M + 0.1 || along > 0.1 {
            look.sleeve_m - along
        } else {
            inside.min(look.sleeve_m - along)
        };
    }
    inside
}

/// Metres inside the trousers' cloth.
pub(crate) fn inside_bottom(node: &Node) -> f32 {
    if is_arm(node.part) || is_hand(node.part) {
        return -0.05;
    }
    (WAIST_M - node.average.y).min(node.average.y - TROUSER_HEM_M)
}

impl Tailor {
    pub(crate) fn new(body: &Sheet, seed: u64) -> Self {
        let body = body.subdivided();
        let loose = body.smoothed(26);
        let positions: Vec<Vec3> = body.nodes.iter().map(|node| node.position).collect();
        let normals = body.normals(&positions);
        let loose_normals = body.normals(&loose);
        Self { body, normals, loose, loose_normals, noise: Noise::new(seed, 10) }
    }

    /// The body twice as fine with each node moved.
    fn draped(&self, cloth: impl Fn(usize, &Node) -> Vec3 + Sync) -> Sheet {
        let nodes = self
            .body
            .nodes
            .par_iter()
            .enumerate()
            .map(|(i, node)| Node { position: cloth(i, node), ..*node })
            .collect();
        Sheet { nodes, triangles: self.body.triangles.clone() }
    }

    /// Loose cloth that bridges hollows and stays `offset` outside of the body.
    fn over(&self, i: usize, node: &Node, offset: f32) -> Vec3 {
        let normal = self.loose_normals[i];
        // Smoothing shrinks limbs: push back out to where the body is.
        let sunk = (node.body - self.loose[i]).dot(self.normals[i]).max(0.0);
        self.loose[i] + normal * (offset + sunk)
    }

    fn cut(&self, sheet: &Sheet, inside: impl Fn(&Node) -> f32 + Sync + Send) -> Sheet {
        let inside: Vec<f32> = self.body.nodes.par_iter().map(inside).collect();
        sheet.cut(&inside).compacted()
    }

    /// T-shirt or jumper.
    pub(crate) fn top(&self, look: &Look) -> Sheet {
        let sheet = self.draped(|i, node| {
            let p = node.average;
            let mut offset = look.top_offset_m;
            if is_arm(node.part) {
                let (along, _) = along_arm(p);
                // Wide short sleeves; long ones bunch at the elbow and close at the cuff.
                let cuff = smoothstep(0.40, 0.455, along);
                offset +=
                    if look.sleeve_m < 0.3 { 0.012 * smoothstep(0.04, 0.15, along) } else { 0.004 * (1.0 - cuff) };
                let bunch = (along * 95.0 + 2.5 * self.noise.at(p * 9.0)).sin();
                let near_elbow = smoothstep(0.12, 0.0, (along - 0.25).abs());
                offset += 0.003 * bunch * near_elbow * (1.0 - cuff);
            } else {
                // Hangs from the chest, free of the waist.
                offset +=
                    if look.female { 0.009 } else { 0.013 } * smoothstep(1.22, 1.02, p.y) * smoothstep(0.82, 0.98, p.y)
                        + 0.006 * smoothstep(1.2, 0.9, p.y);
            }
            // Folds run along a slanted, wandering direction and are deepest at the waist and under the arms.
            let wander = self.noise.sum(p * 5.0, 2);
            let slant =
                p.y * 30.0 + 14.0 * (p.x * 9.0 + 2.0 * self.noise.at(p * 2.5 + 30.0)).sin() * 0.35 + 6.5 * wander;
            let depth = 0.0038 * smoothstep(1.25, 0.98, p.y) + 0.0008;
            offset += depth * slant.sin() * (0.4 + 0.6 * self.noise.at(p * 7.0 + 11.0).abs());
            offset += 0.0025 * self.noise.sum(p * 14.0, 2);
            let rim = smoothstep(0.0, 0.03, below_neckline(p, look.v_neck_m));
            self.over(i, node, lerp(0.008, offset.max(0.007), rim))
        });
        let mut top = self.cut(&sheet, |node| inside_top(look, node));
        top.add_lip();
        top
    }

    /// Trousers.
    pub(crate) fn bottom(&self, look: &Look) -> Sheet {
        let sheet = self.draped(|i, node| {
            let p = node.average;
            let shank = smoothstep(0.42, 0.12, p.y);
            let mut offset = look.bottom_offset_m + 0.013 * shank + 0.004 * smoothstep(0.75, 0.5, p.y);
            let wander = self.noise.sum(p * 6.0 + 40.0, 2);
            let folds = (p.y * 62.0 + 14.0 * p.x.abs() + 4.5 * wander).sin();
            let near_knee = smoothstep(0.16, 0.0, (p.y - 0.46).abs());
            let near_hem = smoothstep(0.26, 0.10, p.y);
            let near_crotch = smoothstep(0.12, 0.0, (p.y - 0.80).abs());
            offset += 0.0035 * folds * (near_knee * 0.5 + near_hem * 1.2 + near_crotch * 0.6);
            offset += 0.003 * self.noise.sum(p * 13.0 + 7.0, 2);
            self.over(i, node, offset.max(0.005))
        });
        let mut bottom = self.cut(&sheet, inside_bottom);
        bottom.add_lip();
        bottom
    }

    /// A cap of hair, with a curtain or a bun for the longer cuts.
    pub(crate) fn hair(&self, look: &Look) -> Sheet {
        let (thick, rough) = match look.cut {
            HairCut::Crop => (0.005, 0.002),
            HairCut::Short => (0.016, 0.006),
            HairCut::Bob => (0.019, 0.003),
            HairCut::Bun => (0.010, 0.002),
        };
        let smooth = self.body.smoothed(4);
        let inside = |node: &Node| {
            let p = node.average;
            let ragged = 0.006 * self.noise.sum(p * 90.0, 2);
            if node.part == Part::Head && p.y > 1.46 { above_hairline(p, look.recede_m) + ragged } else { -0.05 }
        };
        let sheet = self.draped(|i, node| {
            let p = node.average;
            let rim = smoothstep(0.0, 0.035, inside(node));
            let crown = smoothstep(1.56, 1.63, p.y);
            let around = p.x.abs().atan2(p.z - 0.04) * p.x.signum();
            let strands = self.noise.at(Vec3::new(around * 26.0, p.y * 9.0, p.z * 20.0));
            let tuft = self.noise.sum(p * 45.0, 2);
            let volume = thick * (0.35 + 0.65 * rim) * (0.65 + 0.5 * crown);
            smooth[i] + self.loose_normals[i] * (volume + rough * rim * (0.6 * strands + 0.4 * tuft)).max(0.002)
        });
        let mut hair = self.cut(&sheet, inside);
        match look.cut {
            HairCut::Bob => self.add_curtain(&mut hair),
            HairCut::Bun => add_bun(&mut hair),
            HairCut::Crop | HairCut::Short => {}
        }
        hair.add_lip();
        hair
    }

    /// Lets the hair hang from the hairline at the sides and the back.
    fn add_curtain(&self, hair: &mut Sheet) {
        const ROWS: u32 = 7;
        let hangs = |node: &Node| {
            let p = node.average;
            let around = p.x.abs().atan2(p.z - 0.040);
            smoothstep(1.02, 1.2, around)
        };
        let mut rows: std::collections::HashMap<u32, u32> = std::collections::HashMap::new();
        for edge in hair.boundary() {
            if edge.iter().any(|&v| hangs(&hair.nodes[v as usize]) <= 0.0) {
                continue;
            }
            let [a, b] = edge.map(|v| {
                *rows.entry(v).or_insert_with(|| {
                    let node = hair.nodes[v as usize];
                    let first = hair.nodes.len() as u32;
                    let p = node.average;
                    let axis = Vec3::new(0.0, node.position.y, 0.035);
                    let out = (node.position - axis) * Vec3::new(1.0, 0.0, 1.0);
                    let around = p.x.atan2(p.z - 0.04);
                    let bottom = 1.435 + 0.006 * self.noise.at(Vec3::new(around * 14.0, 0.0, 0.0));
                    let drop = (p.y - bottom).max(0.0) * hangs(&node);
                    for row in 0..=ROWS {
                        let t = row as f32 / ROWS as f32;
                        let wave = 0.004 * t * self.noise.at(Vec3::new(around * 16.0, t * 2.5, 3.0));
                        let flare = out.normalize_or(Vec3::Z) * (0.010 * (t * 3.0).min(1.0) - 0.012 * t * t + wave);
                        let position = node.position + flare - Vec3::Y * drop * t;
                        let average = p - Vec3::Y * drop * t;
                        hair.nodes.push(Node { position, average, ..node });
                    }
                    first
                })
            });
            for row in 0..ROWS {
                let (p, q, r, s) = (a + row, b + row, a + row + 1, b + row + 1);
                hair.triangles.extend([[q, p, r], [q, r, s]]);
            }
        }
    }
}

/// A ball of hair at the back of the head.
fn add_bun(hair: &mut Sheet) {
    let centre_average = Vec3::new(0.0, 1.605, -0.045);
    let Some(near) = hair
        .nodes
        .iter()
        .min_by(|a, b| a.average.distance(centre_average).total_cmp(&b.average.distance(centre_average)))
        .copied()
    else {
        return;
    };
    let beside = Vec3::new(0.045, 1.615, 0.0);
    let by_distance = |a: &&Node, b: &&Node| a.average.distance(beside).total_cmp(&b.average.distance(beside));
    let patch = hair.nodes.iter().min_by(by_distance).map_or(near.uv, |node| node.uv);
    let first = hair.nodes.len();
    let centre = near.position + Vec3::new(0.0, 0.008, -0.014);
    ball(hair, &near, centre, 0.036, centre_average);
    for node in &mut hair.nodes[first..] {
        let out = (node.position - centre) / 0.036;
        // Wound hair: a spiral ridge, and strands from the crown's part of the texture.
        let ridge = (out.x.atan2(out.y) * 3.0 + out.z * 9.0).sin();
        node.position += out * 0.0022 * ridge;
        node.uv = patch + Vec2::new(out.x + out.z, out.y) * 0.012;
    }
}

/// Adds a sphere carried by `near`'s body point; its nodes' `average` lies on a sphere around `average`.
pub(crate) fn ball(sheet: &mut Sheet, near: &Node, centre: Vec3, radius_m: f32, average: Vec3) {
    const RINGS: u32 = 14;
    const SLICES: u32 = 20;
    let first = sheet.nodes.len() as u32;
    for ring in 0..=RINGS {
        let polar = std::f32::consts::PI * ring as f32 / RINGS as f32;
        for slice in 0..=SLICES {
            let around = std::f32::consts::TAU * slice as f32 / SLICES as f32;
            // The pole looks forward, +z.
            let direction = Vec3::new(polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos());
            let position = centre + direction * radius_m;
            sheet.nodes.push(Node { position, average: average + direction * radius_m, ..*near });
        }
    }
    let at = |ring: u32, slice: u32| first + ring * (SLICES + 1) + slice;
    for ring in 0..RINGS {
        for slice in 0..SLICES {
            let (a, b, c, d) = (at(ring, slice), at(ring, slice + 1), at(ring + 1, slice), at(ring + 1, slice + 1));
            if ring > 0 {
                sheet.triangles.push([a, d, b]);
            }
            if ring + 1 < RINGS {
                sheet.triangles.push([a, c, d]);
            }
        }
    }
}

/// What remains to be drawn of the naked body.
pub(crate) fn visible_skin(body: &Sheet, look: &Look) -> Sheet {
    const MARGIN_M: f32 = 0.025;
    let covered = |node: &Node| {
        inside_top(look, node) > MARGIN_M || inside_bottom(node) > MARGIN_M || node.average.y < ANKLE_TOP_M
    };
    let mut skin = body.filtered(|corners| !corners.iter().all(|node| covered(node))).compacted();
    if look.cut == HairCut::Bob {
        // The hair holds the ears flat.
        for node in &mut skin.nodes {
            if is_ear(node.average) {
                node.position.x -= node.average.x.signum() * (node.average.x.abs() - 0.064).max(0.0);
            }
        }
    }
    skin
}

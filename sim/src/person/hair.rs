//! Hair and beards.

use std::f32::consts::{PI, TAU};

use flyrig_body::Part;
use glam::{Vec2, Vec3};

use crate::clothes::garments::Tailor;
use crate::clothes::lift::HeadLift;
use crate::clothes::sheet::{Node, Sheet};
use crate::clothes::wardrobe::{Beard, HairCut, Hat};
use crate::noise::{Noise, lerp, smoothstep};
use crate::person::hats::rim_height_m;
use crate::person::look::PersonLook;
use crate::person::regions::{above_hairline, inside_beard};

impl Tailor {
    /// Builds a cap of hair with its hanging parts.
    pub(crate) fn hair(&self, look: &PersonLook, naked: &Sheet) -> Option<Sheet> {
        let (thick, rough) = match look.cut {
            HairCut::Bald => return None,
            HairCut::Crop => (0.005, 0.002),
            HairCut::Short => (0.016, 0.006),
            HairCut::Curls => (0.046, 0.016),
            HairCut::Bob | HairCut::Long => (0.019, 0.003),
            HairCut::Bun | HairCut::Ponytail => (0.010, 0.002),
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
            let mut volume = thick * (0.35 + 0.65 * rim) * (0.65 + 0.5 * crown);
            let mut relief = rough * rim * (0.6 * strands + 0.4 * tuft);
            if look.hat != Hat::None {
                // Pressed flat by the hat.
                let free = smoothstep(0.0, 0.02, rim_height_m(p) - p.y);
                volume = lerp(volume.min(0.003), volume.min(0.014), free);
                relief *= 0.3 * free;
            }
            smooth[i] + self.loose_normals[i] * (volume + relief).max(0.002)
        });
        let mut hair = self.cut(&sheet, inside);
        match look.cut {
            HairCut::Bob => self.add_curtain(&mut hair, 1.435),
            HairCut::Long => self.add_curtain(&mut hair, 1.23),
            HairCut::Bun => add_bun(&mut hair),
            HairCut::Ponytail => add_tail(&mut hair, &HeadLift::new(naked), self.noise),
            HairCut::Bald | HairCut::Crop | HairCut::Curls | HairCut::Short => {}
        }
        hair.add_lip();
        Some(hair)
    }

    /// Adds hair that hangs from the hairline at the sides and the back, there down to `bottom_m`.
    fn add_curtain(&self, hair: &mut Sheet, bottom_m: f32) {
        let rows = if bottom_m < 1.4 { 14 } else { 7 };
        let around = |p: Vec3| p.x.atan2(p.z - 0.040);
        let hangs = |node: &Node| smoothstep(1.02, 1.2, around(node.average).abs());
        // A child's head is lower and its shoulders closer.
        let stature = {
            let (mut there, mut here) = (0.0f32, 0.0f32);
            for node in &hair.nodes {
                there = there.max(node.average.y);
                here = here.max(node.position.y);
            }
            (here / there.max(0.1)).clamp(0.5, 1.2)
        };
        let middle =
            hair.nodes.iter().map(|node| node.position - node.average).sum::<Vec3>() / hair.nodes.len().max(1) as f32;
        let first = hair.nodes.len();
        hair.extrude(
            rows,
            |node| hangs(node) > 0.0,
            |node, t| {
                let p = node.average;
                let axis = Vec3::new(0.0, node.position.y, 0.035 + middle.z);
                let out = ((node.position - axis) * Vec3::new(1.0, 0.0, 1.0)).normalize_or(Vec3::Z);
                let turn = around(p);
                let behind = smoothstep(1.75, 2.5, turn.abs());
                let bottom = lerp(1.435, bottom_m, behind) + 0.006 * self.noise.at(Vec3::new(turn * 14.0, 0.0, 0.0));
                let drop = (p.y - bottom).max(0.0) * hangs(node) * stature;
                let wave = 0.004 * t * self.noise.at(Vec3::new(turn * 16.0, t * 2.5, 3.0));
                // Long hair lies on the back, outside of the clothes.
                let fallen = drop * t;
                let long = if bottom_m < 1.4 { 0.075 * smoothstep(0.03, 0.14, fallen) * behind } else { 0.0 };
                let flare = out * (0.010 * (t * 3.0).min(1.0) - 0.012 * t * t * (1.0 - behind) + wave);
                node.position + flare - Vec3::Z * long - Vec3::Y * fallen
            },
        );
        // Every column hangs from its first node.
        for column in hair.nodes[first..].chunks_mut(rows as usize + 1) {
            let root = column.first().map_or(Vec3::ZERO, |node| node.position);
            for node in column {
                node.free_m = 0.8 * node.position.distance(root);
            }
        }
    }

    /// Builds a beard.
    pub(crate) fn beard(&self, look: &PersonLook) -> Option<Sheet> {
        let (thick, long) = match look.beard {
            Beard::None => return None,
            Beard::Moustache => (0.005, 0.001),
            Beard::Goatee => (0.007, 0.008),
            Beard::Full => (0.008, 0.008),
            Beard::Long => (0.013, 0.055),
        };
        let inside = |node: &Node| {
            let p = node.average;
            if node.part == Part::Head {
                inside_beard(p, look.beard) + 0.0025 * self.noise.sum(p * 150.0, 2)
            } else {
                -0.05
            }
        };
        let sheet = self.draped(|i, node| {
            let p = node.average;
            let deep = smoothstep(0.0, 0.014, inside(node));
            let strands = self.noise.sum(Vec3::new(p.x * 160.0, p.y * 40.0, p.z * 90.0), 2);
            let chin = smoothstep(1.475, 1.445, p.y) * smoothstep(0.07, 0.115, p.z);
            let out = self.loose_normals[i] * (0.0012 + thick * deep * (1.0 + 0.35 * strands));
            node.position + out + Vec3::new(0.0, -1.0, 0.25) * (long * chin * deep * (1.0 + 0.3 * strands))
        });
        let mut beard = self.cut(&sheet, inside);
        beard.add_lip();
        Some(beard)
    }
}

/// Returns a texture coordinate on the head where the hair's texture has strands.
fn strands_uv(hair: &Sheet) -> Vec2 {
    let beside = Vec3::new(0.045, 1.615, 0.0);
    let by_distance = |a: &&Node, b: &&Node| a.average.distance(beside).total_cmp(&b.average.distance(beside));
    hair.nodes.iter().min_by(by_distance).map_or(Vec2::ZERO, |node| node.uv)
}

/// Adds a bun at the back of the head.
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
    let patch = strands_uv(hair);
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

/// Adds a ponytail at the back of the head.
fn add_tail(hair: &mut Sheet, lift: &HeadLift<'_>, noise: Noise) {
    let patch = strands_uv(hair);
    let path = |t: f32| {
        // Out of the band, over and down the neck.
        let out = 0.060 * (1.0 - (-5.0 * t).exp()) + 0.020 * t;
        Vec3::new(
            0.012 * t * noise.at(Vec3::new(t * 3.0, 5.0, 1.0)),
            1.605 + 0.035 * (t * 5.0).min(1.0) * (1.0 - t) - 0.27 * t * t,
            -0.040 - out,
        )
    };
    let Some(carrier) = lift.node(path(0.0)) else { return };
    let moved = carrier.position - carrier.average;
    hair.add_grid(18, 16, |t, around| {
        let angle = around * TAU;
        let thick = (0.013 + 0.016 * (PI * (t * 1.15).min(1.0)).sin()) * smoothstep(1.0, 0.86, t).max(0.02);
        let strand = 1.0 + 0.14 * noise.at(Vec3::new(angle.cos() * 3.0, angle.sin() * 3.0, t * 4.0));
        let along = (path(t + 0.02) - path(t)).normalize_or(Vec3::NEG_Y);
        let side = Vec3::X;
        let up = side.cross(along).normalize_or(Vec3::Z);
        let average = path(t) + (side * angle.cos() - up * angle.sin()) * thick * strand;
        let uv = patch + Vec2::new(angle.cos(), t * 3.0) * 0.010;
        // Bound at the top.
        let free_m = 0.27 * (t - 0.12).max(0.0);
        Node { position: average + moved, average, uv, free_m, ..carrier }
    });
}

/// Adds a sphere carried by `near`'s body point; its nodes' `average` lies on a sphere around `average`.
pub(crate) fn ball(sheet: &mut Sheet, near: &Node, centre: Vec3, radius_m: f32, average: Vec3) {
    const RINGS: u32 = 14;
    const SLICES: u32 = 20;
    let first = sheet.nodes.len() as u32;
    for ring in 0..=RINGS {
        let polar = PI * ring as f32 / RINGS as f32;
        for slice in 0..=SLICES {
            let around = TAU * slice as f32 / SLICES as f32;
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

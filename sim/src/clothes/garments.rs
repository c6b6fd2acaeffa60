//! Close-fitting clothes: offset surfaces cut from the body.

use glam::Vec3;
use rayon::prelude::*;

use crate::clothes::collars::{hood, lapels, shirt_collar};
use crate::clothes::cuts::{inside_boot, inside_bottom, inside_outer, inside_top, is_arm, under_hanging, under_tails};
use crate::clothes::loose::{free_bottom, free_outer, free_top, hang_free};
use crate::clothes::sheet::{Node, Sheet};
use crate::clothes::wardrobe::{Bottom, HairCut, Outer, ShoeKind, Top, TopKind};
use crate::noise::{Noise, lerp, smoothstep};
use crate::person::look::PersonLook;
use crate::person::regions::{ANKLE_TOP_M, along_arm, below_neckline, is_ear};

/// Depth inside another layer below which cloth is omitted.
const HIDDEN_M: f32 = 0.028;

/// The subdivided body, and two smoothed copies of it as the base of loose cloth.
pub(crate) struct Tailor {
    pub(crate) body: Sheet,
    normals: Vec<Vec3>,
    /// Body without its smallest forms, which no cloth follows.
    firm: Vec<Vec3>,
    loose: Vec<Vec3>,
    pub(crate) loose_normals: Vec<Vec3>,
    pub(crate) noise: Noise,
}

impl Tailor {
    pub(crate) fn new(body: &Sheet, seed: u64) -> Self {
        let body = body.subdivided();
        let (firm, loose) = (body.smoothed(9), body.smoothed(26));
        let positions: Vec<Vec3> = body.nodes.iter().map(|node| node.position).collect();
        let normals = body.normals(&positions);
        let loose_normals = body.normals(&loose);
        Self { body, normals, firm, loose, loose_normals, noise: Noise::new(seed, 10) }
    }

    /// Returns the subdivided body with each node moved.
    pub(crate) fn draped(&self, cloth: impl Fn(usize, &Node) -> Vec3 + Sync) -> Sheet {
        let nodes = self
            .body
            .nodes
            .par_iter()
            .enumerate()
            .map(|(i, node)| Node { position: cloth(i, node), ..*node })
            .collect();
        Sheet { nodes, triangles: self.body.triangles.clone() }
    }

    /// Returns a point of loose cloth that bridges hollows and stays `offset` outside the body.
    fn over(&self, i: usize, offset: f32) -> Vec3 {
        let normal = self.loose_normals[i];
        // Smoothing shrinks limbs: push back out to where the body is.
        let sunk = (self.firm[i] - self.loose[i]).dot(self.loose_normals[i]).max(0.0);
        self.loose[i] + normal * (offset + sunk)
    }

    pub(crate) fn cut(&self, sheet: &Sheet, inside: impl Fn(&Node) -> f32 + Sync + Send) -> Sheet {
        let inside: Vec<f32> = self.body.nodes.par_iter().map(inside).collect();
        sheet.cut(&inside).compacted()
    }

    /// Returns the distance of a top's cloth from the body, metres.
    fn top_offset(&self, top: &Top, female: bool, node: &Node) -> f32 {
        let p = node.average;
        let mut offset = top.offset_m;
        if is_arm(node.part) {
            let (along, _) = along_arm(p);
            // Wide short sleeves; long ones bunch at the elbow and close at the cuff.
            let cuff = smoothstep(0.40, 0.455, along);
            offset += if top.sleeve_m < 0.25 { 0.012 * smoothstep(0.04, 0.15, along) } else { 0.004 * (1.0 - cuff) };
            let bunch = (along * 95.0 + 2.5 * self.noise.at(p * 9.0)).sin();
            let near_elbow = smoothstep(0.12, 0.0, (along - 0.25).abs());
            offset += 0.003 * bunch * near_elbow * (1.0 - cuff);
            if top.kind == TopKind::Shirt && top.sleeve_m < 0.4 {
                // Rolled up: several layers at the end.
                offset += 0.006 * smoothstep(0.045, 0.040, top.sleeve_m - along);
            }
        } else {
            // Hangs from the chest, free of the waist.
            offset += if female { 0.009 } else { 0.013 } * smoothstep(1.22, 1.02, p.y) * smoothstep(0.82, 0.98, p.y)
                + 0.006 * smoothstep(1.2, 0.9, p.y);
        }
        // Folds run along a slanted, wandering direction and are deepest at the waist and under the arms.
        let wander = self.noise.sum(p * 5.0, 2);
        let slant = p.y * 30.0 + 14.0 * (p.x * 9.0 + 2.0 * self.noise.at(p * 2.5 + 30.0)).sin() * 0.35 + 6.5 * wander;
        let depth = 0.0038 * smoothstep(1.25, 0.98, p.y) + 0.0008;
        offset += depth * slant.sin() * (0.4 + 0.6 * self.noise.at(p * 7.0 + 11.0).abs());
        offset += 0.0025 * self.noise.sum(p * 14.0, 2);
        if matches!(top.kind, TopKind::Jumper | TopKind::Hoodie) {
            // A ribbed hem holds the cloth in, which bulges above it.
            let bulge = smoothstep(0.03, 0.08, p.y - top.hem_m) * smoothstep(0.22, 0.08, p.y - top.hem_m);
            offset += 0.008 * bulge - 0.006 * smoothstep(0.04, 0.0, p.y - top.hem_m);
        }
        if top.kind == TopKind::Turtleneck {
            offset += 0.006 * smoothstep(0.048, 0.044, 1.447 - p.y - 0.6 * (p.z - 0.03));
            offset = offset.min(lerp(0.013, 0.03, smoothstep(1.38, 1.33, p.y)));
        }
        if top.tucked && !is_arm(node.part) {
            offset = lerp(0.006, offset, smoothstep(0.97, 1.06, p.y));
        }
        let rim = smoothstep(0.0, 0.03, below_neckline(p, top.v_neck_m, top.neck_m));
        if top.kind == TopKind::Turtleneck { offset.max(0.006) } else { lerp(0.008, offset.max(0.006), rim) }
    }

    /// Builds a T-shirt, shirt, jumper or the upper part of a dress.
    pub(crate) fn top(&self, look: &PersonLook) -> Sheet {
        let top = &look.top;
        let sheet = self.draped(|i, node| self.over(i, self.top_offset(top, look.female, node)));
        let mut cloth = self.cut(&sheet, |node| inside_top(top, node));
        hang_free(&mut cloth, |node| free_top(look, node));
        match top.kind {
            TopKind::Shirt => shirt_collar(&mut cloth),
            TopKind::Hoodie => hood(&mut cloth),
            TopKind::TShirt | TopKind::Jumper | TopKind::Turtleneck => {}
        }
        let mut seen = cloth.filtered(|corners| {
            !corners.iter().all(|node| {
                look.outer.is_some_and(|outer| inside_outer(&outer, node) > HIDDEN_M)
                    || matches!(look.bottom, Bottom::Overalls { .. }) && inside_bottom(look, node) > HIDDEN_M
            })
        });
        seen.add_lip();
        seen.compacted()
    }

    /// Builds a jacket, or a coat down to the hip.
    pub(crate) fn outer(&self, look: &PersonLook, outer: &Outer) -> Sheet {
        let sheet = self.draped(|i, node| {
            let p = node.average;
            let under = self.top_offset(&look.top, look.female, node);
            let stiff = 0.0025 * self.noise.sum(p * 7.0 + 60.0, 2) + 0.0012 * self.noise.sum(p * 19.0 + 5.0, 2);
            let mut offset = under + 0.008 + stiff;
            if is_arm(node.part) {
                // Heavy sleeves break into creases at the elbow and above the cuff.
                let (along, _) = along_arm(p);
                let crease = (along * 120.0 + 3.0 * self.noise.at(p * 11.0 + 3.0)).sin();
                let broken =
                    smoothstep(0.11, 0.0, (along - 0.25).abs()) + 0.7 * smoothstep(0.07, 0.0, (along - 0.42).abs());
                offset += 0.002 + 0.0040 * crease * broken.min(1.0);
            } else {
                let crease = (p.y * 75.0 + 9.0 * p.x.abs() + 3.5 * self.noise.at(p * 6.0 + 17.0)).sin();
                offset += 0.0028 * crease * smoothstep(0.13, 0.03, (p.y - 1.0).abs());
                // Away from the body towards the hem, more so in front of an open one.
                let open = if outer.open_m > 0.0 {
                    smoothstep(0.22, 0.05, p.x.abs()) * smoothstep(0.0, 0.05, p.z)
                } else {
                    0.0
                };
                offset += (0.004 + 0.014 * open) * smoothstep(1.2, 0.85, p.y);
            }
            self.over(i, offset)
        });
        let mut cloth = self.cut(&sheet, |node| inside_outer(outer, node));
        hang_free(&mut cloth, |node| free_outer(outer, node));
        lapels(&mut cloth, outer);
        cloth.add_lip();
        cloth
    }

    /// Builds trousers, shorts or overalls.
    pub(crate) fn bottom(&self, look: &PersonLook) -> Option<Sheet> {
        let (hem_m, wide_m) = match look.bottom {
            Bottom::Trousers { hem_m, wide_m, .. } => (hem_m, wide_m),
            Bottom::Overalls { hem_m, .. } => (hem_m, 0.012),
            Bottom::Skirt { .. } => return None,
        };
        let boots = if look.shoes.kind == ShoeKind::Boots { 0.008 } else { 0.0 };
        let sheet = self.draped(|i, node| {
            let p = node.average;
            let shank = smoothstep(0.42, 0.12, p.y);
            let to_hem = smoothstep(0.80, hem_m, p.y);
            let mut offset = 0.009 + (0.008 + boots) * shank + 0.004 * smoothstep(0.75, 0.5, p.y) + wide_m * to_hem;
            let wander = self.noise.sum(p * 6.0 + 40.0, 2);
            let folds = (p.y * 62.0 + 14.0 * p.x.abs() + 4.5 * wander).sin();
            let near_knee = smoothstep(0.16, 0.0, (p.y - 0.46).abs());
            let near_hem = smoothstep(0.26, 0.10, p.y);
            let near_crotch = smoothstep(0.12, 0.0, (p.y - 0.80).abs());
            offset += 0.0035 * folds * (near_knee * 0.5 + near_hem * 1.2 + near_crotch * 0.6);
            offset += 0.003 * self.noise.sum(p * 13.0 + 7.0, 2);
            if look.outer.is_some_and(|outer| outer.hem_m < 0.7 && outer.hem_m < hem_m) {
                // Shorts under a coat.
                offset = offset.min(0.012);
            }
            if look.top.tucked {
                // Over the top that it holds in.
                let over = self.top_offset(&look.top, look.female, node) + 0.008;
                offset = lerp(offset, over, smoothstep(0.90, 0.96, p.y));
            }
            self.over(i, offset.max(0.005))
        });
        let mut cloth = self.cut(&sheet, |node| inside_bottom(look, node));
        hang_free(&mut cloth, |node| free_bottom(look, node));
        let mut seen = cloth.filtered(|corners| {
            !corners.iter().all(|node| {
                !look.top.tucked && inside_top(&look.top, node) > HIDDEN_M + 0.01
                    || look.outer.is_some_and(|outer| inside_outer(&outer, node) > HIDDEN_M + 0.01)
                    || under_tails(look, node) > 0.0
            })
        });
        if matches!(look.bottom, Bottom::Overalls { .. }) {
            self.add_straps(&mut seen, |i| {
                self.over(i, self.top_offset(&look.top, look.female, &self.body.nodes[i]) + 0.011)
            });
        }
        seen.add_lip();
        Some(seen.compacted())
    }

    /// Builds the shafts of boots.
    pub(crate) fn boot_shafts(&self, look: &PersonLook) -> Option<Sheet> {
        (look.shoes.kind == ShoeKind::Boots).then(|| {
            let sheet = self.draped(|i, node| {
                let offset = 0.007 + 0.002 * self.noise.sum(node.average * 16.0, 2);
                node.position + self.normals[i] * offset
            });
            let mut shafts = self.cut(&sheet, |node| inside_boot(look, node));
            shafts.add_lip();
            shafts
        })
    }
}

/// Returns the part of the naked body that remains visible.
pub(crate) fn visible_skin(body: &Sheet, look: &PersonLook) -> Sheet {
    const MARGIN_M: f32 = 0.025;
    let covered = |node: &Node| {
        inside_top(&look.top, node) > MARGIN_M
            || inside_bottom(look, node) > MARGIN_M
            || under_hanging(look, node) > MARGIN_M
            || inside_boot(look, node) > MARGIN_M
            || look.outer.is_some_and(|outer| inside_outer(&outer, node) > MARGIN_M)
            || node.average.y < ANKLE_TOP_M
    };
    let mut skin = body.filtered(|corners| !corners.iter().all(|node| covered(node))).compacted();
    if matches!(look.cut, HairCut::Bob | HairCut::Long) {
        // The hair holds the ears flat.
        for node in &mut skin.nodes {
            if is_ear(node.average) {
                node.position.x -= node.average.x.signum() * (node.average.x.abs() - 0.064).max(0.0);
            }
        }
    }
    skin
}

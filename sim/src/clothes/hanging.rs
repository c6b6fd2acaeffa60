//! Skirts and the tails of coats: cloth that hangs around both legs.

use std::f32::consts::{PI, TAU};

use flyrig_body::{Part, SkinWeights};
use glam::{Vec2, Vec3};

use crate::clothes::garments::Tailor;
use crate::clothes::sheet::{Node, Sheet, mix_skin};
use crate::noise::smoothstep;

/// Tube of cloth; heights in metres on the average body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ClothTube {
    pub top_m: f32,
    pub hem_m: f32,
    /// Distance from the body at the top and the bottom, metres.
    pub offset_m: [f32; 2],
    /// Metres outwards per metre down.
    pub flare: f32,
    pub pleats: f32,
    pub fold_m: f32,
    /// Half the angle left open in front, radians.
    pub open_rad: f32,
}

/// Weight of the hips (the root joint) against the legs.
const BY_HIPS: f32 = 0.2;
/// Height below which the cloth no longer follows the legs, metres on the average body.
const FOLLOWS_M: f32 = 0.64;

impl Tailor {
    /// Builds the tube, textured by u around and v down.
    pub(crate) fn hang(&self, cloth: &ClothTube) -> Sheet {
        const COLUMNS: u32 = 112;
        let rows = ((cloth.top_m - cloth.hem_m) / 0.016).ceil().max(4.0) as u32;
        let mut sheet = Sheet::default();
        let mut radius = vec![0.0f32; COLUMNS as usize + 1];
        let mut before: Option<(f32, f32)> = None;
        let mut centre_z = None;
        for row in 0..=rows {
            let t = row as f32 / rows as f32;
            let level = cloth.top_m + (cloth.hem_m - cloth.top_m) * t;
            let band = self.trunk_at(level);
            if band.is_empty() {
                continue;
            }
            let y = band.iter().map(|node| node.position.y).sum::<f32>() / band.len() as f32;
            let flat: Vec<Vec2> = band.iter().map(|node| Vec2::new(node.position.x, node.position.z)).collect();
            let centre_z = *centre_z.get_or_insert_with(|| flat.iter().map(|p| p.y).sum::<f32>() / flat.len() as f32);
            let hull = convex_hull(flat);
            let (first_y, last_y) = before.unwrap_or((y, y));
            let carriers = self.trunk_at(level.max(FOLLOWS_M));
            for column in 0..=COLUMNS {
                let share = column as f32 / COLUMNS as f32;
                let angle = cloth.open_rad + (TAU - 2.0 * cloth.open_rad) * share;
                // From the front over the left side.
                let direction = Vec2::new(angle.sin(), angle.cos());
                let reach = distance_to_hull(&hull, Vec2::new(0.0, centre_z), direction);
                let offset = cloth.offset_m[0] + (cloth.offset_m[1] - cloth.offset_m[0]) * smoothstep(0.0, 0.25, t);
                // Cloth falls from the widest place; a narrow skirt comes in a little again.
                let falls = radius[column as usize] - 0.12 * (last_y - y).max(0.0) * f32::from(cloth.flare < 0.1);
                let body_radius = reach.max(falls);
                radius[column as usize] = body_radius;
                let wander = self.noise.at(Vec3::new(direction.x * 1.6, 7.0, direction.y * 1.6));
                let phase =
                    cloth.pleats * (angle - PI) + 1.8 * wander + 0.5 * self.noise.at(Vec3::new(angle, y * 3.0, 1.0));
                let depth = cloth.fold_m * smoothstep(0.04, 0.75, t) * (0.65 + 0.35 * wander);
                let out = body_radius + offset + cloth.flare * (first_y - y) + depth * (0.5 + 0.5 * phase.cos());
                let sag = 0.006 * wander * t;
                let position = Vec3::new(direction.x * out, y + sag, centre_z + direction.y * out);
                if let Some(node) = carried(&band, &carriers, position) {
                    let uv = Vec2::new(0.01 + 0.98 * share, 0.01 + 0.98 * t);
                    // Narrow skirts are held by the hips that they lie on.
                    let free_m = (first_y - y).max(0.0) * (0.35 + 0.65 * smoothstep(0.03, 0.12, cloth.flare));
                    sheet.nodes.push(Node { position, uv, free_m, ..node });
                }
            }
            before = Some((first_y, y));
        }
        let wide = COLUMNS + 1;
        for row in 0..(sheet.nodes.len() as u32 / wide).saturating_sub(1) {
            for column in 0..COLUMNS {
                let a = row * wide + column;
                let (b, c, d) = (a + 1, a + wide, a + wide + 1);
                sheet.triangles.extend([[a, c, b], [b, c, d]]);
            }
        }
        // The first and the last column of a closed tube are one.
        if cloth.open_rad <= 0.0 {
            for row in 0..sheet.nodes.len() / wide as usize {
                let (first, last) = (row * wide as usize, (row + 1) * wide as usize - 1);
                let uv = sheet.nodes[last].uv;
                sheet.nodes[last] = Node { uv, ..sheet.nodes[first] };
            }
        }
        sheet.add_rim(0.004);
        sheet
    }

    /// Returns the nodes of trunk and legs at a height of the average body.
    fn trunk_at(&self, level: f32) -> Vec<&Node> {
        let nodes = self.body.nodes.iter();
        nodes
            .filter(|node| (node.average.y - level).abs() < 0.014)
            .filter(|node| matches!(node.part, Part::Torso | Part::LeftLeg | Part::RightLeg))
            .collect()
    }
}

/// Returns the closest body point, carried by the hips and both legs: in the middle half by each leg.
fn carried(band: &[&Node], carriers: &[&Node], position: Vec3) -> Option<Node> {
    let nearest = |nodes: &[&Node], left: bool| {
        let side = nodes.iter().filter(|node| (node.position.x >= 0.0) == left);
        let flat = |node: &Node| (node.position - position) * Vec3::new(1.0, 0.0, 1.0);
        side.min_by(|a, b| flat(a).length_squared().total_cmp(&flat(b).length_squared())).map(|node| **node)
    };
    let body = nearest(band, position.x >= 0.0).or_else(|| band.first().map(|node| **node))?;
    let (left, right) = (nearest(carriers, true)?, nearest(carriers, false)?);
    let legs = mix_skin(&right.skin, &left.skin, smoothstep(-0.15, 0.15, position.x));
    let hips = SkinWeights { joints: [0; 4], weights: [1.0, 0.0, 0.0, 0.0] };
    let skin = mix_skin(&legs, &hips, BY_HIPS);
    Some(Node { skin, ..body })
}

/// Returns the counter-clockwise corners of the hull (monotone chain).
fn convex_hull(mut points: Vec<Vec2>) -> Vec<Vec2> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    let mut hull: Vec<Vec2> = Vec::new();
    for turn in 0..2 {
        let start = hull.len();
        let mut add = |p: Vec2| {
            while hull.len() >= start + 2
                && (hull[hull.len() - 1] - hull[hull.len() - 2]).perp_dot(p - hull[hull.len() - 1]) <= 0.0
            {
                hull.pop();
            }
            hull.push(p);
        };
        if turn == 0 {
            points.iter().for_each(|p| add(*p));
        } else {
            points.iter().rev().for_each(|p| add(*p));
        }
        hull.pop();
    }
    hull
}

/// Returns the distance along a ray from inside to the hull's edge; 0 where it misses.
fn distance_to_hull(hull: &[Vec2], from: Vec2, direction: Vec2) -> f32 {
    let mut farthest = 0.0f32;
    for (i, &a) in hull.iter().enumerate() {
        let b = hull[(i + 1) % hull.len()];
        let edge = b - a;
        let det = direction.perp_dot(edge);
        if det.abs() < 1e-9 {
            continue;
        }
        let t = (a - from).perp_dot(edge) / det;
        let s = (a - from).perp_dot(direction) / det;
        if (-1e-4..=1.0001).contains(&s) {
            farthest = farthest.max(t);
        }
    }
    farthest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hull_of_a_square_with_points_inside_is_the_square() {
        let points = vec![
            Vec2::new(0.0, 0.0),
            Vec2::new(1.0, 0.0),
            Vec2::new(0.4, 0.6),
            Vec2::new(1.0, 1.0),
            Vec2::new(0.0, 1.0),
        ];
        let hull = convex_hull(points);
        assert_eq!(hull.len(), 4);
        assert!((distance_to_hull(&hull, Vec2::splat(0.5), Vec2::X) - 0.5).abs() < 1e-6);
        assert!((distance_to_hull(&hull, Vec2::splat(0.5), Vec2::ONE.normalize()) - 0.5f32.sqrt()).abs() < 1e-5);
    }
}

//! Straps over the shoulders: ribbons on the layer below.

use flyrig_body::Part;
use glam::{Vec2, Vec3};

use crate::clothes::garments::Tailor;
use crate::clothes::sheet::{Node, Sheet};

/// Half the width of a strap, metres.
const HALF_WIDTH_M: f32 = 0.0165;
/// Distance of a strap from the middle of the body in front and behind.
const ASIDE_M: [f32; 2] = [0.088, 0.066];
/// Line along x around which straps run over the shoulder (y, z of the average body).
const AXIS: Vec2 = Vec2::new(1.215, 0.020);
/// Range from the bib over the shoulder to the back, radians from the front.
const FROM_TO: [f32; 2] = [-0.10, 3.75];

impl Tailor {
    /// Adds both straps; `place` returns the strap's position above a node of the body.
    pub(crate) fn add_straps(&self, cloth: &mut Sheet, place: impl Fn(usize) -> Vec3) {
        const ROWS: u32 = 40;
        const COLUMNS: u32 = 4;
        let around = |p: Vec3| {
            let angle = (p.y - AXIS.x).atan2(p.z - AXIS.y);
            if angle < -1.6 { angle + std::f32::consts::TAU } else { angle }
        };
        let by_bib = |node: &&Node| node.average.distance_squared(Vec3::new(0.06, 1.13, 0.13));
        let Some(patch) = cloth.nodes.iter().min_by(|a, b| by_bib(a).total_cmp(&by_bib(b))).map(|node| node.uv) else {
            return;
        };
        for side in [1.0f32, -1.0] {
            let near: Vec<(f32, f32, usize)> = self
                .body
                .nodes
                .iter()
                .enumerate()
                .filter(|(_, node)| {
                    let p = node.average;
                    node.part == Part::Torso && (0.03..0.13).contains(&(p.x * side)) && p.y > 0.98
                })
                .map(|(i, node)| (node.average.x * side, around(node.average), i))
                .collect();
            let points: Option<Vec<Node>> = (0..=ROWS)
                .flat_map(|row| {
                    (0..=COLUMNS).map(move |column| (row as f32 / ROWS as f32, column as f32 / COLUMNS as f32))
                })
                .map(|(along, across)| {
                    let angle = FROM_TO[0] + (FROM_TO[1] - FROM_TO[0]) * along;
                    let x = ASIDE_M[0] + (ASIDE_M[1] - ASIDE_M[0]) * along + HALF_WIDTH_M * (2.0 * across - 1.0);
                    // The mean of the surface around, and the node closest to it.
                    let (mut sum, mut total, mut closest) = (Vec3::ZERO, 0.0, (0.0f32, None));
                    for &(node_x, node_angle, i) in &near {
                        let away = ((node_x - x) / 0.009).powi(2) + ((node_angle - angle) / 0.07).powi(2);
                        if away < 9.0 {
                            let weight = (-away).exp();
                            (sum, total) = (sum + place(i) * weight, total + weight);
                            if weight > closest.0 {
                                closest = (weight, Some(i));
                            }
                        }
                    }
                    let carrier = self.body.nodes[closest.1?];
                    let uv = patch + Vec2::new((across - 0.5) * 0.010, along * 0.02);
                    Some(Node { position: sum / total, uv, ..carrier })
                })
                .collect();
            let Some(points) = points else { continue };
            let first = cloth.nodes.len() as u32;
            cloth.nodes.extend(points);
            for row in 0..ROWS {
                for column in 0..COLUMNS {
                    let a = first + row * (COLUMNS + 1) + column;
                    let (b, c, d) = (a + 1, a + COLUMNS + 1, a + COLUMNS + 2);
                    let two = [[a, b, c], [b, d, c]];
                    cloth.triangles.extend(if side > 0.0 { two } else { two.map(|[p, q, r]| [p, r, q]) });
                }
            }
        }
    }
}

//! Shoes lofted around the feet, and eyeballs.

use flyrig_body::Part;
use glam::{Vec2, Vec3};

use crate::clothes::sheet::{Node, Sheet};
use crate::noise::smoothstep;
use crate::person::hair::ball;
use crate::person::regions::{ANKLE_TOP_M, EYE};

/// Thickness of a shoe's sole below the bare foot, metres.
pub(crate) const SOLE_M: f32 = 0.020;

/// Texture of uppers: the left half of the extras texture; soles: its upper right quarter; eyes: lower right.
const UPPER_U: f32 = 0.5;

/// Builds both shoes.
pub(crate) fn shoes(body: &Sheet) -> Sheet {
    let mut shoes = Sheet::default();
    for left in [true, false] {
        let foot: Vec<&Node> = body
            .nodes
            .iter()
            .filter(|node| (node.average.x > 0.0) == left && node.average.y < ANKLE_TOP_M + 0.015)
            .filter(|node| !matches!(node.part, Part::LeftHand | Part::RightHand))
            .collect();
        add_shoe(&mut shoes, &foot);
    }
    shoes
}

/// Half width, centre and top of the foot at one station from heel to toe.
struct Station {
    z: f32,
    x: f32,
    half_width: f32,
    top: f32,
}

fn add_shoe(shoes: &mut Sheet, foot: &[&Node]) {
    const STATIONS: usize = 26;
    const AROUND: u32 = 28;
    let low = foot.iter().map(|n| n.position.z).fold(f32::INFINITY, f32::min);
    let high = foot.iter().map(|n| n.position.z).fold(f32::NEG_INFINITY, f32::max);
    let ground = foot.iter().map(|n| n.position.y).fold(f32::INFINITY, f32::min);
    if foot.is_empty() || high - low < 0.05 {
        return;
    }
    let (heel, toe) = (low - 0.010, high + 0.014);
    let mut stations: Vec<Station> = (0..STATIONS)
        .map(|i| {
            let t = i as f32 / (STATIONS - 1) as f32;
            let z = heel + (toe - heel) * (0.5 - 0.5 * (t * std::f32::consts::PI).cos());
            let near = |n: &&&Node| (n.position.z - z.clamp(low + 0.012, high - 0.012)).abs() < 0.016;
            let (mut left, mut right, mut top) = (f32::INFINITY, f32::NEG_INFINITY, ground);
            for node in foot.iter().filter(near) {
                left = left.min(node.position.x);
                right = right.max(node.position.x);
                top = top.max(node.position.y);
            }
            if left > right {
                (left, right) = (0.0, 0.0);
            }
            Station { z, x: (left + right) * 0.5, half_width: (right - left) * 0.5 + 0.006, top: top + 0.007 }
        })
        .collect();
    for _ in 0..3 {
        for i in 1..STATIONS - 1 {
            let mean =
                |f: fn(&Station) -> f32| (f(&stations[i - 1]) + 2.0 * f(&stations[i]) + f(&stations[i + 1])) / 4.0;
            let (x, half_width, top) = (mean(|s| s.x), mean(|s| s.half_width), mean(|s| s.top));
            stations[i] = Station { x, half_width, top, ..stations[i] };
        }
    }
    let length = toe - heel;
    let mut add = |sole: bool| {
        let first = shoes.nodes.len() as u32;
        for (i, station) in stations.iter().enumerate() {
            // Rounded in plan at heel and toe.
            let from_end = (station.z - heel).min(toe - station.z).max(0.0);
            let round = 1.0 - (1.0 - (from_end / 0.042).min(1.0)).powi(2);
            let round = round.sqrt();
            let along = i as f32 / (STATIONS - 1) as f32;
            let toe_box = smoothstep(heel + 0.62 * length, toe, station.z);
            let top =
                (station.top.min(ground + 0.105)).max(ground + 0.045) * (1.0 - toe_box) + (ground + 0.046) * toe_box;
            let spring = 0.010 * smoothstep(heel + 0.75 * length, toe, station.z);
            let (bottom, height) = if sole {
                (ground - SOLE_M + spring, 0.031)
            } else {
                (ground - 0.004 + spring, (top - ground) * (0.35 + 0.65 * round))
            };
            let wide = (station.half_width + if sole { 0.005 } else { 0.0 }) * round.max(0.02);
            for k in 0..=AROUND {
                let angle = std::f32::consts::TAU * k as f32 / AROUND as f32;
                let (s, c) = angle.sin_cos();
                // A superellipse: flat for the sole, egg-shaped for the upper.
                let power = if sole { 0.35 } else { 0.72 };
                let side = c.signum() * c.abs().powf(power);
                let up = s.signum() * s.abs().powf(power);
                let narrow = if sole { 1.0 } else { 1.0 - 0.28 * up.max(0.0) * (1.0 - toe_box * 0.4) };
                let position =
                    Vec3::new(station.x + side * wide * narrow, bottom + height * (0.5 + 0.5 * up), station.z);
                let around = k as f32 / AROUND as f32;
                let uv = if sole {
                    Vec2::new(UPPER_U + 0.01 + 0.48 * around, 0.02 + 0.46 * along)
                } else {
                    Vec2::new((UPPER_U - 0.02) * around + 0.01, 0.02 + 0.96 * along)
                };
                let carrier = foot
                    .iter()
                    .min_by(|a, b| a.body.distance_squared(position).total_cmp(&b.body.distance_squared(position)));
                if let Some(&&carrier) = carrier {
                    shoes.nodes.push(Node { position, uv, ..carrier });
                }
            }
        }
        for i in 0..STATIONS as u32 - 1 {
            for k in 0..AROUND {
                let a = first + i * (AROUND + 1) + k;
                let (b, c) = (a + 1, a + AROUND + 1);
                shoes.triangles.extend([[a, b, c], [b, c + 1, c]]);
            }
        }
    };
    add(false);
    add(true);
}

/// Builds both eyeballs, textured by the lower right quarter of the extras.
pub(crate) fn eyes(body: &Sheet) -> Sheet {
    let mut eyes = Sheet::default();
    for side in [1.0, -1.0] {
        let mirror = Vec3::new(side, 1.0, 1.0);
        let (average, radius) = (EYE.0 * mirror, EYE.1);
        let near: Vec<&Node> =
            body.nodes.iter().filter(|node| node.average.distance(average) < radius * 1.35).collect();
        let Some(&&carrier) = near.first() else { continue };
        let moved = near.iter().map(|node| node.position - node.average).sum::<Vec3>() / near.len() as f32;
        // As large as the socket around it, child or old man.
        let spread = |of: fn(&Node) -> Vec3| {
            let middle = near.iter().map(|node| of(node)).sum::<Vec3>() / near.len() as f32;
            near.iter().map(|node| of(node).distance(middle)).sum::<f32>()
        };
        let scale = spread(|node| node.position) / spread(|node| node.average).max(1e-6);
        let first = eyes.nodes.len();
        ball(&mut eyes, &carrier, average + moved, radius * scale, average);
        for node in &mut eyes.nodes[first..] {
            let from_centre = (node.average - average) / radius;
            let front = if from_centre.z > 0.0 {
                from_centre.truncate() * 0.5
            } else {
                from_centre.truncate().normalize_or_zero() * 0.5
            };
            node.uv = Vec2::new(0.75 + 0.24 * front.x, 0.75 - 0.24 * front.y);
            // Each eye point is carried by the closest point of the lids and the socket.
            let close = near.iter().min_by(|a, b| {
                a.body.distance_squared(node.position).total_cmp(&b.body.distance_squared(node.position))
            });
            if let Some(close) = close {
                node.body = close.body;
                node.part = close.part;
            }
        }
    }
    eyes
}

//! Collars, lapels and hoods: cloth extruded from a neckline.

use glam::Vec3;

use crate::clothes::sheet::{Node, Sheet};
use crate::clothes::wardrobe::Outer;
use crate::noise::smoothstep;

/// Returns whether a point of a garment's edge is at its neckline.
fn at_neck(node: &Node) -> bool {
    node.average.y > 1.26 && node.average.x.abs() < 0.125
}

/// Returns the centre of the neckline, metres.
fn neck_centre(cloth: &Sheet) -> Vec3 {
    let edge: Vec<Vec3> = cloth
        .boundary()
        .iter()
        .map(|edge| cloth.nodes[edge[0] as usize])
        .filter(|node| at_neck(node) && node.average.y > 1.33)
        .map(|node| node.position)
        .collect();
    edge.iter().sum::<Vec3>() / edge.len().max(1) as f32
}

/// Returns the horizontal unit vector away from the neck.
fn outwards(node: &Node, centre: Vec3) -> Vec3 {
    ((node.position - centre) * Vec3::new(1.0, 0.0, 1.0)).normalize_or(Vec3::Z)
}

/// Adds a turned-down collar with points in front.
pub(crate) fn shirt_collar(cloth: &mut Sheet) {
    let centre = neck_centre(cloth);
    let stands = |node: &Node| at_neck(node) && (node.average.z < 0.0 || node.average.x.abs() > 0.010);
    cloth.extrude(9, stands, |node, t| {
        let out = outwards(node, centre);
        let front = smoothstep(0.2, 0.9, out.z);
        let (stand, turn) = ((t / 0.35).min(1.0), ((t - 0.35) / 0.65).max(0.0));
        let up = Vec3::Y * (0.028 - 0.010 * front) * stand - out * 0.005 * stand;
        let down =
            out * (0.007 + 0.013 * turn) * smoothstep(0.0, 0.25, turn) - Vec3::Y * (0.040 + 0.022 * front) * turn;
        let apart = Vec3::X * node.average.x.signum() * 0.012 * front * turn;
        node.position + up + down + apart
    });
}

/// Adds the collar and the turned-back edges of a jacket.
pub(crate) fn lapels(cloth: &mut Sheet, outer: &Outer) {
    let centre = neck_centre(cloth);
    let wide = outer.collar_m;
    cloth.extrude(
        8,
        |node| at_neck(node) && node.average.y > 1.30 && (node.average.z < 0.0 || node.average.x.abs() > 0.014),
        |node, t| {
            let out = outwards(node, centre);
            let front = smoothstep(0.1, 0.8, out.z);
            let (stand, turn) = ((t / 0.3).min(1.0), ((t - 0.3) / 0.7).max(0.0));
            let up = Vec3::Y * 0.026 * stand * (1.0 - 0.7 * front);
            let down = out * (0.008 * smoothstep(0.0, 0.3, turn) + 0.30 * wide * turn) - Vec3::Y * wide * 1.1 * turn;
            let apart = Vec3::X * node.average.x.signum() * wide * 0.55 * front * turn + Vec3::Z * 0.010 * front * turn;
            node.position + up + down + apart
        },
    );
}

/// Adds a hood that lies on the back.
pub(crate) fn hood(cloth: &mut Sheet) {
    let centre = neck_centre(cloth);
    cloth.extrude(12, at_neck, |node, t| {
        let out = outwards(node, centre);
        let behind = smoothstep(0.75, -0.5, out.z);
        let swell = (std::f32::consts::PI * t).sin();
        let up = Vec3::Y * (0.020 + 0.030 * behind) * (t * 3.0).min(1.0);
        let back = out * (0.012 * t + (0.045 * swell + 0.022 * t) * behind);
        let down = -Vec3::Y * (0.030 + 0.135 * behind) * t * t;
        node.position + up + back + down
    });
}

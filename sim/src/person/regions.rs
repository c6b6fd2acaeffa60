//! Regions of the average built-in body: canonical metres, y up, facing +z, standing on y = 0.

use glam::Vec3;

use crate::clothes::wardrobe::Beard;
use crate::noise::{lerp, smoothstep};

/// Centre and radius of the left eyeball (the right one mirrors it).
pub(crate) const EYE: (Vec3, f32) = (Vec3::new(0.0293, 1.5520, 0.1178), 0.0140);
pub(crate) const SHOULDER: Vec3 = Vec3::new(0.170, 1.320, 0.019);
pub(crate) const ELBOW: Vec3 = Vec3::new(0.331, 1.139, 0.020);
pub(crate) const WRIST: Vec3 = Vec3::new(0.453, 1.015, 0.183);
/// Height below which the body is inside the shoe.
pub(crate) const ANKLE_TOP_M: f32 = 0.085;

/// Returns the distance along the arm from the shoulder joint (elbow at 0.242, wrist at 0.482 m), and the distance from
/// its axis.
pub(crate) fn along_arm(p: Vec3) -> (f32, f32) {
    let p = Vec3::new(p.x.abs(), p.y, p.z);
    let upper = ELBOW - SHOULDER;
    let fore = WRIST - ELBOW;
    let (upper_m, fore_m) = (upper.length(), fore.length());
    let s = (p - SHOULDER).dot(upper) / upper_m;
    let f = (p - ELBOW).dot(fore) / fore_m;
    let near_upper = SHOULDER + upper * (s / upper_m).clamp(-1.0, 1.0);
    let near_fore = ELBOW + fore * (f / fore_m).clamp(0.0, 1.5);
    let (du, df) = (p.distance(near_upper), p.distance(near_fore));
    if du < df { (s.min(upper_m), du) } else { (upper_m + f.max(0.0), df) }
}

/// Returns the signed distance of a point of a top from the edge of the neck opening, metres, positive inside.
pub(crate) fn below_neckline(p: Vec3, v_neck_m: f32, radius_m: f32) -> f32 {
    let round = p.distance(Vec3::new(0.0, 1.45, 0.035)) - radius_m;
    if v_neck_m <= 0.0 || p.z < 0.0 {
        return round;
    }
    // A wedge down the front.
    let depth = (1.37 - p.y) / v_neck_m;
    let half_width = 0.055 * (1.0 - depth);
    round.min(p.x.abs() - half_width)
}

/// Returns the signed distance of a point from the hairline, metres, by direction around the head; positive on the
/// scalp.
pub(crate) fn above_hairline(p: Vec3, recede_m: f32) -> f32 {
    const LINE: [(f32, f32); 10] = [
        (0.0, 1.617),
        (0.45, 1.616),
        (0.80, 1.601),
        (1.05, 1.585),
        (1.22, 1.545),
        (1.42, 1.530),
        (1.58, 1.566),
        (1.85, 1.545),
        (2.20, 1.497),
        (3.15, 1.480),
    ];
    let around = p.x.abs().atan2(p.z - 0.040);
    let next = LINE.iter().position(|(angle, _)| *angle >= around).unwrap_or(LINE.len() - 1).max(1);
    let ((a0, y0), (a1, y1)) = (LINE[next - 1], LINE[next]);
    let line = lerp(y0, y1, ((around - a0) / (a1 - a0)).clamp(0.0, 1.0));
    let recede = if around < 1.0 { recede_m * (1.0 - around) } else { 0.0 };
    let above = p.y - line - recede;
    if is_ear(p) { above.min(-0.012) } else { above }
}

/// Returns whether a point of the average body is on an ear.
pub(crate) fn is_ear(p: Vec3) -> bool {
    p.x.abs() > 0.0665 && (1.495..1.562).contains(&p.y) && (0.012..0.075).contains(&p.z)
}

/// Returns whether a point of a top belongs to its sleeve.
pub(crate) fn on_sleeve(p: Vec3) -> bool {
    let (along, from_axis) = along_arm(p);
    along > 0.012 && from_axis < 0.078 && p.x.abs() > 0.13
}

/// Returns the angle around the upper arm's axis, 0 on its outer side.
pub(crate) fn around_arm(p: Vec3) -> f32 {
    let p = Vec3::new(p.x.abs(), p.y, p.z);
    let outward = Vec3::new(SHOULDER.y - ELBOW.y, ELBOW.x - SHOULDER.x, 0.0).normalize_or(Vec3::X);
    let from_axis = p - SHOULDER;
    let forward = if p.x > ELBOW.x { (p.x - ELBOW.x) / (WRIST.x - ELBOW.x) * (WRIST.z - ELBOW.z) } else { 0.0 };
    (from_axis.z - forward).atan2(from_axis.dot(outward))
}

/// Returns the signed distance of a point of the face from a beard's edge, metres, positive inside.
pub(crate) fn inside_beard(p: Vec3, beard: Beard) -> f32 {
    if is_ear(p) {
        return -0.01;
    }
    let x = p.x.abs();
    // Free of the lips; below the nose; above the throat; in front of the ears.
    let lips = (Vec3::new(x / 0.027, (p.y - 1.4845) / 0.0125, 0.0).length() - 1.0) * 0.0125;
    let nose = if p.z > 0.12 { 1.5065 - p.y } else { 0.02 };
    let throat = p.y - 1.432 - 0.25 * (0.09 - p.z).max(0.0);
    let moustache = (0.030 - x).min(p.y - 1.476).min(nose).min(p.z - 0.11).min(lips);
    match beard {
        Beard::None => -0.05,
        Beard::Moustache => moustache.min(p.y - 1.488),
        Beard::Goatee => moustache.max((0.026 - x).min(1.489 - p.y).min(p.z - 0.09).min(lips).min(throat)),
        Beard::Full | Beard::Long => {
            let cheek = lerp(1.502, 1.535, smoothstep(0.085, 0.045, p.z)) - p.y + 0.25 * (0.03 - x).max(0.0);
            cheek.min(nose).min(throat).min(p.z - 0.052).min(lips)
        }
    }
}

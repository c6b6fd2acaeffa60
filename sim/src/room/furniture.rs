//! Furniture and other objects, each standing on the floor around its own origin, with its front towards -y.

use std::f32::consts::{PI, TAU};

use glam::Vec3;

use crate::room::plan::Plan;
use crate::room::scene_mesh::{Coat, SceneMesh};
use crate::room::surfaces::Surface;

fn metal() -> Coat {
    Coat::new(Surface::Plain, Vec3::splat(0.05)).glossy(0.25)
}

fn wood(tint: Vec3) -> Coat {
    Coat::new(Surface::Wood, tint).glossy(0.08)
}

/// Height of a table's top, metres.
pub(crate) const TABLE_M: f32 = 0.74;

/// Adds a table on four legs.
pub(crate) fn table(mesh: &mut SceneMesh, half: [f32; 2], top: Coat, legs: Coat) {
    let [x, y] = half;
    mesh.block(Vec3::new(0.0, 0.0, TABLE_M - 0.016), Vec3::new(x, y, 0.016), top);
    mesh.block(Vec3::new(0.0, 0.0, TABLE_M - 0.06), Vec3::new(x - 0.06, y - 0.06, 0.03), legs);
    for (sx, sy) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
        let foot = Vec3::new(sx * (x - 0.06), sy * (y - 0.06), 0.0);
        mesh.rod(foot, foot + Vec3::Z * (TABLE_M - 0.04), [0.018, 0.026], legs);
    }
}

/// Adds a desk with a cabinet of drawers.
pub(crate) fn desk(mesh: &mut SceneMesh, plan: &Plan, index: u64) {
    let top = wood(Vec3::splat(plan.draw(index, 0.55, 0.9)));
    let body = Coat::new(Surface::Plain, Vec3::splat(plan.draw(index + 1, 0.12, 0.7)));
    mesh.block(Vec3::new(0.0, 0.0, TABLE_M - 0.014), Vec3::new(0.75, 0.36, 0.014), top);
    mesh.block(Vec3::new(-0.70, 0.0, 0.355), Vec3::new(0.014, 0.33, 0.355), body);
    mesh.block(Vec3::new(0.0, 0.31, 0.50), Vec3::new(0.68, 0.012, 0.20), body);
    mesh.block(Vec3::new(0.50, 0.02, 0.36), Vec3::new(0.20, 0.31, 0.34), body);
    for drawer in 0..3 {
        let z = 0.14 + 0.22 * drawer as f32;
        mesh.block(Vec3::new(0.50, -0.297, z), Vec3::new(0.185, 0.009, 0.100), body);
        mesh.block(Vec3::new(0.50, -0.315, z + 0.06), Vec3::new(0.06, 0.008, 0.006), metal());
    }
}

/// Adds a swivel chair on five wheels.
pub(crate) fn office_chair(mesh: &mut SceneMesh, cloth: Vec3) {
    let cloth = Coat::new(Surface::Weave, cloth);
    for leg in 0..5 {
        let (sin, cos) = (TAU * leg as f32 / 5.0).sin_cos();
        let end = Vec3::new(cos * 0.29, sin * 0.29, 0.075);
        mesh.rod(Vec3::new(0.0, 0.0, 0.10), end, [0.024, 0.016], metal());
        mesh.cushion(end - Vec3::Z * 0.045, Vec3::new(0.022, 0.022, 0.03), 0.3, metal());
    }
    mesh.rod(Vec3::Z * 0.09, Vec3::Z * 0.44, [0.026, 0.022], metal());
    mesh.cushion(Vec3::Z * 0.47, Vec3::new(0.245, 0.24, 0.045), 0.55, cloth);
    mesh.rod(Vec3::new(0.0, 0.20, 0.45), Vec3::new(0.0, 0.29, 0.66), [0.020, 0.016], metal());
    mesh.cushion(Vec3::new(0.0, 0.265, 0.80), Vec3::new(0.215, 0.035, 0.25), 0.55, cloth);
    for side in [-1.0, 1.0] {
        mesh.rod(Vec3::new(side * 0.25, 0.05, 0.46), Vec3::new(side * 0.28, 0.05, 0.66), [0.014, 0.014], metal());
        mesh.cushion(Vec3::new(side * 0.28, 0.03, 0.67), Vec3::new(0.032, 0.12, 0.016), 0.5, metal());
    }
}

/// Adds a wooden chair.
pub(crate) fn chair(mesh: &mut SceneMesh, tint: Vec3) {
    let coat = wood(tint);
    mesh.block(Vec3::new(0.0, 0.0, 0.445), Vec3::new(0.21, 0.205, 0.016), coat);
    for side in [-1.0f32, 1.0] {
        mesh.rod(Vec3::new(side * 0.19, -0.18, 0.0), Vec3::new(side * 0.18, -0.17, 0.44), [0.014, 0.019], coat);
        mesh.rod(Vec3::new(side * 0.19, 0.21, 0.0), Vec3::new(side * 0.18, 0.18, 0.45), [0.014, 0.019], coat);
        mesh.rod(Vec3::new(side * 0.18, 0.18, 0.45), Vec3::new(side * 0.17, 0.26, 0.90), [0.019, 0.015], coat);
        mesh.rod(Vec3::new(side * 0.185, -0.17, 0.22), Vec3::new(side * 0.185, 0.19, 0.22), [0.010, 0.010], coat);
    }
    for z in [0.60, 0.72, 0.84] {
        let y = 0.18 + 0.08 * (z - 0.45) / 0.45;
        mesh.block(Vec3::new(0.0, y, z), Vec3::new(0.165, 0.008, 0.030), coat);
    }
}

/// Adds a screen on its foot; `lit` is the light of its image, `layer` the plate's layer of that light.
pub(crate) fn screen(mesh: &mut SceneMesh, at: Vec3, picture: Surface, lit: f32, layer: usize) {
    let case = metal();
    mesh.block(at + Vec3::new(0.0, 0.02, 0.008), Vec3::new(0.12, 0.09, 0.008), case);
    mesh.block(at + Vec3::new(0.0, 0.05, 0.14), Vec3::new(0.025, 0.012, 0.14), case);
    mesh.block(at + Vec3::new(0.0, 0.02, 0.33), Vec3::new(0.285, 0.014, 0.17), case);
    let glow = Coat::new(picture, Vec3::splat(0.9)).glossy(0.3).glowing(lit, layer);
    mesh.quad(at + Vec3::new(-0.275, 0.0045, 0.17), Vec3::X * 0.55, Vec3::Z * 0.32, glow);
}

/// Adds a keyboard, a mouse, a mug and a pile of paper.
pub(crate) fn desk_things(mesh: &mut SceneMesh, at: Vec3, plan: &Plan, index: u64) {
    let dark = Coat::new(Surface::Plain, Vec3::splat(0.06));
    mesh.block(at + Vec3::new(0.0, -0.20, 0.009), Vec3::new(0.21, 0.065, 0.009), dark);
    for row in 0..4 {
        let y = -0.245 + 0.028 * row as f32;
        mesh.block(
            at + Vec3::new(0.0, y, 0.020),
            Vec3::new(0.20, 0.010, 0.004),
            Coat::new(Surface::Plain, Vec3::splat(0.14)),
        );
    }
    mesh.cushion(at + Vec3::new(0.29, -0.20, 0.014), Vec3::new(0.03, 0.052, 0.016), 0.3, dark);
    let mug = Coat::new(Surface::Plain, colour(plan, index)).glossy(0.25);
    mesh.rod(at + Vec3::new(-0.45, -0.12, 0.0), at + Vec3::new(-0.45, -0.12, 0.10), [0.038, 0.042], mug);
    for sheet in 0..4 {
        let z = 0.003 + 0.006 * sheet as f32;
        let half = Vec3::new(0.105, 0.148, 0.003);
        mesh.block(
            at + Vec3::new(0.48 + 0.01 * (sheet % 2) as f32, -0.08, z),
            half,
            Coat::new(Surface::Plain, Vec3::splat(0.8)),
        );
    }
}

/// Returns a saturated colour.
pub(crate) fn colour(plan: &Plan, index: u64) -> Vec3 {
    const COLOURS: [[f32; 3]; 10] = [
        [0.45, 0.06, 0.05],
        [0.05, 0.12, 0.32],
        [0.55, 0.38, 0.08],
        [0.07, 0.24, 0.16],
        [0.50, 0.47, 0.40],
        [0.10, 0.10, 0.11],
        [0.60, 0.22, 0.08],
        [0.20, 0.09, 0.22],
        [0.16, 0.33, 0.38],
        [0.62, 0.58, 0.50],
    ];
    Vec3::from(plan.pick(index, &COLOURS).unwrap_or([0.5; 3])) * plan.draw(index + 1000, 0.7, 1.2)
}

/// Adds a shelf of `levels` boards with half width `half_m`, with books and other objects.
pub(crate) fn shelf(mesh: &mut SceneMesh, plan: &Plan, index: u64, half_m: f32, levels: u32) {
    let coat = wood(Vec3::splat(plan.draw(index, 0.45, 1.0)));
    let height = 0.06 + 0.36 * levels as f32;
    for side in [-1.0, 1.0] {
        mesh.block(Vec3::new(side * half_m, 0.0, height / 2.0), Vec3::new(0.011, 0.15, height / 2.0), coat);
    }
    mesh.block(Vec3::new(0.0, 0.145, height / 2.0), Vec3::new(half_m, 0.005, height / 2.0), coat);
    for level in 0..=levels {
        let z = 0.06 + 0.36 * level as f32 - 0.011;
        mesh.block(Vec3::new(0.0, 0.0, z), Vec3::new(half_m, 0.15, 0.011), coat);
        if level == levels {
            continue;
        }
        mesh.shading = false;
        let seed = index + 20 + 100 * u64::from(level);
        let mut x = -half_m + 0.02;
        let mut book = 0;
        while x < half_m - 0.06 {
            let at = seed + 3 * book;
            let thick = plan.draw(at, 0.014, 0.045);
            let tall = plan.draw(at + 1, 0.19, 0.30);
            match plan.draw(at + 2, 0.0, 1.0) {
                kind if kind < 0.10 => x += plan.draw(at + 7, 0.05, 0.20),
                kind if kind < 0.16 && x + 0.24 < half_m => {
                    let coat = Coat::new(Surface::Card, Vec3::splat(plan.draw(at + 8, 0.5, 1.0)));
                    mesh.block(Vec3::new(x + 0.12, 0.0, z + 0.10), Vec3::new(0.11, 0.12, 0.09), coat);
                    x += 0.25;
                }
                kind if kind < 0.20 && x + 0.14 < half_m => {
                    let coat = Coat::new(Surface::Plain, colour(plan, at + 9)).glossy(0.2);
                    mesh.rod(
                        Vec3::new(x + 0.07, -0.02, z + 0.011),
                        Vec3::new(x + 0.07, -0.02, z + 0.16),
                        [0.035, 0.055],
                        coat,
                    );
                    mesh.rod(
                        Vec3::new(x + 0.07, -0.02, z + 0.16),
                        Vec3::new(x + 0.07, -0.02, z + 0.21),
                        [0.055, 0.025],
                        coat,
                    );
                    x += 0.15;
                }
                _ => {
                    let coat = Coat::new(Surface::Plain, colour(plan, at + 11)).glossy(0.08);
                    let deep = plan.draw(at + 12, 0.075, 0.11);
                    let half = Vec3::new(thick / 2.0, deep, tall / 2.0);
                    mesh.block(
                        Vec3::new(x + thick / 2.0, 0.03 - deep / 2.0 + 0.04, z + 0.011 + tall / 2.0),
                        half,
                        coat,
                    );
                    let band = Vec3::new(thick / 2.0 + 0.0006, 0.002, 0.012);
                    let front = 0.03 - deep / 2.0 + 0.04 - deep;
                    let cream = Coat::new(Surface::Plain, Vec3::new(0.6, 0.52, 0.36));
                    mesh.block(Vec3::new(x + thick / 2.0, front, z + 0.05 + tall * 0.6), band, cream);
                    x += thick + 0.002;
                }
            }
            book += 7;
        }
        mesh.shading = true;
    }
}

/// Adds a cardboard box with a strip of tape.
pub(crate) fn carton(mesh: &mut SceneMesh, half: Vec3, base_m: f32, tint: f32) {
    let middle = Vec3::Z * (half.z + base_m);
    mesh.block(middle, half, Coat::new(Surface::Card, Vec3::splat(tint)));
    let tape = Coat::new(Surface::Plain, Vec3::new(0.42, 0.30, 0.16)).glossy(0.2);
    mesh.block(middle + Vec3::Z * half.z, Vec3::new(half.x + 0.0008, 0.025, 0.0008), tape);
    mesh.block(middle + Vec3::Z * (half.z * 0.75), Vec3::new(half.x + 0.001, 0.025, half.z * 0.25), tape);
}

/// Adds a potted plant.
pub(crate) fn plant(mesh: &mut SceneMesh, plan: &Plan, index: u64, height_m: f32) {
    mesh.shading = false;
    let pot = Coat::new(Surface::Plain, colour(plan, index)).glossy(0.15);
    mesh.rod(Vec3::ZERO, Vec3::Z * 0.30, [0.13, 0.17], pot);
    mesh.rod(Vec3::Z * 0.285, Vec3::Z * 0.305, [0.155, 0.155], Coat::new(Surface::Carpet, Vec3::new(0.06, 0.04, 0.03)));
    let leaf = Coat::new(Surface::Leaf, Vec3::splat(plan.draw(index + 1, 0.75, 1.1))).glossy(0.12);
    let stem = Coat::new(Surface::Plain, Vec3::new(0.16, 0.20, 0.07));
    for shoot in 0..7u64 {
        let turn = TAU * (shoot as f32 / 7.0 + 0.08 * plan.draw(index + 10 + shoot, -1.0, 1.0));
        let lean = plan.draw(index + 20 + shoot, 0.10, 0.34);
        let (sin, cos) = turn.sin_cos();
        let foot = Vec3::new(cos * 0.05, sin * 0.05, 0.29);
        let tip =
            foot + Vec3::new(cos * lean, sin * lean, (height_m - 0.45) * plan.draw(index + 30 + shoot, 0.55, 1.0));
        mesh.rod(foot, tip, [0.010, 0.005], stem);
        for blade in 0..5u64 {
            let t = 0.45 + 0.55 * blade as f32 / 4.0;
            let (sin, cos) = (turn + 2.4 * blade as f32).sin_cos();
            let out = Vec3::new(cos, sin, 0.75);
            let length = plan.draw(index + 40 + shoot * 5 + blade, 0.16, 0.30);
            mesh.leaf(foot.lerp(tip, t), out, length, length * 0.36, 0.5, leaf);
        }
    }
    mesh.shading = true;
}

/// Adds a sofa for two.
pub(crate) fn sofa(mesh: &mut SceneMesh, cloth: Vec3) {
    let coat = Coat::new(Surface::Weave, cloth);
    mesh.cushion(Vec3::new(0.0, 0.0, 0.20), Vec3::new(0.86, 0.40, 0.14), 0.8, coat);
    mesh.cushion(Vec3::new(0.0, 0.34, 0.50), Vec3::new(0.86, 0.12, 0.32), 0.7, coat);
    for side in [-1.0, 1.0] {
        mesh.cushion(Vec3::new(side * 0.80, 0.0, 0.36), Vec3::new(0.11, 0.42, 0.24), 0.7, coat);
        mesh.cushion(Vec3::new(side * 0.35, -0.05, 0.40), Vec3::new(0.345, 0.34, 0.085), 0.65, coat);
        mesh.cushion(Vec3::new(side * 0.35, 0.20, 0.60), Vec3::new(0.335, 0.09, 0.20), 0.6, coat);
        for y in [-0.34, 0.36] {
            mesh.rod(Vec3::new(side * 0.76, y, 0.0), Vec3::new(side * 0.76, y, 0.08), [0.016, 0.024], metal());
        }
    }
    let pillow = Coat::new(Surface::Weave, Vec3::new(0.55, 0.36, 0.10));
    mesh.cushion(Vec3::new(0.48, 0.05, 0.60), Vec3::new(0.19, 0.07, 0.18), 0.45, pillow);
}

/// Adds a floor lamp; its shade glows with the lamp of this layer.
pub(crate) fn floor_lamp(mesh: &mut SceneMesh, height_m: f32, glow: f32, layer: usize) {
    mesh.rod(Vec3::ZERO, Vec3::Z * 0.025, [0.15, 0.15], metal());
    mesh.rod(Vec3::Z * 0.02, Vec3::Z * height_m, [0.011, 0.011], metal());
    let shade = Coat::new(Surface::Weave, Vec3::new(0.9, 0.80, 0.62)).glowing(glow, layer);
    let (low, high) = (Vec3::Z * (height_m - 0.14), Vec3::Z * (height_m + 0.14));
    mesh.rod(low, high, [0.21, 0.15], shade);
}

/// Adds a stand with a soft box at a height, aimed at `aim` (in the stand's axes); it glows with the lamp of this
/// layer.
pub(crate) fn soft_box(mesh: &mut SceneMesh, head: Vec3, aim: Vec3, side_m: f32, glow: f32, layer: usize) {
    let forward = (aim - head).normalize_or(-Vec3::Y);
    let right = forward.cross(Vec3::Z).normalize_or(Vec3::X);
    let up = right.cross(forward);
    let foot = Vec3::new(head.x, head.y, 0.0) - Vec3::new(forward.x, forward.y, 0.0) * 0.16;
    let joint = head - forward * 0.30;
    tripod(mesh, foot, joint);
    let h = side_m / 2.0;
    let cloth = Coat::new(Surface::Plain, Vec3::splat(0.025));
    let corner = |x: f32, y: f32, back: f32, size: f32| head - forward * back + (right * x + up * y) * size;
    // The face, a rim around it, and four slanting sides.
    let face = Coat::new(Surface::Plain, Vec3::ONE).glowing(glow, layer);
    mesh.quad(corner(1.0, -1.0, 0.02, h), -right * side_m, up * side_m, face);
    let ring = [(1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)];
    for i in 0..4 {
        let ((ax, ay), (bx, by)) = (ring[i], ring[(i + 1) % 4]);
        let (a, b) = (corner(ax, ay, 0.0, h), corner(bx, by, 0.0, h));
        mesh.rod(a, b, [0.012, 0.012], cloth);
        let (c, d) = (corner(ax, ay, 0.34, 0.09), corner(bx, by, 0.34, 0.09));
        // Slanting sides, as two strips that meet.
        mesh.quad(a, c - a, b - a, cloth);
        mesh.quad(d, b - d, c - d, cloth);
    }
    mesh.cushion(head - forward * 0.42, Vec3::splat(0.09), 0.4, metal());
}

/// Adds three legs and a column up to a point.
pub(crate) fn tripod(mesh: &mut SceneMesh, foot: Vec3, top: Vec3) {
    let hub = foot + Vec3::Z * (0.45f32).min(top.z * 0.6);
    for leg in 0..3 {
        let (sin, cos) = (TAU * leg as f32 / 3.0 + 0.4).sin_cos();
        mesh.rod(foot + Vec3::new(cos * 0.42, sin * 0.42, 0.01), hub, [0.010, 0.012], metal());
    }
    mesh.rod(foot + Vec3::Z * 0.12, Vec3::new(foot.x, foot.y, top.z), [0.016, 0.012], metal());
    mesh.rod(Vec3::new(foot.x, foot.y, top.z), top, [0.010, 0.010], metal());
}

/// Adds a flight case on wheels.
pub(crate) fn flight_case(mesh: &mut SceneMesh, half: Vec3) {
    let shell = Coat::new(Surface::Plain, Vec3::splat(0.035)).glossy(0.12);
    let edge = Coat::new(Surface::Plain, Vec3::splat(0.40)).glossy(0.4);
    let middle = Vec3::Z * (half.z + 0.08);
    mesh.block(middle, half, shell);
    for (sx, sy) in [(1.0f32, 1.0f32), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
        let post = middle + Vec3::new(sx * half.x, sy * half.y, 0.0);
        mesh.block(post, Vec3::new(0.012, 0.012, half.z + 0.004), edge);
        mesh.cushion(Vec3::new(sx * (half.x - 0.06), sy * (half.y - 0.06), 0.04), Vec3::splat(0.038), 0.3, metal());
    }
    for sz in [-1.0f32, 0.3, 1.0] {
        let at = middle + Vec3::Z * sz * half.z;
        mesh.block(at - Vec3::Y * half.y, Vec3::new(half.x + 0.004, 0.010, 0.012), edge);
        mesh.block(at + Vec3::X * half.x, Vec3::new(0.010, half.y, 0.012), edge);
        mesh.block(at - Vec3::X * half.x, Vec3::new(0.010, half.y, 0.012), edge);
    }
}

/// Adds a framed image on a wall behind it.
pub(crate) fn poster(mesh: &mut SceneMesh, middle: Vec3, half: [f32; 2], picture: Surface) {
    let frame = Coat::new(Surface::Plain, Vec3::splat(0.05)).glossy(0.1);
    let [x, z] = half;
    mesh.block(middle + Vec3::Y * 0.004, Vec3::new(x + 0.02, 0.012, z + 0.02), frame);
    let coat = Coat::new(picture, Vec3::ONE).glossy(0.12);
    mesh.quad(middle + Vec3::new(-x, -0.0095, -z), Vec3::X * 2.0 * x, Vec3::Z * 2.0 * z, coat);
}

/// Adds a rug on the floor.
pub(crate) fn rug(mesh: &mut SceneMesh, half: [f32; 2]) {
    let [x, y] = half;
    let low = Coat::new(Surface::Carpet, Vec3::new(0.35, 0.28, 0.2));
    mesh.quad(
        Vec3::new(-x, -y, 0.006),
        Vec3::X * 2.0 * x,
        Vec3::Y * 2.0 * y,
        Coat::new(Surface::Rug, Vec3::splat(0.85)),
    );
    for side in [-1.0, 1.0] {
        mesh.quad(Vec3::new(side * x, -side * y, 0.0), Vec3::Y * side * 2.0 * y, Vec3::Z * 0.006, low);
        mesh.quad(Vec3::new(-side * x, -side * y, 0.0), Vec3::X * side * 2.0 * x, Vec3::Z * 0.006, low);
    }
}

/// Adds a window in a wall behind it; it glows with the lamp of this layer.
pub(crate) fn window(mesh: &mut SceneMesh, middle: Vec3, half: [f32; 2], glow: f32, layer: usize) {
    let [x, z] = half;
    let white = Coat::new(Surface::Plain, Vec3::splat(0.75)).glossy(0.1);
    let pane = Coat::new(Surface::Outside, Vec3::ONE).glowing(glow, layer);
    mesh.quad(middle + Vec3::new(-x, 0.0, -z), Vec3::X * 2.0 * x, Vec3::Z * 2.0 * z, pane);
    for side in [-1.0, 1.0] {
        mesh.block(middle + Vec3::new(side * x, 0.0, 0.0), Vec3::new(0.035, 0.03, z + 0.035), white);
        mesh.block(middle + Vec3::new(0.0, 0.0, side * z), Vec3::new(x, 0.03, 0.035), white);
    }
    mesh.block(middle, Vec3::new(0.02, 0.02, z), white);
    mesh.block(middle + Vec3::Z * 0.2 * z, Vec3::new(x, 0.02, 0.018), white);
    mesh.block(middle - Vec3::new(0.0, 0.08, z + 0.05), Vec3::new(x + 0.10, 0.11, 0.015), white);
    // The radiator below.
    for fin in 0..14 {
        let at = middle + Vec3::new(-x * 0.8 + 1.6 * x * fin as f32 / 13.0, -0.05, -z - 0.42);
        mesh.block(at, Vec3::new(x * 0.05, 0.04, 0.26), white);
    }
}

/// Adds a stool with a round seat.
pub(crate) fn stool(mesh: &mut SceneMesh, tint: Vec3) {
    mesh.rod(Vec3::Z * 0.62, Vec3::Z * 0.65, [0.17, 0.17], wood(tint));
    for leg in 0..4 {
        let (sin, cos) = (TAU * (leg as f32 + 0.5) / 4.0).sin_cos();
        mesh.rod(
            Vec3::new(cos * 0.21, sin * 0.21, 0.0),
            Vec3::new(cos * 0.12, sin * 0.12, 0.62),
            [0.014, 0.018],
            wood(tint),
        );
    }
    for side in 0..4 {
        let at = |i: i32| {
            let (sin, cos) = (PI * (0.5 * i as f32 + 0.25)).sin_cos();
            Vec3::new(cos * 0.18, sin * 0.18, 0.24)
        };
        mesh.rod(at(side), at(side + 1), [0.009, 0.009], metal());
    }
}

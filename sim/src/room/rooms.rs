//! Rooms: a studio, an office, a cluttered room. Furniture stands outside the ring of cameras, except for intended
//! occluders.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use crate::room::furniture::{self, TABLE_M};
use crate::room::lamps::{Lamp, STAGE};
use crate::room::plan::{HEIGHT_M, Plan, RoomLight, shell};
use crate::room::scene_config::LightConfig;
use crate::room::scene_mesh::{Coat, SceneMesh};
use crate::room::surfaces::Surface;

const POSTERS: [Surface; 4] = [Surface::PosterA, Surface::PosterB, Surface::PosterC, Surface::PosterD];
/// Fraction of a lamp's light that returns as ambient light.
const BOUNCE: f32 = 0.26;

/// Places the following objects with their back to a wall: 0 at +y, 1 at +x, 2 at -y, 3 at -x; `aside_m` to its left.
fn against(mesh: &mut SceneMesh, plan: &Plan, wall: usize, aside_m: f32, deep_m: f32) {
    let yaw = -0.5 * PI * wall as f32;
    let (sin, cos) = yaw.sin_cos();
    let (x, y) = (-aside_m, plan.half_m - deep_m);
    mesh.place(Vec3::new(x * cos - y * sin, x * sin + y * cos, 0.0), yaw);
}

/// Returns a lamp's configuration at a position, aimed at its target.
fn lamp_at(place: Vec3, aim: Vec3, intensity: f32, colour: [f32; 3], size_m: f32) -> (LightConfig, Vec3) {
    let away = place - aim;
    let config = LightConfig {
        azimuth_deg: f64::from(away.y.atan2(away.x).to_degrees()),
        elevation_deg: f64::from((away.z / away.length()).asin().to_degrees()),
        distance_m: f64::from(away.length()),
        intensity: f64::from(intensity),
        colour: colour.map(f64::from),
        size_m: f64::from(size_m),
        switch: Vec::new(),
    };
    (config, aim)
}

/// Returns the configured lamps, or otherwise the room's own.
fn lamps(configured: &[LightConfig], own: &[(LightConfig, Vec3)]) -> Vec<Lamp> {
    if configured.is_empty() {
        own.iter().map(|(config, aim)| Lamp::new(config, *aim, BOUNCE)).collect()
    } else {
        configured.iter().map(|config| Lamp::new(config, STAGE, BOUNCE)).collect()
    }
}

/// Returns the layer of a plate in which an object glows with a lamp, or the constant layer without it.
fn layer_of(lamps: &[Lamp], lamp: usize) -> usize {
    const NONE: usize = 99;
    if lamp < lamps.len() { lamp + 1 } else { NONE }
}

pub(crate) fn studio(plan: &Plan, mesh: &mut SceneMesh, lights: &[LightConfig]) -> RoomLight {
    let side = if plan.draw(1, 0.0, 1.0) < 0.5 { 1.0 } else { -1.0 };
    let out = plan.ring_m + 0.6;
    let around = |degrees: f32, z: f32| {
        let (sin, cos) = degrees.to_radians().sin_cos();
        Vec3::new(cos * out, sin * out, z)
    };
    let warm = plan.draw(2, 0.0, 1.0);
    let key = [1.0, 0.97 - 0.05 * warm, 0.92 - 0.14 * warm];
    let rim =
        plan.pick(3, &[[0.72, 0.86, 1.0], [1.0, 0.95, 0.88], [0.80, 0.90, 1.0], [1.0, 0.80, 0.62]]).unwrap_or([1.0; 3]);
    let own = [
        lamp_at(around(-90.0 + side * plan.draw(4, 28.0, 50.0), 2.85), STAGE, plan.draw(5, 0.74, 0.84), key, 0.45),
        lamp_at(around(-90.0 - side * plan.draw(6, 100.0, 135.0), 2.6), STAGE, plan.draw(7, 0.40, 0.60), rim, 0.35),
    ];
    let lamps = lamps(lights, &own);

    let floor = match plan.draw(8, 0.0, 1.0) {
        kind if kind < 0.6 => Coat::new(Surface::Planks, Vec3::splat(plan.draw(9, 0.5, 0.85))).glossy(0.10),
        _ => Coat::new(Surface::Concrete, Vec3::splat(plan.draw(9, 0.35, 0.65))).glossy(0.06),
    };
    let grey = plan.draw(10, 0.14, 0.42);
    let wall = Coat::new(Surface::Plaster, Vec3::new(grey, grey * 1.02, grey * 1.06));
    shell(plan, mesh, floor, [wall; 4], Coat::new(Surface::Plain, Vec3::splat(grey * 1.5)));

    for (index, lamp) in lamps.iter().enumerate() {
        // A lamp within the ring would stand before the cameras.
        if lamp.place.truncate().length() > plan.ring_m + 0.3 {
            mesh.place(Vec3::ZERO, 0.0);
            furniture::soft_box(mesh, lamp.place, lamp.place + lamp.axis, 0.75, 2.2, layer_of(&lamps, index));
        }
    }
    // A roll of paper across from camera 0, and another around the corner.
    let paper = plan
        .pick(11, &[[0.62, 0.62, 0.60], [0.30, 0.38, 0.44], [0.52, 0.42, 0.33], [0.24, 0.32, 0.26], [0.42, 0.44, 0.48]])
        .map_or(Vec3::splat(0.6), Vec3::from);
    backdrop(mesh, plan, 0, 0.35 * side, 1.35, paper);
    backdrop(mesh, plan, if side > 0.0 { 3 } else { 1 }, 0.4, 1.1, Vec3::splat(0.05));
    for (wall, aside) in [(1, -1.7), (3, 1.9), (2, 1.4), (2, -1.3), (1, 2.0)] {
        let index = 100 + 17 * wall as u64 + (aside * 10.0) as u64 % 7;
        against(mesh, plan, wall, aside + plan.draw(index, -0.2, 0.2), 0.45);
        match (plan.draw(index + 1, 0.0, 5.0)) as u32 {
            0 => furniture::flight_case(mesh, Vec3::new(0.38, 0.28, 0.30)),
            1 => furniture::stool(mesh, Vec3::splat(0.5)),
            2 => furniture::tripod(mesh, Vec3::ZERO, Vec3::Z * 2.1),
            3 => furniture::plant(mesh, plan, index, 1.5),
            _ => {
                furniture::flight_case(mesh, Vec3::new(0.30, 0.25, 0.22));
                let top = mesh.at;
                mesh.at = top * glam::Affine3A::from_translation(Vec3::Z * 0.53);
                furniture::flight_case(mesh, Vec3::new(0.27, 0.22, 0.15));
            }
        }
    }
    against(mesh, plan, 2, 0.1, 0.04);
    furniture::poster(mesh, Vec3::Z * 1.75, [0.45, 0.6], POSTERS[(plan.draw(12, 0.0, 3.99)) as usize]);
    obstacles(plan, mesh);
    RoomLight { lamps, steady: Vec3::splat(0.02), sky: Vec3::new(1.0, 1.02, 1.06), ground: Vec3::new(0.52, 0.46, 0.40) }
}

/// Adds a wide roll of paper between two stands that runs out over the floor.
fn backdrop(mesh: &mut SceneMesh, plan: &Plan, wall: usize, aside_m: f32, half_m: f32, tint: Vec3) {
    const HIGH_M: f32 = 2.75;
    const BEND_M: f32 = 0.5;
    against(mesh, plan, wall, aside_m, 0.35);
    let cells = [mesh.cells(2.0 * half_m), mesh.cells(HIGH_M + 1.0)];
    let paper = Coat::new(Surface::Plain, tint);
    let quarter = BEND_M * PI * 0.5;
    let (wall_m, floor_m) = (HIGH_M - BEND_M, 0.35);
    mesh.grid(cells, paper, |t| {
        // From the floor's end up along the sheet.
        let s = t.y * (floor_m + quarter + wall_m);
        let x = (2.0 * t.x - 1.0) * half_m;
        let (y, z, normal) = if s < floor_m {
            (-BEND_M - floor_m + s, 0.004, Vec3::Z)
        } else if s < floor_m + quarter {
            let (sin, cos) = ((s - floor_m) / BEND_M).sin_cos();
            (-BEND_M + BEND_M * sin, 0.004 + BEND_M * (1.0 - cos), Vec3::new(0.0, -sin, cos))
        } else {
            (0.0, BEND_M + s - floor_m - quarter, -Vec3::Y)
        };
        (Vec3::new(x, y, z), normal, Vec2::new(x, s) * 0.7)
    });
    let (left, right) = (Vec3::new(-half_m - 0.12, 0.03, 0.0), Vec3::new(half_m + 0.12, 0.03, 0.0));
    mesh.rod(left + Vec3::Z * (HIGH_M + 0.03), right + Vec3::Z * (HIGH_M + 0.03), [0.045, 0.045], paper);
    for foot in [left, right] {
        furniture::tripod(mesh, foot - Vec3::Y * 0.12, foot + Vec3::new(0.0, -0.02, HIGH_M + 0.05));
    }
}

pub(crate) fn office(plan: &Plan, mesh: &mut SceneMesh, lights: &[LightConfig]) -> RoomLight {
    let h = plan.half_m;
    let window_wall = if plan.draw(1, 0.0, 1.0) < 0.5 { 1 } else { 3 };
    let towards = if window_wall == 1 { Vec3::X } else { -Vec3::X };
    let white = [1.0, 0.97, 0.91];
    let panel = |x: f32, y: f32| Vec3::new(x, y, HEIGHT_M - 0.03);
    let own = [
        lamp_at(towards * (h - 0.05) + Vec3::Z * 1.95, STAGE, plan.draw(2, 0.45, 0.75), [0.84, 0.92, 1.0], 0.9),
        lamp_at(
            panel(-towards.x * 1.3, -1.4),
            Vec3::new(-0.3 * towards.x, -0.3, 0.9),
            plan.draw(3, 0.42, 0.55),
            white,
            0.6,
        ),
        lamp_at(
            panel(-towards.x * 0.8, 1.6),
            Vec3::new(-0.2 * towards.x, 0.3, 0.9),
            plan.draw(3, 0.36, 0.50),
            white,
            0.6,
        ),
    ];
    let lamps = lamps(lights, &own);
    let always = lamps.len() + 1;

    let carpet = plan
        .pick(4, &[[0.19, 0.22, 0.27], [0.30, 0.28, 0.25], [0.17, 0.24, 0.23], [0.33, 0.30, 0.32]])
        .map_or(Vec3::splat(0.3), Vec3::from);
    let paint = |index| {
        let tones =
            [[0.66, 0.65, 0.61], [0.56, 0.62, 0.64], [0.66, 0.60, 0.52], [0.50, 0.58, 0.50], [0.62, 0.55, 0.53]];
        Coat::new(Surface::Plaster, plan.pick(index, &tones).map_or(Vec3::splat(0.6), Vec3::from))
    };
    let (plain, accent) = (paint(5), paint(6));
    let walls = [plain, plain, accent, plain];
    shell(plan, mesh, Coat::new(Surface::Carpet, carpet), walls, Coat::new(Surface::Plain, Vec3::splat(0.7)));

    // Panels of light in the ceiling, with the lamps and between them.
    mesh.place(Vec3::ZERO, 0.0);
    for (x, y, lamp) in [(-1.3, -1.4, 1), (1.3, -1.4, 1), (-0.8, 1.6, 2), (1.7, 1.6, 2), (-3.2, 0.2, 2)] {
        let at = Vec3::new(x * towards.x, y, HEIGHT_M - 0.012);
        let glow = Coat::new(Surface::Plain, Vec3::ONE).glowing(1.6, layer_of(&lamps, lamp));
        mesh.quad(at + Vec3::new(-0.3, 0.6, 0.0), Vec3::X * 0.6, -Vec3::Y * 1.2, glow);
    }
    against(mesh, plan, window_wall, 0.0, 0.03);
    furniture::window(mesh, Vec3::Z * 1.95, [1.1, 0.75], 1.5, layer_of(&lamps, 0));

    let cloth = furniture::colour(plan, 7);
    let far_wall = 4 - window_wall;
    for (wall, aside, index) in [(0, -0.9, 200), (0, 1.0, 240), (far_wall, 0.9, 280), (2, -1.1, 320)] {
        against(mesh, plan, wall, aside, 0.42);
        let desk = mesh.at;
        furniture::desk(mesh, plan, index);
        let picture = if index % 80 == 0 { Surface::ScreenB } else { Surface::ScreenA };
        furniture::screen(mesh, Vec3::new(plan.draw(index + 5, -0.2, 0.05), 0.08, TABLE_M), picture, 0.8, always);
        furniture::desk_things(mesh, Vec3::Z * TABLE_M, plan, index + 6);
        let push = glam::Affine3A::from_translation(Vec3::new(plan.draw(index + 7, -0.25, 0.2), -0.52, 0.0));
        mesh.at = desk * push * glam::Affine3A::from_rotation_z(PI + plan.draw(index + 8, -0.7, 0.7));
        furniture::office_chair(mesh, cloth);
    }
    for (wall, aside, levels) in [(far_wall, -1.1, 5), (2, 1.3, 4), (0, 2.9, 5)] {
        against(mesh, plan, wall, aside, 0.17);
        furniture::shelf(mesh, plan, 1000 + 1000 * wall as u64 + u64::from(levels), 0.55, levels);
    }
    for (wall, aside) in [(0, -2.6), (window_wall, 2.2), (2, 2.6)] {
        against(mesh, plan, wall, aside, 0.42);
        furniture::plant(mesh, plan, 5000 + 100 * wall as u64, plan.draw(5100 + wall as u64, 1.2, 1.8));
    }
    for (wall, aside, index) in [(0, 0.1, 0), (far_wall, 0.3, 1), (2, 0.1, 2)] {
        against(mesh, plan, wall, aside, 0.04);
        let picture = POSTERS[(index + (plan.draw(9, 0.0, 3.99)) as usize) % 4];
        furniture::poster(mesh, Vec3::Z * 1.85, if index == 1 { [0.34, 0.46] } else { [0.55, 0.38] }, picture);
    }
    obstacles(plan, mesh);
    RoomLight { lamps, steady: Vec3::splat(0.03), sky: Vec3::new(1.0, 1.01, 1.03), ground: Vec3::new(0.48, 0.47, 0.47) }
}

pub(crate) fn cluttered(plan: &Plan, mesh: &mut SceneMesh, lights: &[LightConfig]) -> RoomLight {
    let h = plan.half_m;
    let lamp_m = plan.ring_m + 0.75;
    let (sin, cos) = plan.draw(1, -2.4, -0.7).sin_cos();
    let standing = Vec3::new(cos * lamp_m, sin * lamp_m, 1.72);
    let warm = [1.0, 0.80, 0.55];
    let own = [
        lamp_at(Vec3::new(0.5, -0.9, 2.95), STAGE, plan.draw(2, 0.55, 0.75), [1.0, 0.88, 0.70], 0.25),
        lamp_at(standing, STAGE, plan.draw(3, 0.30, 0.45), warm, 0.35),
        lamp_at(Vec3::new(-h + 0.05, 0.6, 1.9), STAGE, plan.draw(4, 0.30, 0.6), [0.70, 0.84, 1.0], 0.9),
    ];
    let lamps = lamps(lights, &own);
    let always = lamps.len() + 1;

    let tones = [[0.52, 0.30, 0.24], [0.22, 0.32, 0.36], [0.58, 0.50, 0.36], [0.28, 0.36, 0.28], [0.56, 0.44, 0.42]];
    let tone = |index| Coat::new(Surface::Plaster, plan.pick(index, &tones).map_or(Vec3::splat(0.5), Vec3::from));
    let walls = [tone(5), tone(6), tone(5), tone(6)];
    let floor = Coat::new(Surface::Planks, Vec3::splat(plan.draw(7, 0.45, 0.8))).glossy(0.10);
    shell(plan, mesh, floor, walls, Coat::new(Surface::Plain, Vec3::splat(0.6)));

    mesh.place(Vec3::new(plan.draw(8, -0.3, 0.3), plan.draw(9, -0.3, 0.3), 0.0), plan.draw(10, 0.0, PI));
    furniture::rug(mesh, [1.35, 0.95]);
    // The lamp from the ceiling.
    if lights.is_empty() {
        mesh.place(Vec3::new(0.5, -0.9, 0.0), 0.0);
        let cable = Coat::new(Surface::Plain, Vec3::splat(0.03));
        mesh.rod(Vec3::Z * 3.02, Vec3::Z * HEIGHT_M, [0.004, 0.004], cable);
        let paper = Coat::new(Surface::Plain, Vec3::new(1.0, 0.93, 0.80)).glowing(1.5, 1);
        mesh.cushion(Vec3::Z * 2.95, Vec3::splat(0.19), 0.0, paper);
        mesh.place(standing * Vec3::new(1.0, 1.0, 0.0), 0.0);
        furniture::floor_lamp(mesh, 1.72, 1.3, 2);
    }
    against(mesh, plan, 3, -0.6, 0.03);
    furniture::window(mesh, Vec3::Z * 1.9, [0.8, 0.7], 1.3, layer_of(&lamps, 2));
    against(mesh, plan, 0, plan.draw(11, -0.4, 0.4), 0.52);
    furniture::sofa(mesh, furniture::colour(plan, 12));
    for (wall, aside, levels) in [(0, 1.9, 5), (0, -1.9, 4), (1, 0.6, 6), (1, -0.8, 5), (2, 0.4, 3)] {
        against(mesh, plan, wall, aside + plan.draw(20 + levels, -0.1, 0.1), 0.17);
        furniture::shelf(mesh, plan, 1000 + 300 * levels + wall as u64, 0.55, levels as u32);
    }
    // Boxes in piles.
    for (pile, (wall, aside)) in [(1usize, 2.0f32), (2, -1.9), (3, 1.7), (0, 3.2), (1, -2.3)].into_iter().enumerate() {
        let index = 300 + 20 * pile as u64;
        against(mesh, plan, wall, aside, plan.draw(index, 0.40, 0.60));
        let mut base = 0.0;
        for floor in 0..(plan.draw(index + 1, 1.5, 4.2)) as u64 {
            let half = Vec3::new(0.24, 0.20, plan.draw(index + 2 + floor, 0.13, 0.20));
            let turn = plan.draw(index + 8 + floor, -0.25, 0.25);
            let ground = mesh.at;
            mesh.at = ground * glam::Affine3A::from_rotation_z(turn);
            furniture::carton(mesh, half, base, plan.draw(index + 12 + floor, 0.6, 1.0));
            mesh.at = ground;
            base += 2.0 * half.z;
        }
    }
    against(mesh, plan, 2, -0.7, 0.42);
    let desk = mesh.at;
    furniture::desk(mesh, plan, 500);
    furniture::screen(mesh, Vec3::new(-0.1, 0.08, TABLE_M), Surface::ScreenA, 0.8, always);
    furniture::desk_things(mesh, Vec3::Z * TABLE_M, plan, 506);
    mesh.at = desk * glam::Affine3A::from_translation(-Vec3::Y * 0.5) * glam::Affine3A::from_rotation_z(PI - 0.5);
    furniture::chair(mesh, Vec3::splat(0.6));
    for (wall, aside) in [(3, 0.8), (0, -3.0), (2, 1.9)] {
        against(mesh, plan, wall, aside, 0.45);
        furniture::plant(mesh, plan, 600 + 90 * wall as u64, plan.draw(610 + wall as u64, 1.1, 1.9));
    }
    for (wall, aside, z, index) in
        [(0, 0.35, 1.9, 0), (0, -0.6, 1.75, 1), (2, -0.6, 1.95, 2), (3, -2.3, 1.8, 3), (3, 1.8, 1.9, 0)]
    {
        against(mesh, plan, wall, aside, 0.04);
        let half = if index % 2 == 0 { [0.30, 0.40] } else { [0.40, 0.30] };
        furniture::poster(mesh, Vec3::Z * z, half, POSTERS[(index + (plan.draw(13, 0.0, 3.99)) as usize) % 4]);
    }
    obstacles(plan, mesh);
    RoomLight {
        lamps,
        steady: Vec3::splat(0.015),
        sky: Vec3::new(1.0, 0.98, 0.94),
        ground: Vec3::new(0.50, 0.43, 0.36),
    }
}

/// Adds the objects between cameras and person.
fn obstacles(plan: &Plan, mesh: &mut SceneMesh) {
    let distance = (0.6 * plan.ring_m).max(1.75).min(plan.ring_m - 0.5);
    for piece in 0..plan.occluders {
        let index = 9000 + 50 * u64::from(piece);
        // Before every so-many-th camera, a little to one side.
        let camera = (piece as usize * plan.cameras) / plan.occluders.max(1) as usize;
        let angle = TAU * camera as f32 / plan.cameras as f32 - PI / 2.0 + plan.draw(index, -0.16, 0.16);
        let (sin, cos) = angle.sin_cos();
        let at = Vec3::new(cos * distance, sin * distance, 0.0);
        mesh.place(at, angle - PI / 2.0 + plan.draw(index + 1, -0.3, 0.3));
        let tint = Vec3::splat(plan.draw(index + 2, 0.4, 0.9));
        match (piece + plan.draw(index + 3, 0.0, 1.99) as u32) % 5 {
            0 => {
                furniture::table(
                    mesh,
                    [0.48, 0.28],
                    Coat::new(Surface::Wood, tint).glossy(0.1),
                    Coat::new(Surface::Plain, tint * 0.4),
                );
                furniture::desk_things(mesh, Vec3::new(0.0, 0.1, TABLE_M), plan, index + 4);
            }
            1 => furniture::chair(mesh, tint),
            2 => {
                furniture::carton(mesh, Vec3::new(0.26, 0.22, 0.20), 0.0, tint.x);
                furniture::carton(mesh, Vec3::new(0.22, 0.19, 0.16), 0.40, tint.x * 0.9);
            }
            3 => furniture::plant(mesh, plan, index + 5, 1.25),
            _ => furniture::stool(mesh, tint),
        }
    }
}

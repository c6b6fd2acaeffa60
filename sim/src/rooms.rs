//! Rooms: a studio, an office, a room full of things.

use glam::Vec3;

use crate::lamps::{Lamp, STAGE};
use crate::scene::{Plan, RoomLight, shell};
use crate::scene_config::LightConfig;
use crate::scene_mesh::{Coat, SceneMesh};
use crate::surfaces::Surface;

pub(crate) fn studio(plan: &Plan, mesh: &mut SceneMesh, lights: &[LightConfig]) -> RoomLight {
    let floor = Coat::new(Surface::Planks, Vec3::splat(0.9)).glossy(0.10);
    let wall = Coat::new(Surface::Plaster, Vec3::new(0.30, 0.31, 0.33));
    shell(plan, mesh, floor, [wall; 4], Coat::new(Surface::Plain, Vec3::splat(0.6)));
    let own = [
        LightConfig::default(),
        LightConfig {
            azimuth_deg: -35.0,
            intensity: 0.25,
            colour: [0.85, 0.92, 1.0],
            size_m: 0.5,
            ..LightConfig::default()
        },
        LightConfig { azimuth_deg: 80.0, intensity: 0.35, ..LightConfig::default() },
    ];
    let lights = if lights.is_empty() { &own[..] } else { lights };
    RoomLight {
        lamps: lights.iter().map(|light| Lamp::new(light, STAGE, 0.25)).collect(),
        steady: Vec3::splat(0.03),
        sky: Vec3::new(1.0, 1.02, 1.06),
        ground: Vec3::new(0.5, 0.44, 0.38),
    }
}

pub(crate) fn office(plan: &Plan, mesh: &mut SceneMesh, lights: &[LightConfig]) -> RoomLight {
    studio(plan, mesh, lights)
}

pub(crate) fn cluttered(plan: &Plan, mesh: &mut SceneMesh, lights: &[LightConfig]) -> RoomLight {
    studio(plan, mesh, lights)
}

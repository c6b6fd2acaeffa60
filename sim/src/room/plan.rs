//! Plan of a room: its dimensions and random choices, and the shell of floor, ceiling and walls.

use glam::Vec3;

use crate::camera::sensor::uniform;
use crate::room::lamps::Lamp;
use crate::room::scene_mesh::{Coat, SceneMesh};
use crate::room::surfaces::Surface;

/// Ceiling height, metres.
pub(crate) const HEIGHT_M: f32 = 3.6;

/// Dimensions and random choices of a room.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Plan {
    pub key: u64,
    /// Half the room's side, metres.
    pub half_m: f32,
    /// Radius of the ring of cameras, outside of which furniture stands.
    pub ring_m: f32,
    /// Pieces of furniture between cameras and person.
    pub occluders: u32,
    /// Number of cameras of the ring.
    pub cameras: usize,
}

impl Plan {
    /// Returns a uniform number in `low..high`; one per index.
    pub(crate) fn draw(&self, index: u64, low: f32, high: f32) -> f32 {
        low + (high - low) * uniform(self.key, index) as f32
    }

    /// Returns one of several values; one choice per index.
    pub(crate) fn pick<T: Copy>(&self, index: u64, of: &[T]) -> Option<T> {
        of.get((uniform(self.key, index) * of.len() as f64) as usize).copied()
    }
}

/// Light of a room.
pub(crate) struct RoomLight {
    pub lamps: Vec<Lamp>,
    pub steady: Vec3,
    pub sky: Vec3,
    pub ground: Vec3,
}

/// Adds floor, ceiling and walls, which cast no shadow.
pub(crate) fn shell(plan: &Plan, mesh: &mut SceneMesh, floor: Coat, walls: [Coat; 4], trim: Coat) {
    let h = plan.half_m;
    let side = 2.0 * h;
    mesh.quad(Vec3::new(-h, -h, 0.0), Vec3::X * side, Vec3::Y * side, floor);
    let white = Coat::new(Surface::Plaster, Vec3::splat(0.78));
    mesh.quad(Vec3::new(-h, h, HEIGHT_M), Vec3::X * side, -Vec3::Y * side, white);
    let corners = [Vec3::new(h, h, 0.0), Vec3::new(-h, h, 0.0), Vec3::new(-h, -h, 0.0), Vec3::new(h, -h, 0.0)];
    for (wall, coat) in walls.into_iter().enumerate() {
        let from = corners[wall];
        let along = corners[(wall + 1) % 4] - from;
        mesh.quad(from, along, Vec3::Z * HEIGHT_M, coat);
        let inward = Vec3::Z.cross(along).normalize_or(Vec3::X);
        // The skirting board.
        let (height, thick) = (0.11, 0.015);
        mesh.quad(from + inward * thick, along, Vec3::Z * height, trim);
        mesh.quad(from + inward * thick + Vec3::Z * height, along, -inward * thick, trim);
    }
    mesh.first_caster = mesh.triangles.len();
}

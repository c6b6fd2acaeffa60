//! Scene around the person: room, furniture and lamps.

use flyrig_types::Rig;
use glam::Vec3;

use crate::camera::sensor::{hash, uniform};
use crate::config::SimConfig;
use crate::room::lamps::Lamp;
use crate::room::plan::{HEIGHT_M, Plan};
use crate::room::rooms;
use crate::room::scene_config::SceneKind;
use crate::room::scene_mesh::SceneMesh;
use crate::room::surfaces::Surface;
use crate::texture::TextureImage;

/// All static objects, their textures and light.
#[derive(Debug, Clone)]
pub(crate) struct Scene {
    pub mesh: SceneMesh,
    /// Textures, one per [`Surface`].
    pub textures: Vec<TextureImage>,
    pub lamps: Vec<Lamp>,
    /// Ambient light that no lamp causes.
    pub steady: Vec3,
    /// Fractions of the ambient light from above and from below.
    pub sky: Vec3,
    pub ground: Vec3,
}

impl Scene {
    pub(crate) fn new(config: &SimConfig, rig: &Rig) -> Self {
        let seed = config.scene.seed.unwrap_or(config.seed);
        let key = hash(seed, 0x0005_ce4e);
        let kind = match config.scene.kind {
            SceneKind::BySeed => {
                let kinds = [SceneKind::Studio, SceneKind::Office, SceneKind::Cluttered];
                kinds[(uniform(key, 0) * 2.999) as usize]
            }
            kind => kind,
        };
        let ring_m = (config.cameras.radius_m + config.cameras.place_jitter_m) as f32;
        let half_m = ring_m + 1.45;
        let plan = Plan { key, half_m, ring_m, occluders: config.scene.occluders, cameras: config.cameras.count };
        let mut mesh = SceneMesh::new(cell_m(rig));
        let light = match kind {
            SceneKind::Office => rooms::office(&plan, &mut mesh, &config.lights),
            SceneKind::Cluttered => rooms::cluttered(&plan, &mut mesh, &config.lights),
            SceneKind::Studio | SceneKind::BySeed => rooms::studio(&plan, &mut mesh, &config.lights),
        };
        mesh.find_openness(half_m, HEIGHT_M);
        let side = config.texture_px.clamp(64, if config.height > 700 { 1024 } else { 512 }) as usize;
        let side = side.next_power_of_two();
        let used = |surface: Surface| mesh.vertices.iter().any(|vertex| vertex.paint[2] as u32 == surface as u32);
        let unused = || TextureImage { side, pixels: vec![[128; 4]; side * side] };
        let textures = Surface::ALL
            .iter()
            .map(|&surface| if used(surface) { surface.texture(side, seed) } else { unused() })
            .collect();
        Self { mesh, textures, lamps: light.lamps, steady: light.steady, sky: light.sky, ground: light.ground }
    }

    /// Returns whether an object glows independently of the lamps.
    pub(crate) fn glows(&self) -> bool {
        let layer = self.lamps.len() as u32 + 1;
        self.mesh.vertices.iter().any(|vertex| vertex.glow[0] > 0.0 && vertex.glow[1] as u32 == layer)
    }
}

/// Returns the longest side of a cell at which straight edges between its corners stay within a twentieth of a pixel of
/// the bent lens's curves, at a distance of a metre and a half.
fn cell_m(rig: &Rig) -> f32 {
    const ERROR_PX: f64 = 0.05;
    const DISTANCE_M: f64 = 1.5;
    let mut cell = 0.25f64;
    for camera in &rig.cameras {
        let i = &camera.intrinsics;
        let corner = glam::DVec2::new(i.width.into(), i.height.into()) * 0.5 / i.focal_px;
        let Some(edge) = i.lens.undistort(corner) else { continue };
        let direction = edge.normalize_or(glam::DVec2::X);
        let bent = |r: f64| i.lens.distort(direction * r).length();
        let mut curvature = 0.0f64;
        for step in 1..16 {
            let (r, h) = (edge.length() * f64::from(step) / 16.0, edge.length() / 16.0);
            curvature = curvature.max(((bent(r + h) - 2.0 * bent(r) + bent(r - h)) / (h * h)).abs());
        }
        // A chord of length l lies within l² / 8 times the second derivative of its curve.
        let angle = (8.0 * ERROR_PX / (i.focal_px.max_element() * curvature).max(1e-9)).sqrt();
        cell = cell.min(angle * DISTANCE_M);
    }
    cell.max(0.04) as f32
}

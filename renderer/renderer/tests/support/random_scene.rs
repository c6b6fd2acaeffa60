//! Random and poisoned scenes.
#![allow(dead_code)]

use flyrig_renderer::RasterSettings;
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2, DVec3, Vec3};
use rand::RngExt;
use rand::rngs::StdRng;

use super::reference::Scene;

/// Every kind of lens.
pub const LENSES: [Lens; 5] = [
    Lens::PINHOLE,
    Lens::RadialTangential { radial: [-0.25, 0.08, -0.01], tangential: [0.001, -0.002] },
    Lens::RadialTangential { radial: [0.1, -0.02, 0.0], tangential: [-0.003, 0.001] },
    Lens::Rational { radial: [0.5, 0.12, 0.01, 0.8, 0.25, 0.02], tangential: [0.002, -0.001] },
    Lens::Fisheye { coefficients: [0.04, -0.01, 0.002, -0.0005] },
];

fn camera(lens: Lens, width: u32, height: u32, camera_from_world: Isometry) -> Camera {
    let focal = f64::from(width.max(height));
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: "test".into(),
        intrinsics: Intrinsics {
            width,
            height,
            focal_px: DVec2::new(focal, focal * 1.02),
            center_px: DVec2::new(f64::from(width) * 0.5 - 0.3, f64::from(height) * 0.5 + 0.2),
            lens,
        },
        camera_from_world,
    }
}

/// Looks along world z, so that depths are the same number in f32 and f64.
pub fn straight(lens: Lens, width: u32, height: u32) -> Camera {
    camera(lens, width, height, Isometry::new(DQuat::IDENTITY, DVec3::new(0.0, 0.0, 2.0)))
}

/// Looks at the origin from 2.2 m away.
pub fn random_camera(rng: &mut StdRng, lens: Lens, width: u32, height: u32) -> Camera {
    let mut side = || rng.random_range(-1.0..1.0);
    let eye = DVec3::new(side(), side(), side()).normalize_or(DVec3::X) * 2.2;
    let target = DVec3::new(side(), side(), side()) * 0.1;
    camera(lens, width, height, Isometry::look_at(eye, target, DVec3::Z))
}

/// Gaussians of 1 mm to 16 cm in a cube of 2 m.
pub fn random_scene(rng: &mut StdRng, count: usize) -> Scene {
    let mut scene = Scene::default();
    for _ in 0..count {
        let mut signed = || rng.random_range(-1.0f32..1.0);
        let center = Vec3::new(signed(), signed(), signed());
        let normal = Vec3::new(signed(), signed(), signed()).normalize_or(Vec3::X);
        let canonical = Vec3::new(signed(), signed(), signed());
        let scale = 10f32.powf(rng.random_range(-3.0..-0.8));
        let opacity = match rng.random_range(0..4) {
            0 => 1.0,
            1 => rng.random_range(0.0..0.01),
            _ => rng.random_range(0.0..1.0),
        };
        let mut unit = || rng.random_range(0.0f32..1.0);
        scene.center_scale.push(center.extend(scale).to_array());
        scene.normal.push(normal.extend(0.0).to_array());
        scene.color.push([unit(), unit(), unit(), opacity]);
        scene.canonical.push(canonical.extend(0.0).to_array());
    }
    scene
}

/// Scales scene, camera and near plane by `unit`, with nothing culled.
pub fn scaled(scene: &Scene, camera: &Camera, unit: f64) -> (Scene, Camera, RasterSettings) {
    let (mut scene, mut camera) = (scene.clone(), camera.clone());
    scene.center_scale.as_flattened_mut().iter_mut().for_each(|v| *v *= unit as f32);
    camera.camera_from_world.translation *= unit;
    let plain = RasterSettings::default();
    (scene, camera, RasterSettings { near_m: plain.near_m * unit as f32, cull_backfacing: false, ..plain })
}

/// Replaces every third Gaussian's numbers by poison.
pub fn poison(rng: &mut StdRng, scene: &mut Scene) {
    const BAD: [f32; 7] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN_POSITIVE, -1.0, 0.0];
    for i in (0..scene.center_scale.len()).step_by(3) {
        let bad = BAD[rng.random_range(0..BAD.len())];
        let axis = rng.random_range(0..4);
        match rng.random_range(0..4) {
            0 => scene.center_scale[i][axis] = bad,
            1 => scene.color[i][3] = bad,
            2 => scene.center_scale[i][3] = bad,
            _ if bad.is_finite() => {}
            _ => [&mut scene.color, &mut scene.normal, &mut scene.canonical][axis % 3][i][axis % 3] = bad,
        }
    }
}

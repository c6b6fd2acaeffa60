//! Small simulations for tests.

// Not every test file uses all of it.
#![allow(dead_code)]

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SimConfig, Simulator, SurfaceMesh};
use glam::DVec3;

/// Returns a configuration of 128 x 128 pixels, two cameras, coarse textures.
pub fn small_config(seed: u64) -> SimConfig {
    let mut config = SimConfig { seed, width: 128, height: 128, texture_px: 128, ..SimConfig::default() };
    config.cameras.count = 2;
    config
}

pub fn simulator(config: &SimConfig) -> Simulator {
    Simulator::new(&GpuContext::new(&AdapterChoice::Best).unwrap(), config).unwrap()
}

/// Returns the nearest hit of a ray with the surface, in f64: distance along the ray and canonical position.
pub fn cast(mesh: &SurfaceMesh, eye: DVec3, ray: DVec3) -> Option<(f64, DVec3)> {
    let mut nearest: Option<(f64, DVec3)> = None;
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|v| mesh.positions[v as usize].as_dvec3());
        let (e1, e2) = (b - a, c - a);
        let h = ray.cross(e2);
        let det = e1.dot(h);
        if det.abs() < 1e-15 {
            continue;
        }
        let s = eye - a;
        let u = s.dot(h) / det;
        let q = s.cross(e1);
        let v = ray.dot(q) / det;
        let t = e2.dot(q) / det;
        if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0 && nearest.is_none_or(|(best, _)| t < best) {
            let [p, q, r] = triangle.map(|v| mesh.canonical[v as usize].as_dvec3());
            nearest = Some((t, p * (1.0 - u - v) + q * u + r * v));
        }
    }
    nearest
}

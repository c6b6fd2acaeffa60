//! Point clouds of analytic surfaces.
#![allow(dead_code, clippy::unwrap_used, clippy::panic)] // each test file uses a part; tests fail by panicking

use flyrig_mesh::OrientedPoint;
use glam::Vec3;
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

/// Returns a point of weight 1 and uncertainty of 1 mm.
pub fn row(position: Vec3, normal: Vec3) -> OrientedPoint {
    OrientedPoint { position, normal, weight: 1.0, uncertainty_m: 0.001 }
}

/// Returns evenly spread points of a sphere, metres.
pub fn sphere(count: usize, center: Vec3, radius: f32) -> Vec<OrientedPoint> {
    let at = |i: usize| {
        let z = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
        let (sin, cos) = (i as f32 * 2.399_963_1).sin_cos();
        let normal = Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
        row(center + normal * radius, normal)
    };
    (0..count).map(at).collect()
}

/// Returns points of a torus around the z axis, metres.
pub fn torus(count: usize, ring: f32, tube: f32) -> Vec<OrientedPoint> {
    let mut random = StdRng::seed_from_u64(4);
    let mut rows = Vec::new();
    while rows.len() < count {
        let [u, v, accept] = random.random::<[f32; 3]>();
        let (u, v) = (u * std::f32::consts::TAU, v * std::f32::consts::TAU);
        // By area.
        if accept * (ring + tube) < ring + tube * v.cos() {
            let normal = Vec3::new(u.cos() * v.cos(), u.sin() * v.cos(), v.sin());
            rows.push(row(Vec3::new(u.cos(), u.sin(), 0.0) * ring + normal * tube, normal));
        }
    }
    rows
}

/// Moves points along their normals by about normal noise of the given standard deviation, metres.
pub fn add_noise(rows: &mut [OrientedPoint], deviation: f32, seed: u64) {
    let mut random = StdRng::seed_from_u64(seed);
    for row in rows {
        let sum: f32 = random.random::<[f32; 12]>().iter().sum();
        row.position += row.normal * ((sum - 6.0) * deviation);
        row.uncertainty_m = deviation;
    }
}

/// Returns the mean of absolute values.
pub fn mean_abs(values: impl Iterator<Item = f32>) -> f32 {
    let (sum, count) = values.fold((0.0, 0), |(sum, count), value| (sum + value.abs(), count + 1));
    sum / count.max(1) as f32
}

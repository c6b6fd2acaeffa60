//! Fusion agrees with a plain f64 implementation of HGM Eq. 18, voxel by voxel.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_mesh::{Evidence, Fusion, FusionSettings, OrientedPoint, OrientedPoints, fuse};
use glam::{DVec3, Vec3};
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

/// Two plates 12 mm apart with opposing normals, and a sphere beside them, with noise in positions, normals and weights.
fn cloud() -> Vec<OrientedPoint> {
    let mut random = StdRng::seed_from_u64(1);
    let mut rows = support::sphere(600, Vec3::new(0.3, 0.05, 0.0), 0.05);
    for i in 0..900 {
        let place = Vec3::new((i % 30) as f32, (i / 30) as f32, 0.0) * 0.004;
        rows.push(support::row(place, Vec3::Z));
        rows.push(support::row(place + Vec3::new(0.001, 0.002, 0.012), -Vec3::Z));
    }
    for row in &mut rows {
        let mut noise = || Vec3::from_array(random.random::<[f32; 3]>()) - 0.5;
        row.position += noise() * 0.002;
        row.normal += noise() * 0.6;
        row.weight = 0.2 + random.random::<f32>();
    }
    rows
}

/// Returns the distance by the definition, and how near any decision was to going the other way.
fn reference(points: &OrientedPoints, settings: &FusionSettings, fusion: Fusion, x: DVec3) -> (Option<f64>, f64) {
    let radius = f64::from(settings.truncation_m);
    let cosine = f64::from(settings.angle_rad).cos();
    let sigma = f64::from(settings.decay_m);
    let mut margin = f64::INFINITY;
    let place = |i: usize| points.positions()[i].as_dvec3();
    let normal = |i: usize| points.normals()[i].as_dvec3();
    let mut near = Vec::new();
    for i in 0..points.len() {
        let distance = place(i).distance(x);
        margin = margin.min((distance - radius).abs() / radius * 1e2);
        if distance <= radius {
            near.push(i);
        }
    }
    let clamped = |i: usize| (x - place(i)).dot(normal(i)).clamp(-radius, radius);
    if near.is_empty() {
        return (None, margin);
    }
    if fusion == Fusion::Naive {
        return (Some(near.iter().map(|i| clamped(*i)).sum::<f64>() / near.len() as f64), margin);
    }
    let score = |i: usize| (2.0 * place(i).distance_squared(x) - (x - place(i)).dot(normal(i)).powi(2)).sqrt();
    near.sort_by(|a, b| score(*a).total_cmp(&score(*b)));
    if near.len() > 1 {
        margin = margin.min((score(near[1]) - score(near[0])) * 1e4);
    }
    let decay = |i: usize, sigma: f64| (-place(i).distance_squared(x) / (2.0 * sigma * sigma)).exp();
    let weight = |i: usize| f64::from(points.weights()[i]);
    let mut around = normal(near[0]);
    for sigma in [sigma / 2.0, sigma] {
        let mut sum = DVec3::ZERO;
        for &i in &near {
            margin = margin.min((normal(i).dot(around) - cosine).abs() * 1e2);
            if normal(i).dot(around) > cosine {
                sum += normal(i) * weight(i) * decay(i, sigma);
            }
        }
        around = sum.normalize_or(around);
    }
    let (mut sum, mut total, mut reach) = (0.0, 0.0, f64::INFINITY);
    for &i in &near {
        margin = margin.min((normal(i).dot(around) - cosine).abs() * 1e2);
        if normal(i).dot(around) > cosine {
            let offset = x - place(i);
            sum += weight(i) * decay(i, sigma) * clamped(i);
            total += weight(i) * decay(i, sigma);
            reach = reach.min((offset - normal(i) * offset.dot(normal(i))).length());
        }
    }
    margin = margin.min((reach - 2.0 * sigma).abs() / sigma * 1e2);
    ((total > 0.0 && reach <= 2.0 * sigma).then(|| sum / total), margin)
}

#[test]
fn every_voxel_has_the_distance_of_the_definition() {
    let points = OrientedPoints::from_rows(cloud());
    let settings = FusionSettings::from_points(&points).unwrap().with_voxel(0.006);
    for fusion in [Fusion::Hgm, Fusion::Naive] {
        let field = fuse(&points, &settings, fusion).unwrap();
        let (mut compared, mut skipped, mut unknown) = (0, 0, 0);
        for voxel in field.voxels() {
            let (expected, margin) = reference(&points, &settings, fusion, voxel.center.as_dvec3());
            // Where an angle or radius is at its threshold, f32 and f64 may differ.
            if margin < 0.01 {
                skipped += 1;
                continue;
            }
            compared += 1;
            match expected {
                Some(expected) => {
                    assert_eq!(voxel.evidence, Evidence::Points, "{voxel:?} {expected}");
                    let error = (f64::from(voxel.distance_m) - expected).abs();
                    assert!(error < 2e-6, "{voxel:?} {expected}");
                }
                None => {
                    unknown += 1;
                    assert_eq!(voxel.evidence, Evidence::Unknown, "{voxel:?}");
                }
            }
        }
        assert!(
            compared > 20 * skipped && compared - unknown > 5000 && unknown > 5000,
            "{compared} {skipped} {unknown}"
        );
    }
}

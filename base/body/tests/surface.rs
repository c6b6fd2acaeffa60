//! Gaussians lie evenly on the surface.
// Helpers of tests may stop a test.
#![allow(clippy::unwrap_used, clippy::panic)]

mod common;

use flyrig_body::{BodyError, ShapeParams, default_template, sample_surface};
use glam::Vec3;

/// Returns mean and coefficient of variation of the distance to the nearest other point, by a plain search.
fn nearest_statistics(points: &[Vec3]) -> (f64, f64) {
    let distances: Vec<f64> = points
        .iter()
        .enumerate()
        .map(|(i, p)| {
            let others = points.iter().enumerate().filter(|(j, _)| *j != i);
            f64::from(others.map(|(_, q)| p.distance_squared(*q)).fold(f32::MAX, f32::min)).sqrt()
        })
        .collect();
    let mean = distances.iter().sum::<f64>() / distances.len() as f64;
    let variance = distances.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / distances.len() as f64;
    (mean, variance.sqrt() / mean)
}

#[test]
fn spacing_is_much_evener_than_random() {
    let square = common::square();
    let gaussians = sample_surface(&square, 2000, 1).unwrap();
    assert_eq!(gaussians.len(), 2000);
    let (mean, variation) = nearest_statistics(&gaussians.positions);
    // For random points the mean is 0.5 / sqrt(density) with a variation of 0.52; the densest packing has 1.07.
    let of_square_root = mean * 2000f64.sqrt();
    assert!((0.75..1.07).contains(&of_square_root) && variation < 0.12, "mean {of_square_root}, variation {variation}");
    // The same density in every part of the square.
    for corner in [Vec3::ZERO, Vec3::new(0.5, 0.0, 0.0), Vec3::new(0.5, 0.5, 0.0)] {
        let inside = |p: &&Vec3| (p.x - corner.x - 0.25).abs() < 0.25 && (p.y - corner.y - 0.25).abs() < 0.25;
        let count = gaussians.positions.iter().filter(inside).count();
        assert!((470..530).contains(&count), "{count} in a quarter at {corner}");
    }
}

#[test]
fn every_gaussian_lies_on_its_triangle_of_the_body() {
    let body = default_template(&ShapeParams::default()).unwrap();
    let gaussians = sample_surface(&body, 6000, 7).unwrap();
    assert_eq!(gaussians.len(), 6000);
    for i in 0..gaussians.len() {
        let corners = body.triangles[gaussians.triangle[i] as usize].map(|corner| corner as usize);
        let weights = gaussians.barycentric[i];
        assert!(weights.iter().all(|w| *w >= -1e-6) && (weights.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        let blended: Vec3 = corners.iter().zip(weights).map(|(&corner, w)| body.positions[corner] * w).sum();
        assert!(blended.distance(gaussians.positions[i]) < 1e-5);
        assert!((gaussians.normals[i].length() - 1.0).abs() < 1e-4);
        assert!((gaussians.skin[i].weights.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        // Twelve influences are cut to four, so only the bulk has to agree with the corners.
        let strongest = gaussians.skin[i].joints[0];
        let share = |corner: usize| {
            let skin = &body.skin[corner];
            skin.joints.iter().zip(skin.weights).filter(|(j, _)| **j == strongest).map(|(_, w)| w).sum::<f32>()
        };
        assert!(corners.iter().any(|&corner| share(corner) > 0.2));
        let same_joint = body.skin.iter().position(|skin| skin.joints[0] == strongest).unwrap();
        assert_eq!(gaussians.parts[i], body.parts[same_joint]);
    }
    let mean = gaussians.scale_m.iter().sum::<f32>() / 6000.0;
    // 1.7 square metres over 6000: 17 mm apart, nearest neighbours a little less.
    assert!((0.011..0.0175).contains(&mean), "{mean}");
    let (nearest, _) = nearest_statistics(&gaussians.positions);
    assert!((f64::from(mean) - 0.9 * nearest).abs() < 0.1 * nearest);
}

#[test]
fn the_same_seed_gives_the_same_points() {
    let square = common::square();
    assert_eq!(sample_surface(&square, 300, 4).unwrap(), sample_surface(&square, 300, 4).unwrap());
    assert_ne!(sample_surface(&square, 300, 4).unwrap(), sample_surface(&square, 300, 5).unwrap());
}

#[test]
fn small_counts_are_exact() {
    for count in [1, 2, 3, 17] {
        let gaussians = sample_surface(&common::square(), count, 0).unwrap();
        assert_eq!(gaussians.len(), count);
        assert!(gaussians.scale_m.iter().all(|scale| scale.is_finite() && *scale > 0.0));
    }
}

#[test]
fn bad_surfaces_are_refused() {
    let refused = |template: &flyrig_body::Template, count| {
        let error = sample_surface(template, count, 0).unwrap_err();
        assert!(matches!(error, BodyError::Mesh { .. }));
        error.to_string()
    };
    assert!(refused(&common::square(), 0).contains("0 Gaussians"));
    assert!(refused(&common::square(), usize::MAX).contains("choose"));
    assert!(refused(&common::empty(), 10).contains("no triangles"));
    let flat = common::sheet(3, 3, |_, _| Vec3::ONE);
    let mut flat = flat;
    flat.normals.fill(Vec3::Y);
    assert!(refused(&flat, 10).contains("no area"));
    let mut poisoned = common::square();
    poisoned.positions[5].y = f32::NAN;
    assert!(refused(&poisoned, 10).contains("not a finite number"));
    let mut loose = common::square();
    loose.triangles[3][1] = 9999;
    assert!(refused(&loose, 10).contains("does not exist"));
    let mut short = common::square();
    short.uvs.pop();
    assert!(refused(&short, 10).contains("differ in number"));
}

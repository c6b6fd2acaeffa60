//! Meshes of true depths: what fusion and surface extraction lose by themselves, and what one instant shows of a person.

use anyhow::{Context as _, Result};
use flyrig_mesh::{MeshOptions, OrientedPoint, OrientedPoints, TriMesh, mesh_from_points};
use flyrig_types::{Camera, Intrinsics, Isometry};
use glam::{DVec3, Vec3};

use super::{depth::DepthImage, true_surface::TrueSurface};

/// Virtual cameras around a person, and their pixels along a side.
const AROUND: usize = 24;
const SIDE: u32 = 512;
/// Distance of virtual cameras from the person's centre, in its largest extents.
const DISTANCE: f64 = 2.5;

/// Meshes the true depths of some cameras.
///
/// # Errors
/// The cameras do not see enough of the surface.
pub(super) fn mesh_of_depths(truth: &TrueSurface, cameras: &[Camera]) -> Result<TriMesh> {
    let mut rows = Vec::new();
    for camera in cameras {
        let seen = DepthImage::render(camera, &truth.positions, &truth.triangles).points(camera);
        rows.extend(seen.into_iter().filter_map(|(position, triangle)| {
            let [a, b, c] = truth.triangles.get(triangle as usize)?.map(|i| truth.positions.get(i as usize));
            let normal = (*b? - *a?).cross(*c? - *a?);
            // True depths have no noise.
            Some(OrientedPoint { position: position.as_vec3(), normal, weight: 1.0, uncertainty_m: 0.0 })
        }));
    }
    let (mesh, _) = mesh_from_points(OrientedPoints::from_rows(rows), &MeshOptions::default())
        .context("no mesh of the true depths")?;
    Ok(mesh)
}

/// Returns virtual cameras evenly around a surface, above and below it too.
pub(super) fn cameras_around(positions: &[Vec3]) -> Vec<Camera> {
    let finite = || positions.iter().filter(|position| position.is_finite());
    let low = finite().fold(Vec3::INFINITY, |low, position| low.min(*position)).as_dvec3();
    let high = finite().fold(Vec3::NEG_INFINITY, |high, position| high.max(*position)).as_dvec3();
    if !low.is_finite() {
        return Vec::new();
    }
    let (center, extent) = (0.5 * (low + high), (high - low).max_element());
    let focal_px = f64::from(SIDE) * DISTANCE / 1.2;
    let camera = |i: usize| {
        // Fibonacci's spiral.
        let z = 1.0 - (2.0 * i as f64 + 1.0) / AROUND as f64;
        let (sin, cos) = (i as f64 * 2.399_963_229_728_653).sin_cos();
        let away = DVec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
        let up = if away.z.abs() > 0.9 { DVec3::X } else { DVec3::Z };
        let pose = Isometry::look_at(center + away * extent * DISTANCE, center, up);
        Camera::new(format!("around{i:02}"), Intrinsics::pinhole(SIDE, SIDE, focal_px), pose)
    };
    (0..AROUND).map(camera).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};

    use super::*;
    use crate::{harness::surface::Points, surfaces::score::SurfaceScore};

    #[test]
    fn true_depths_from_all_sides_return_the_surface_and_one_camera_does_not() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let points = Points::on(&body.positions, &body.triangles, 100_000);
        let truth = TrueSurface::new(body.positions.clone(), body.triangles.clone(), points, &[]);
        let cameras = cameras_around(&truth.positions);
        let chamfer = |cameras: &[Camera]| {
            let mesh = mesh_of_depths(&truth, cameras).unwrap();
            SurfaceScore::of(&mesh.positions, &mesh.triangles, &truth).chamfer_mm
        };
        let (all, one) = (chamfer(&cameras), chamfer(&cameras[..1]));
        assert!(all < 3.0 && one > 2.0 * all, "{all} mm of all cameras, {one} mm of one");
        assert!(mesh_of_depths(&truth, &[]).is_err());
        assert!(cameras_around(&[Vec3::splat(f32::NAN)]).is_empty());
    }
}

//! Meshes of true depths: what fusion and surface extraction lose by themselves, and what one instant shows of a person.

use anyhow::{Context as _, Result};
use flyrig_mesh::{MeshOptions, OrientedPoint, OrientedPoints, TriMesh, mesh_from_points};
use flyrig_types::Camera;

use super::{depth::DepthImage, true_surface::TrueSurface};

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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};
    use glam::Vec3;

    use super::*;
    use crate::{
        harness::surface::Points,
        surfaces::{score::SurfaceScore, visibility::cameras_around},
    };

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

//! Ring of cameras.

use std::f64::consts::TAU;

use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Lens, Rig};
use glam::{DQuat, DVec2, DVec3, EulerRot};

use crate::camera::name::camera_name;
use crate::camera::sensor::{hash, uniform};
use crate::config::SimConfig;
use crate::error::SimError;

/// Returns the configured ring: `00`, `01`, ... counter-clockwise seen from above, `00` at -y, z up.
///
/// # Errors
/// [`SimError::Config`] for settings out of range and for a lens that folds the image.
pub fn camera_ring(config: &SimConfig) -> Result<Rig, SimError> {
    config.validate()?;
    let ring = &config.cameras;
    let [k1, k2] = ring.radial;
    let size = DVec2::new(config.width.into(), config.height.into());
    let intrinsics = Intrinsics {
        width: config.width,
        height: config.height,
        focal_px: DVec2::splat(ring.focal_heights * size.y),
        center_px: (size - 1.0) * 0.5,
        lens: match ring.fisheye {
            Some(coefficients) => Lens::Fisheye { coefficients },
            None => Lens::RadialTangential { radial: [k1, k2, 0.0], tangential: ring.tangential },
        },
    };
    let target = DVec3::new(0.0, 0.0, ring.target_height_m);
    let cameras = (0..ring.count)
        .map(|slot| {
            let key = hash(hash(config.seed, 0x0ca3_e4a5), slot as u64);
            let draw = |index| 2.0 * uniform(key, index) - 1.0;
            let three = |first| DVec3::new(draw(first), draw(first + 1), draw(first + 2));
            let angle = TAU * slot as f64 / ring.count as f64 - TAU / 4.0;
            let place = DVec3::new(angle.cos() * ring.radius_m, angle.sin() * ring.radius_m, ring.height_m);
            let eye = (place + three(0) * ring.place_jitter_m).max(DVec3::new(f64::MIN, f64::MIN, 0.05));
            let turn = three(3) * ring.aim_jitter_deg.to_radians();
            let turn = Isometry::new(DQuat::from_euler(EulerRot::ZYX, turn.z, turn.y, turn.x), DVec3::ZERO);
            let mut intrinsics = intrinsics;
            intrinsics.focal_px *= 1.0 + draw(6) * ring.focal_jitter_percent * 0.01;
            check_lens(config, &intrinsics)?;
            Ok(Camera {
                time_offset_nanos: 0,
                color: Default::default(),
                id: CameraId::from(camera_name(slot)),
                intrinsics,
                camera_from_world: turn * Isometry::look_at(eye, target, DVec3::Z),
            })
        })
        .collect::<Result<_, SimError>>()?;
    let rig = Rig { cameras, world_up: DVec3::Z };
    rig.validate()?;
    Ok(rig)
}

/// Rejects a lens that has no direction for a corner of the image.
fn check_lens(config: &SimConfig, intrinsics: &Intrinsics) -> Result<(), SimError> {
    let ring = &config.cameras;
    let (width, height) = (f64::from(config.width), f64::from(config.height));
    // A margin of a grid's cell.
    let corner = |x, y| (DVec2::new(x, y) - intrinsics.center_px) / intrinsics.focal_px;
    let corners = [(-9.0, -9.0), (width + 8.0, -9.0), (-9.0, height + 8.0), (width + 8.0, height + 8.0)];
    if corners.iter().all(|&(x, y)| intrinsics.lens.undistort(corner(x, y)).is_some()) {
        return Ok(());
    }
    Err(SimError::Config {
        field: if ring.fisheye.is_some() { "cameras.fisheye" } else { "cameras.radial" },
        found: ring.fisheye.map_or_else(|| format!("{:?}", ring.radial), |k| format!("{k:?}")),
        expected: "a lens that does not fold over inside the image (weaker distortion or longer focal length)",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_centre_is_in_the_middle_of_every_image_and_up_is_up() {
        let config = SimConfig::default();
        let rig = camera_ring(&config).unwrap();
        assert_eq!(rig.cameras.len(), 7);
        for camera in &rig.cameras {
            let middle = camera.project(DVec3::new(0.0, 0.0, config.cameras.target_height_m)).unwrap();
            assert!((middle - DVec2::splat(255.5)).length() < 1e-6);
            assert!(camera.project(DVec3::new(0.0, 0.0, 1.6)).unwrap().y < 200.0);
        }
        assert!((rig.cameras[0].position() - DVec3::new(0.0, -3.0, 1.5)).length() < 1e-9);
    }

    #[test]
    fn a_lens_that_folds_is_refused() {
        let mut config = SimConfig::default();
        config.cameras.focal_heights = 0.4;
        config.cameras.radial = [-0.9, 0.0];
        assert!(camera_ring(&config).unwrap_err().to_string().contains("cameras.radial"));
    }
}

//! Cameras on a ring.

use std::f64::consts::TAU;

use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Lens, Rig};
use glam::{DVec2, DVec3};

use crate::{SimConfig, SimError};

/// The ring of a configuration: `00`, `01`, ... counter-clockwise seen from above, `00` at -y, z up.
///
/// # Errors
/// [`SimError::Config`] for settings out of range and for a lens that folds the picture.
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
            None => Lens::RadialTangential { radial: [k1, k2, 0.0], tangential: [0.0; 2] },
        },
    };
    let corner = intrinsics.lens.undistort((size * 0.5 + 1.0) / intrinsics.focal_px);
    if corner.is_none() {
        return Err(SimError::Config {
            field: if ring.fisheye.is_some() { "cameras.fisheye" } else { "cameras.radial" },
            found: ring.fisheye.map_or_else(|| format!("{:?}", ring.radial), |k| format!("{k:?}")),
            expected: "a lens that does not fold over inside the picture (weaker distortion or longer focal length)",
        });
    }
    let target = DVec3::new(0.0, 0.0, ring.target_height_m);
    let cameras = (0..ring.count)
        .map(|slot| {
            let angle = TAU * slot as f64 / ring.count as f64 - TAU / 4.0;
            let eye = DVec3::new(angle.cos() * ring.radius_m, angle.sin() * ring.radius_m, ring.height_m);
            Camera {
                id: CameraId::from(format!("{slot:02}")),
                intrinsics,
                camera_from_world: Isometry::look_at(eye, target, DVec3::Z),
            }
        })
        .collect();
    let rig = Rig { cameras, world_up: DVec3::Z };
    rig.validate()?;
    Ok(rig)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_centre_is_in_the_middle_of_every_picture_and_up_is_up() {
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

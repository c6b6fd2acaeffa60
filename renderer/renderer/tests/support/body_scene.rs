//! The built-in body as Gaussians, coloured by its normals, and cameras that look at it.
#![allow(dead_code)]

use flyrig_body::{BodyError, ShapeParams, default_template, sample_surface};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DVec2, DVec3};

use super::reference::Scene;

/// The standing body with `count` Gaussians, y up, facing +z.
pub fn body(count: usize) -> Result<Scene, BodyError> {
    let template = default_template(&ShapeParams::default())?;
    let surface = sample_surface(&template, count, 1)?;
    let quad = |v: glam::Vec3, w: f32| v.extend(w).to_array();
    Ok(Scene {
        center_scale: surface.positions.iter().zip(&surface.scale_m).map(|(p, s)| quad(*p, *s)).collect(),
        normal: surface.normals.iter().map(|n| quad(*n, 0.0)).collect(),
        color: surface.normals.iter().map(|n| quad(*n * 0.5 + 0.5, 1.0)).collect(),
        canonical: surface.positions.iter().map(|p| quad(*p, 0.0)).collect(),
    })
}

/// A camera 3 m from the body's axis at `azimuth` from its front, the body filling 0.78 of the height.
pub fn camera(scene: &Scene, width: u32, height: u32, azimuth: f64) -> Camera {
    let tall = scene.center_scale.iter().map(|c| f64::from(c[1])).fold(0.0, f64::max);
    let middle = DVec3::new(0.0, tall * 0.5, 0.0);
    let distance = 3.0;
    let focal = 0.78 * f64::from(height) * distance / tall;
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: "bench".into(),
        intrinsics: Intrinsics {
            width,
            height,
            focal_px: DVec2::splat(focal),
            center_px: DVec2::new(f64::from(width) * 0.5 - 0.5, f64::from(height) * 0.5 - 0.5),
            lens: Lens::RadialTangential { radial: [-0.05, 0.01, 0.0], tangential: [0.0005, -0.0005] },
        },
        camera_from_world: Isometry::look_at(
            middle + DVec3::new(azimuth.sin(), 0.1, azimuth.cos()) * distance,
            middle,
            DVec3::Y,
        ),
    }
}

/// Writes linear premultiplied colour over grey as an sRGB PNG.
pub fn save_png(path: &std::path::Path, color: &[[f32; 4]], width: u32, height: u32) -> image::ImageResult<()> {
    let mut out = image::RgbImage::new(width, height);
    for (pixel, c) in out.pixels_mut().zip(color) {
        let over = |channel: f32| {
            let linear = (channel + 0.2 * (1.0 - c[3])).clamp(0.0, 1.0);
            let srgb = if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
            (srgb * 255.0 + 0.5) as u8
        };
        *pixel = image::Rgb([over(c[0]), over(c[1]), over(c[2])]);
    }
    out.save(path)
}

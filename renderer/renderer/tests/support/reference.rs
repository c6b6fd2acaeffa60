//! Plain slow f64 reference of the rasteriser: sort everything, blend everything, front to back.
#![allow(dead_code)]

use flyrig_renderer::{BACKFACING_COSINE, RasterSettings};
use flyrig_types::Camera;
use glam::{DVec2, DVec3};

/// Gaussians on the CPU, element for element as in `GaussianBuffers`.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    pub center_scale: Vec<[f32; 4]>,
    pub normal: Vec<[f32; 4]>,
    pub color: Vec<[f32; 4]>,
    pub canonical: Vec<[f32; 4]>,
}

/// Images in f64, as in `RenderTarget`.
#[derive(Debug, Clone)]
pub struct Picture {
    pub color: Vec<[f64; 4]>,
    pub depth: Vec<f64>,
    pub canonical: Vec<[f64; 4]>,
}

/// One Gaussian in the image: place in the world and in pixels, camera z, opacity and inverse covariance after the
/// filter.
#[derive(Debug, Clone, Copy)]
pub struct Splat {
    pub index: usize,
    pub center: DVec3,
    pub pixel: DVec2,
    pub depth: f64,
    pub opacity: f64,
    pub xx: f64,
    pub xy: f64,
    pub yy: f64,
}

pub fn vec3(v: [f32; 4]) -> DVec3 {
    DVec3::new(v[0].into(), v[1].into(), v[2].into())
}

fn project(camera: &Camera, p: DVec3) -> DVec2 {
    let i = &camera.intrinsics;
    i.lens.distort(p.truncate() / p.z) * i.focal_px + i.center_px
}

/// The splat of Gaussian `index`, were its centre at `center`; none when it is not drawn.
pub fn splat_at(
    scene: &Scene,
    camera: &Camera,
    settings: &RasterSettings,
    index: usize,
    center: DVec3,
) -> Option<Splat> {
    let (center_scale, color) = (scene.center_scale[index], scene.color[index]);
    let finite = |v: &[f32; 4]| v.iter().all(|x| x.is_finite());
    let sigma = f64::from(center_scale[3]);
    let opacity = f64::from(color[3]);
    if !finite(&center_scale) || !finite(&color) || sigma <= 0.0 || opacity <= 0.0 {
        return None;
    }
    if settings.cull_backfacing {
        let normal = scene.normal[index];
        let sight = center - camera.position();
        let limit = BACKFACING_COSINE * vec3(normal).length() * sight.length();
        if !finite(&normal) || vec3(normal).dot(sight) > limit {
            return None;
        }
    }
    if settings.outputs.canonical && !finite(&scene.canonical[index]) {
        return None;
    }
    let p = camera.camera_from_world.transform_point(center);
    if p.z <= f64::from(settings.near_m) || p.z >= 1e9 {
        return None;
    }
    if (p.truncate() / p.z).length() > camera.intrinsics.lens.valid_radius() {
        return None;
    }
    // The Jacobian by central differences: independent of the formulas in the shader.
    let h = 1e-6 * p.length();
    let column = |axis: DVec3| (project(camera, p + axis * h) - project(camera, p - axis * h)) / (2.0 * h) * sigma;
    let columns = [column(DVec3::X), column(DVec3::Y), column(DVec3::Z)];
    let sum = |f: fn(&DVec2) -> f64| columns.iter().map(f).sum::<f64>();
    let (xx, xy, yy) = (sum(|c| c.x * c.x), sum(|c| c.x * c.y), sum(|c| c.y * c.y));
    let s = f64::from(settings.filter_variance_px2);
    let det = (xx * yy - xy * xy).max(0.0);
    let filtered_det = (xx + s) * (yy + s) - xy * xy;
    let kept = if settings.filter_keeps_opacity { 1.0 } else { (det / filtered_det).sqrt() };
    let opacity = opacity.min(1.0) * kept;
    // As the shader: what overflows f32 is not drawn.
    let overflows = filtered_det > f64::from(f32::MAX);
    (opacity > 1.0 / 255.0 && !overflows).then(|| Splat {
        index,
        center,
        pixel: project(camera, p),
        depth: p.z,
        opacity,
        xx: (yy + s) / filtered_det,
        xy: -xy / filtered_det,
        yy: (xx + s) / filtered_det,
    })
}

/// All splats, nearest first.
pub fn sorted_splats(scene: &Scene, camera: &Camera, settings: &RasterSettings) -> Vec<Splat> {
    let centers: Vec<DVec3> = scene.center_scale.iter().map(|c| vec3(*c)).collect();
    sorted_splats_at(scene, camera, settings, &centers)
}

/// [`sorted_splats`], were the centres at `centers`.
pub fn sorted_splats_at(scene: &Scene, camera: &Camera, settings: &RasterSettings, centers: &[DVec3]) -> Vec<Splat> {
    let mut splats: Vec<Splat> =
        (0..centers.len()).filter_map(|i| splat_at(scene, camera, settings, i, centers[i])).collect();
    splats.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    splats
}

/// Columns and rows (begin, end) outside which alpha is below the cut.
pub fn footprint(s: &Splat, width: u32, height: u32) -> ([usize; 2], [usize; 2]) {
    // The widest direction bounds all others.
    let widest = 1.0 / (0.5 * (s.xx + s.yy) - (0.25 * (s.xx - s.yy).powi(2) + s.xy * s.xy).sqrt()).max(1e-30);
    let radius = (2.0 * (255.0 * s.opacity).ln() * widest).sqrt() + 1.0;
    let span = |c: f64, size: u32| {
        let size = f64::from(size);
        [(c - radius).clamp(0.0, size) as usize, (c + radius + 1.0).clamp(0.0, size) as usize]
    };
    (span(s.pixel.x, width), span(s.pixel.y, height))
}

/// Renders the scene.
pub fn render(scene: &Scene, camera: &Camera, settings: &RasterSettings, width: u32, height: u32) -> Picture {
    blend(scene, &sorted_splats(scene, camera, settings), width, height)
}

/// Blends splats that are sorted by depth.
pub fn blend(scene: &Scene, splats: &[Splat], width: u32, height: u32) -> Picture {
    let pixels = width as usize * height as usize;
    let mut picture =
        Picture { color: vec![[0.0; 4]; pixels], depth: vec![0.0; pixels], canonical: vec![[0.0; 4]; pixels] };
    let mut transmittance = vec![1.0; pixels];
    for s in splats {
        let color = scene.color[s.index].map(f64::from);
        let canonical = scene.canonical[s.index].map(f64::from);
        let ([x0, x1], [y0, y1]) = footprint(s, width, height);
        for y in y0..y1 {
            for x in x0..x1 {
                let at = y * width as usize + x;
                let d = DVec2::new(x as f64, y as f64) - s.pixel;
                let r2 = s.xx * d.x * d.x + 2.0 * s.xy * d.x * d.y + s.yy * d.y * d.y;
                let alpha = (s.opacity * (-0.5 * r2).exp()).min(0.99);
                if alpha < 1.0 / 255.0 || transmittance[at] < 1e-4 {
                    continue;
                }
                let weight = alpha * transmittance[at];
                for c in 0..3 {
                    picture.color[at][c] += weight * color[c];
                    picture.canonical[at][c] += weight * canonical[c];
                }
                picture.depth[at] += weight * s.depth;
                transmittance[at] *= 1.0 - alpha;
            }
        }
    }
    for (at, transmittance) in transmittance.iter().enumerate() {
        let alpha = 1.0 - transmittance;
        picture.color[at][3] = alpha;
        picture.canonical[at][3] = alpha;
        if alpha > 0.0 {
            picture.depth[at] /= alpha;
        }
    }
    picture
}

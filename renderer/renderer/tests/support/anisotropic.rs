//! Anisotropic Gaussians: random scenes, and a plain slow f64 reference of their projection, colours and derivatives.
//! Blending is that of `reference.rs` and `reference_backward.rs`.
#![allow(dead_code)]

use std::f64::consts::PI;

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{AnisotropicBuffers, HarmonicOrder, RasterSettings};
use flyrig_types::Camera;
use glam::{DQuat, DVec2, DVec3};
use rand::RngExt;
use rand::rngs::StdRng;

use super::reference::{Picture, Scene, Splat, blend, vec3};
use super::reference_backward::{Incoming, Touched, splat_gradients};

/// Gaussians on the CPU, element for element as in `AnisotropicBuffers`.
#[derive(Debug, Clone)]
pub struct Ellipsoids {
    pub center: Vec<[f32; 4]>,
    pub scale_opacity: Vec<[f32; 4]>,
    pub rotation: Vec<[f32; 4]>,
    pub harmonics: Vec<[f32; 4]>,
    pub order: HarmonicOrder,
}

/// Copies a scene to the GPU.
pub fn upload(gpu: &GpuContext, scene: &Ellipsoids) -> Result<AnisotropicBuffers, GpuError> {
    let buffers = AnisotropicBuffers::zeroed(gpu, scene.center.len(), scene.order)?;
    buffers.center.write(gpu, &scene.center);
    buffers.scale_opacity.write(gpu, &scene.scale_opacity);
    buffers.rotation.write(gpu, &scene.rotation);
    buffers.harmonics.write(gpu, &scene.harmonics);
    Ok(buffers)
}

/// One Gaussian in f64.
#[derive(Debug, Clone)]
pub struct Ellipsoid {
    pub center: DVec3,
    pub scale: [f64; 3],
    pub opacity: f64,
    pub rotation: [f64; 4],
    pub harmonics: Vec<DVec3>,
}

impl Ellipsoid {
    /// Numbers of its geometry: centre, scales, opacity, quaternion.
    pub const SHAPE: usize = 11;

    /// The number `k` of its geometry.
    pub fn number(&mut self, k: usize) -> &mut f64 {
        match k {
            0..3 => &mut self.center[k],
            3..6 => &mut self.scale[k - 3],
            6 => &mut self.opacity,
            _ => &mut self.rotation[k - 7],
        }
    }

    /// Its splat; none when it is not drawn.
    pub fn splat(&self, camera: &Camera, settings: &RasterSettings, index: usize) -> Option<Splat> {
        let p = camera.camera_from_world.transform_point(self.center);
        if !(p.z > f64::from(settings.near_m) && p.z < 1e9) {
            return None;
        }
        if (p.truncate() / p.z).length() > camera.intrinsics.lens.valid_radius() {
            return None;
        }
        let project = |p: DVec3| {
            let i = &camera.intrinsics;
            i.lens.distort(p.truncate() / p.z) * i.focal_px + i.center_px
        };
        // The ellipse's matrix root by differences along the Gaussian's own axes.
        let [x, y, z, w] = self.rotation;
        let turn = camera.camera_from_world.rotation * DQuat::from_xyzw(x, y, z, w).normalize();
        let h = 1e-6 * p.length();
        let along = |axis: DVec3, scale: f64| {
            let step = turn * axis * h;
            (project(p + step) - project(p - step)) * (scale / (2.0 * h))
        };
        let columns = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().zip(self.scale).map(|(a, s)| along(a, s));
        let columns: Vec<DVec2> = columns.collect();
        let sum = |f: fn(&DVec2) -> f64| columns.iter().map(f).sum::<f64>();
        let (xx, xy, yy) = (sum(|c| c.x * c.x), sum(|c| c.x * c.y), sum(|c| c.y * c.y));
        let det = [(0, 1), (1, 2), (2, 0)].map(|(i, j)| columns[i].perp_dot(columns[j]).powi(2)).iter().sum::<f64>();
        let s = f64::from(settings.filter_variance_px2);
        let filtered_det = det + s * (xx + yy) + s * s;
        let kept = if settings.filter_keeps_opacity { 1.0 } else { (det / filtered_det).sqrt() };
        let opacity = self.opacity.min(1.0) * kept;
        let overflows = filtered_det > f64::from(f32::MAX);
        (opacity > 1.0 / 255.0 && !overflows).then(|| Splat {
            index,
            center: self.center,
            pixel: project(p),
            depth: p.z,
            opacity,
            xx: (yy + s) / filtered_det,
            xy: -xy / filtered_det,
            yy: (xx + s) / filtered_det,
        })
    }

    /// Its colour before the clamp.
    pub fn unclamped_color(&self, camera: &Camera) -> DVec3 {
        let values = harmonics((self.center - camera.position()).normalize());
        self.harmonics.iter().zip(values).map(|(c, value)| *c * value).sum()
    }
}

/// Real spherical harmonics by the angles of the direction, with the signs of the 3D Gaussian Splatting reference code.
pub fn harmonics(direction: DVec3) -> [f64; 9] {
    let (polar, turn) = (direction.z.clamp(-1.0, 1.0).acos(), direction.y.atan2(direction.x));
    let (one, two) = ((0.75 / PI).sqrt(), (3.75 / PI).sqrt());
    [
        (0.25 / PI).sqrt(),
        -one * polar.sin() * turn.sin(),
        one * polar.cos(),
        -one * polar.sin() * turn.cos(),
        0.5 * two * polar.sin().powi(2) * (2.0 * turn).sin(),
        -two * polar.sin() * polar.cos() * turn.sin(),
        (0.3125 / PI).sqrt() * (3.0 * polar.cos().powi(2) - 1.0),
        -two * polar.sin() * polar.cos() * turn.cos(),
        0.5 * two * polar.sin().powi(2) * (2.0 * turn).cos(),
    ]
}

impl Ellipsoids {
    pub fn count(&self) -> usize {
        self.center.len()
    }

    /// Harmonics of Gaussian `i`.
    pub fn harmonics_of(&mut self, i: usize) -> &mut [[f32; 4]] {
        let coefficients = self.order.coefficients();
        &mut self.harmonics[i * coefficients..(i + 1) * coefficients]
    }

    /// Gaussian `i`; none when a number rules out that it is drawn.
    pub fn get(&self, i: usize) -> Option<Ellipsoid> {
        let coefficients = self.order.coefficients();
        let harmonics = &self.harmonics[i * coefficients..(i + 1) * coefficients];
        let [x, y, z, _] = self.center[i];
        let (shape, rotation) = (self.scale_opacity[i], self.rotation[i]);
        let all_finite = |v: &[f32]| v.iter().all(|v| v.is_finite());
        let colors = harmonics.iter().all(|c| all_finite(&c[..3]));
        if !(all_finite(&[x, y, z]) && all_finite(&shape) && all_finite(&rotation) && colors) {
            return None;
        }
        let length: f64 = rotation.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        if shape.iter().any(|v| *v <= 0.0) || !(1e-15..1e15).contains(&length) {
            return None;
        }
        let [a, b, c, opacity] = shape.map(f64::from);
        Some(Ellipsoid {
            center: vec3(self.center[i]),
            scale: [a, b, c],
            opacity,
            rotation: rotation.map(f64::from),
            harmonics: harmonics.iter().map(|c| vec3(*c)).collect(),
        })
    }

    /// The splats of all, nearest first.
    pub fn splats(&self, camera: &Camera, settings: &RasterSettings) -> Vec<Splat> {
        let splat = |i| self.get(i)?.splat(camera, settings, i);
        let mut splats: Vec<Splat> = (0..self.count()).filter_map(splat).collect();
        splats.sort_by(|a, b| a.depth.total_cmp(&b.depth));
        splats
    }

    /// Colours of the splats as the camera sees them.
    pub fn colors(&self, camera: &Camera, splats: &[Splat]) -> Vec<DVec3> {
        let color = |s: &Splat| self.get(s.index).map_or(DVec3::ZERO, |g| g.unclamped_color(camera).max(DVec3::ZERO));
        splats.iter().map(color).collect()
    }

    /// Renders the scene.
    pub fn render(&self, camera: &Camera, settings: &RasterSettings, width: u32, height: u32) -> Picture {
        let splats = self.splats(camera, settings);
        let mut painted =
            Scene { color: vec![[0.0; 4]; self.count()], canonical: vec![[0.0; 4]; self.count()], ..Scene::default() };
        for (s, color) in splats.iter().zip(self.colors(camera, &splats)) {
            painted.color[s.index] = color.as_vec3().extend(0.0).to_array();
        }
        let mut picture = blend(&painted, &splats, width, height);
        // No canonical positions are drawn.
        picture.canonical.fill([0.0; 4]);
        picture
    }

    /// Moves colours away from the clamp at 0, where rounding decides whether a derivative passes.
    pub fn clear_of_clamp(&mut self, camera: &Camera) {
        for i in 0..self.count() {
            let Some(color) = self.get(i).map(|g| g.unclamped_color(camera)) else { continue };
            for c in (0..3).filter(|c| color[*c].abs() < 1e-3) {
                self.harmonics_of(i)[0][c] += 0.01;
            }
        }
    }
}

/// Derivatives, element for element as in `AnisotropicGradients`.
#[derive(Debug, Clone)]
pub struct Slopes {
    pub center: Vec<[f64; 4]>,
    pub scale_opacity: Vec<[f64; 4]>,
    pub rotation: Vec<[f64; 4]>,
    pub harmonics: Vec<[f64; 4]>,
}

impl Slopes {
    /// The attributes in their order.
    pub fn attributes(&self) -> [&Vec<[f64; 4]>; 4] {
        [&self.center, &self.scale_opacity, &self.rotation, &self.harmonics]
    }
}

/// The backward pass: blending from back to front, projection and colour by differences.
pub fn backward(
    scene: &Ellipsoids,
    camera: &Camera,
    settings: &RasterSettings,
    width: u32,
    touched: &Touched,
    incoming: &Incoming,
) -> Slopes {
    let (count, coefficients) = (scene.count(), scene.order.coefficients());
    let zeros = |count: usize| vec![[0.0; 4]; count];
    let mut out = Slopes {
        center: zeros(count),
        scale_opacity: zeros(count),
        rotation: zeros(count),
        harmonics: zeros(count * coefficients),
    };
    let colors = scene.colors(camera, &touched.splats);
    for (s, g) in touched.splats.iter().zip(splat_gradients(&colors, width, touched, incoming)) {
        let Some(gaussian) = scene.get(s.index) else { continue };
        let color = gaussian.unclamped_color(camera);
        let by_color = DVec3::from_array([0, 1, 2].map(|c| if color[c] >= 0.0 { g.color[c] } else { 0.0 }));
        // Change of the loss, were it linear in the splat's numbers and its colour.
        let change = |k: usize, step: f64| {
            let mut other = gaussian.clone();
            *other.number(k) += step;
            let splat = other.splat(camera, settings, s.index)?;
            Some(g.change(s, &splat) + by_color.dot(other.unclamped_color(camera) - color))
        };
        let slope = |k: usize, size: f64| {
            let pair = |h: f64| Some((change(k, h)? - change(k, -h)?) / (2.0 * h));
            let at = |h: f64| Some((4.0 * pair(0.5 * h)? - pair(h)?) / 3.0);
            [1e-3, 1e-4, 1e-5].iter().find_map(|h| at(h * size)).unwrap_or(0.0)
        };
        let length = gaussian.rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
        let sizes = [[s.depth; 3], gaussian.scale].concat();
        let slopes: Vec<f64> = sizes.iter().enumerate().map(|(k, size)| slope(k, *size)).collect();
        out.center[s.index] = [slopes[0], slopes[1], slopes[2], g.weight];
        // Linear up to 1, and constant above.
        let lower = gaussian.opacity * 1e-6;
        let by_opacity = if gaussian.opacity <= 1.0 { change(6, -lower).map_or(0.0, |c| -c / lower) } else { 0.0 };
        out.scale_opacity[s.index] = [slopes[3], slopes[4], slopes[5], by_opacity];
        out.rotation[s.index] = [7, 8, 9, 10].map(|k| slope(k, length));
        let values = harmonics((gaussian.center - camera.position()).normalize());
        for (k, value) in values[..coefficients].iter().enumerate() {
            out.harmonics[s.index * coefficients + k] = (by_color * *value).extend(0.0).to_array();
        }
    }
    out
}

/// Relative errors of each attribute in the 2-norm over all Gaussians. Blending weights count with the centres where they are
/// compared alone.
pub fn errors(found: &[Vec<[f32; 4]>; 4], expected: &Slopes) -> [f64; 5] {
    let relative = |found: &[[f32; 4]], expected: &[[f64; 4]], parts: std::ops::Range<usize>| {
        let (mut off, mut all) = (0.0, 0.0);
        for (a, b) in found.iter().zip(expected) {
            for k in parts.clone() {
                off += (f64::from(a[k]) - b[k]).powi(2);
                all += b[k] * b[k];
            }
        }
        if off == 0.0 { 0.0 } else { (off / all.max(1e-30)).sqrt() }
    };
    let [center, scale, rotation, harmonics] = expected.attributes();
    [
        relative(&found[0], center, 0..3),
        relative(&found[1], scale, 0..3),
        relative(&found[2], rotation, 0..4),
        relative(&found[1], scale, 3..4),
        relative(&found[3], harmonics, 0..3),
    ]
}

/// Names of what [`errors`] returns.
pub const ATTRIBUTES: [&str; 5] = ["centres", "scales", "rotations", "opacities", "harmonics"];

/// Gaussians of 1 mm to 16 cm along each axis in a cube of 2 m, with quaternions of any length and colours some of which are
/// clamped.
pub fn random_ellipsoids(rng: &mut StdRng, count: usize, order: HarmonicOrder) -> Ellipsoids {
    let mut scene = Ellipsoids { center: vec![], scale_opacity: vec![], rotation: vec![], harmonics: vec![], order };
    for _ in 0..count {
        let mut signed = || rng.random_range(-1.0f32..1.0);
        scene.center.push([signed(), signed(), signed(), 0.0]);
        let rotation = [signed(), signed(), signed(), signed()];
        for k in 0..order.coefficients() {
            let (middle, spread) = if k == 0 { (1.5, 1.7) } else { (0.0, 0.5) };
            scene.harmonics.push([(); 4].map(|()| middle + spread * signed()));
        }
        let length = 10f32.powf(rng.random_range(-1.0..1.0));
        scene.rotation.push(rotation.map(|v| v * length));
        let [a, b, c] = [(); 3].map(|()| 10f32.powf(rng.random_range(-3.0..-0.8)));
        let opacity = match rng.random_range(0..4) {
            0 => 1.0,
            1 => rng.random_range(0.0..0.01),
            _ => rng.random_range(0.0..1.0),
        };
        scene.scale_opacity.push([a, b, c, opacity]);
    }
    scene
}

/// Replaces a number of every third Gaussian by poison.
pub fn poison(rng: &mut StdRng, scene: &mut Ellipsoids) {
    const BAD: [f32; 8] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN_POSITIVE, -1.0, 0.0, 1e-20];
    for i in (0..scene.count()).step_by(3) {
        let bad = BAD[rng.random_range(0..BAD.len())];
        let axis = rng.random_range(0..4);
        match rng.random_range(0..6) {
            0 => scene.center[i][axis] = bad,
            1 => scene.scale_opacity[i][axis] = bad,
            2 => scene.rotation[i][axis] = bad,
            3 => scene.rotation[i] = [bad; 4],
            4 => scene.scale_opacity[i] = [bad; 4],
            // What is finite and large makes pixels that nothing can be compared with.
            _ if bad.is_finite() => {}
            _ => {
                let harmonics = scene.harmonics_of(i);
                let k = rng.random_range(0..harmonics.len());
                harmonics[k][axis] = bad;
            }
        }
    }
}

/// An isotropic scene as ellipsoids of equal scales and any rotation.
pub fn from_isotropic(rng: &mut StdRng, scene: &Scene) -> Ellipsoids {
    let order = HarmonicOrder::Zero;
    let mut out = random_ellipsoids(rng, scene.center_scale.len(), order);
    for i in 0..out.count() {
        let ([x, y, z, scale], [red, green, blue, opacity]) = (scene.center_scale[i], scene.color[i]);
        out.center[i] = [x, y, z, 0.0];
        out.scale_opacity[i] = [scale, scale, scale, opacity];
        let constant = harmonics(DVec3::X)[0] as f32;
        out.harmonics[i] = [red / constant, green / constant, blue / constant, 0.0];
    }
    out
}

//! Plain slow f64 reference of the planes of anisotropic Gaussians: rays meet planes, and derivatives are differences of the whole image.
#![allow(dead_code)]

use std::error::Error;

use flyrig_gpu::GpuContext;
use flyrig_renderer::{
    AnisotropicGradients, BackwardRasterizer, ImageGradients, RasterSettings, Rasterizer, RenderTarget,
};
use flyrig_types::Camera;
use glam::{DMat2, DQuat, DVec2, DVec3};
use rand::RngExt;
use rand::rngs::StdRng;

use super::anisotropic::{Ellipsoid, Ellipsoids, Slopes, upload};
use super::anisotropic_run::random_incoming;
use super::reference::Splat;
use super::reference_backward::{Incoming, Touched, touched_by, unclamped_alpha};

const MAX_ALPHA: f64 = 0.99;
const LEAST_COSINE: f64 = 0.01;
const REACH: f64 = 3.0;
const MOST_REACH: f64 = 0.9;

/// Plane of one Gaussian, camera axes.
#[derive(Debug, Clone)]
pub struct Plane {
    pub center: DVec3,
    /// Towards the camera.
    pub normal: DVec3,
    ideal_by_pixel: DMat2,
    /// Largest distance of a depth from that of the centre, metres.
    pub reach: f64,
    /// Whether a small change may choose another axis, sign or limit.
    unclear: bool,
}

impl Plane {
    pub fn new(gaussian: &Ellipsoid, camera: &Camera) -> Self {
        let center = camera.camera_from_world.transform_point(gaussian.center);
        let [x, y, z, w] = gaussian.rotation;
        let turn = camera.camera_from_world.rotation * DQuat::from_xyzw(x, y, z, w).normalize();
        let axes = [turn * DVec3::X, turn * DVec3::Y, turn * DVec3::Z];
        let mut order = [0, 1, 2];
        order.sort_by(|a, b| gaussian.scale[*a].total_cmp(&gaussian.scale[*b]));
        let along = axes[order[0]];
        let normal = if along.dot(center) > 0.0 { -along } else { along };
        let deviation = (0..3).map(|k| (gaussian.scale[k] * axes[k].z).powi(2)).sum::<f64>().sqrt();
        let lens = &camera.intrinsics.lens;
        let ideal = center.truncate() / center.z;
        let column = |axis: DVec2| {
            let pair = |h: f64| (lens.distort(ideal + axis * h) - lens.distort(ideal - axis * h)) / (2.0 * h);
            (4.0 * pair(5e-4) - pair(1e-3)) / 3.0 * camera.intrinsics.focal_px
        };
        let ideal_by_pixel = DMat2::from_cols(column(DVec2::X), column(DVec2::Y)).inverse();
        let facing = normal.dot(center) / center.z;
        let most = MOST_REACH * center.z;
        let unclear = (gaussian.scale[order[1]] / gaussian.scale[order[0]] - 1.0).abs() < 1e-3
            || (facing + LEAST_COSINE).abs() < 2e-4
            || facing.abs() < 2e-4
            || (REACH * deviation / most - 1.0).abs() < 1e-3;
        Self { center, normal, ideal_by_pixel, reach: most.min(REACH * deviation), unclear }
    }

    /// Depth in a pixel at an offset from the splat's centre, and whether a small change may start or end its limit.
    pub fn depth(&self, offset: DVec2) -> (f64, bool) {
        let z = self.center.z;
        let ray = (self.center.truncate() / z + self.ideal_by_pixel * offset).extend(1.0);
        let facing = self.normal.dot(self.center) / z;
        let share = if facing > -LEAST_COSINE {
            1.0 - self.normal.truncate().dot(self.ideal_by_pixel * offset) / LEAST_COSINE
        } else {
            self.normal.dot(ray) / facing
        };
        let depth = if share > 0.0 { z / share } else { f64::INFINITY };
        let slope = self.ideal_by_pixel.transpose() * self.normal.truncate() / facing.min(-LEAST_COSINE);
        let margin = 0.02 * (self.reach / z + slope.length());
        let near = |limit: f64| (share - z / limit).abs() < margin;
        (depth.clamp(z - self.reach, z + self.reach), near(z - self.reach) || near(z + self.reach))
    }
}

/// Splats, colours and planes of a scene, nearest first, with the lists of the pixels.
pub struct Drawn {
    pub touched: Touched,
    pub colors: Vec<DVec3>,
    pub planes: Vec<Plane>,
    pub width: usize,
}

impl Drawn {
    pub fn new(scene: &Ellipsoids, camera: &Camera, settings: &RasterSettings, (width, height): (u32, u32)) -> Self {
        let mut touched = touched_by(scene.splats(camera, settings), (width, height));
        let colors = scene.colors(camera, &touched.splats);
        let plane = |s: &Splat| scene.get(s.index).map(|gaussian| Plane::new(&gaussian, camera));
        let planes: Vec<Plane> = touched.splats.iter().filter_map(plane).collect();
        let width = width as usize;
        for (at, list) in touched.lists.iter().enumerate() {
            let pixel = DVec2::new((at % width) as f64, (at / width) as f64);
            let unclear = |k: &usize| planes[*k].unclear || planes[*k].depth(pixel - touched.splats[*k].pixel).1;
            touched.unclear[at] |= list.iter().any(unclear);
        }
        Self { touched, colors, planes, width }
    }

    /// Colour and alpha, then the sums of normals and depths, of a pixel; `change` is a splat that has become another.
    pub fn pixel(&self, at: usize, change: Option<(usize, &(Splat, DVec3, Plane))>) -> ([f64; 4], [f64; 4]) {
        let place = DVec2::new((at % self.width) as f64, (at / self.width) as f64);
        let (mut transmittance, mut color, mut normal, mut depth) = (1.0, DVec3::ZERO, DVec3::ZERO, 0.0);
        for &k in &self.touched.lists[at] {
            let (splat, paint, plane) = match change {
                Some((changed, (splat, color, plane))) if changed == k => (splat, *color, plane),
                _ => (&self.touched.splats[k], self.colors[k], &self.planes[k]),
            };
            let alpha = unclamped_alpha(splat, place.x, place.y).min(MAX_ALPHA);
            let weight = alpha * transmittance;
            color += weight * paint;
            normal += weight * plane.normal;
            depth += weight * plane.depth(place - splat.pixel).0;
            transmittance *= 1.0 - alpha;
        }
        (color.extend(1.0 - transmittance).to_array(), normal.extend(depth).to_array())
    }

    /// Derivatives of the loss that is linear in the images, by differences of fourth order.
    pub fn slopes(&self, scene: &Ellipsoids, camera: &Camera, settings: &RasterSettings, by: &PlaneIncoming) -> Slopes {
        let (count, coefficients) = (scene.count(), scene.order.coefficients());
        let zeros = |count: usize| vec![[0.0; 4]; count];
        let mut out = Slopes {
            center: zeros(count),
            scale_opacity: zeros(count),
            rotation: zeros(count),
            harmonics: zeros(count * coefficients),
        };
        let mut pixels = vec![Vec::new(); self.touched.splats.len()];
        for (at, list) in self.touched.lists.iter().enumerate().filter(|(at, _)| by.counts(*at)) {
            list.iter().for_each(|&k| pixels[k].push(at));
        }
        for (k, s) in self.touched.splats.iter().enumerate().filter(|(k, _)| !pixels[*k].is_empty()) {
            let Some(gaussian) = scene.get(s.index) else { continue };
            let loss = |moved: &Ellipsoid| {
                let splat = moved.splat(camera, settings, s.index)?;
                let color = moved.unclamped_color(camera).max(DVec3::ZERO);
                let change = (splat, color, Plane::new(moved, camera));
                Some(pixels[k].iter().map(|&at| by.dot(at, &self.pixel(at, Some((k, &change))))).sum::<f64>())
            };
            let slope = |step: f64, change: &dyn Fn(&mut Ellipsoid, f64)| {
                let moved = |by: f64| {
                    let mut moved = gaussian.clone();
                    change(&mut moved, by);
                    loss(&moved)
                };
                let pair = |h: f64| Some((moved(h)? - moved(-h)?) / (2.0 * h));
                let at = |h: f64| Some((4.0 * pair(0.5 * h)? - pair(h)?) / 3.0);
                at(step).unwrap_or(0.0)
            };
            let length = gaussian.rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
            let sizes = [&[s.depth; 3][..], &gaussian.scale, &[gaussian.opacity], &[length; 4]].concat();
            let number = |n: usize| slope(2e-5 * sizes[n], &|moved, by| *moved.number(n) += by);
            out.center[s.index][..3].copy_from_slice(&[0, 1, 2].map(number));
            out.scale_opacity[s.index] = [3, 4, 5, 6].map(number);
            out.rotation[s.index] = [7, 8, 9, 10].map(number);
            for h in 0..coefficients {
                for c in 0..3 {
                    out.harmonics[s.index * coefficients + h][c] =
                        slope(1e-4, &|moved, by| moved.harmonics[h][c] += by);
                }
            }
        }
        out
    }
}

/// dL/d colour and alpha, and dL/d planes.
#[derive(Debug, Clone)]
pub struct PlaneIncoming {
    pub color: Vec<[f32; 4]>,
    pub planes: Vec<[f32; 4]>,
}

impl PlaneIncoming {
    /// Random derivatives of pixels where rounding does not decide, zero elsewhere.
    pub fn random(rng: &mut StdRng, unclear: &[bool]) -> Self {
        let mut four =
            |unclear: &bool| [(); 4].map(|()| rng.random_range(-1.0f32..1.0)).map(|v| if *unclear { 0.0 } else { v });
        let color = unclear.iter().map(&mut four).collect();
        Self { color, planes: unclear.iter().map(&mut four).collect() }
    }

    /// Whether a pixel's derivatives are finite.
    pub fn counts(&self, at: usize) -> bool {
        self.color[at].iter().chain(&self.planes[at]).all(|v| v.is_finite())
    }

    fn dot(&self, at: usize, (color, planes): &([f64; 4], [f64; 4])) -> f64 {
        let dot = |a: &[f32; 4], b: &[f64; 4]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * b).sum::<f64>();
        dot(&self.color[at], color) + dot(&self.planes[at], planes)
    }

    /// With random derivatives by the depth of the centres, which must not count.
    pub fn with_depths(&self, rng: &mut StdRng) -> Incoming {
        Incoming { color: self.color.clone(), ..random_incoming(rng, self.color.len()) }
    }
}

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Images of a view as they are drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanePictures {
    pub color: Vec<[f32; 4]>,
    pub depth: Vec<f32>,
    pub planes: Vec<[f32; 4]>,
}

/// Draws a scene at the camera's size, with planes among the settings' outputs or not.
pub fn draw(
    gpu: &GpuContext,
    rasterizer: &mut Rasterizer,
    scene: &Ellipsoids,
    camera: &Camera,
    settings: &RasterSettings,
) -> Result<PlanePictures> {
    let target = RenderTarget::new(gpu, camera.intrinsics.width, camera.intrinsics.height)?.with_planes(gpu)?;
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    rasterizer.encode(gpu, &mut encoder, &upload(gpu, scene)?, camera, settings, &target)?;
    gpu.queue.submit([encoder.finish()]);
    let planes = target.planes.as_ref().map(|planes| planes.read(gpu)).transpose()?.unwrap_or_default();
    Ok(PlanePictures { color: target.color.read(gpu)?, depth: target.depth.read(gpu)?, planes })
}

/// Draws a scene and returns the derivatives with respect to the attributes in their order; without dL/d planes where `planes` is
/// `None`.
pub fn run(
    gpu: &GpuContext,
    (forward, backward): (&mut Rasterizer, &mut BackwardRasterizer),
    scene: &Ellipsoids,
    camera: &Camera,
    settings: &RasterSettings,
    (incoming, planes): (&Incoming, Option<&[[f32; 4]]>),
) -> Result<[Vec<[f32; 4]>; 4]> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let gaussians = upload(gpu, scene)?;
    let out = AnisotropicGradients::zeroed(gpu, scene.count(), scene.order)?;
    let target = RenderTarget::new(gpu, width, height)?.with_planes(gpu)?;
    let mut gradients = ImageGradients::zeroed(gpu, width, height)?;
    gradients.color.write(gpu, &incoming.color);
    gradients.depth_carry.write(gpu, &incoming.depth_carry);
    if let Some(planes) = planes {
        gradients = gradients.with_planes(gpu)?;
        gradients.planes.iter().for_each(|image| image.write(gpu, planes));
    }
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    out.clear(&mut encoder);
    forward.encode(gpu, &mut encoder, &gaussians, camera, settings, &target)?;
    backward.encode_anisotropic(gpu, &mut encoder, forward, &gaussians, &target, &gradients, &out)?;
    gpu.queue.submit([encoder.finish()]);
    let [center, scale, rotation, harmonics] = out.attributes().map(|attribute| attribute.read(gpu));
    Ok([center?, scale?, rotation?, harmonics?])
}

//! Shared by the raster tests and the benchmark.
#![allow(dead_code)]

pub mod anisotropic;
pub mod anisotropic_run;
pub mod body_scene;
pub mod planes;
pub mod random_scene;
pub mod reference;
pub mod reference_backward;

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{GaussianBuffers, RasterSettings, Rasterizer, RenderTarget};
use flyrig_types::Camera;
use reference::{Picture, Scene};

/// Copies a scene to the GPU.
pub fn upload(gpu: &GpuContext, scene: &Scene) -> Result<GaussianBuffers, GpuError> {
    let buffers = GaussianBuffers::zeroed(gpu, scene.center_scale.len())?;
    buffers.center_scale.write(gpu, &scene.center_scale);
    buffers.normal.write(gpu, &scene.normal);
    buffers.color.write(gpu, &scene.color);
    buffers.canonical.write(gpu, &scene.canonical);
    Ok(buffers)
}

/// Renders on the GPU and reads everything back.
pub fn render(
    gpu: &GpuContext,
    rasterizer: &mut Rasterizer,
    gaussians: &GaussianBuffers,
    camera: &Camera,
    settings: &RasterSettings,
    (width, height): (u32, u32),
) -> Result<Pictures, GpuError> {
    let target = RenderTarget::new(gpu, width, height)?;
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    rasterizer.encode(gpu, &mut encoder, gaussians, camera, settings, &target)?;
    gpu.queue.submit([encoder.finish()]);
    Ok(Pictures {
        color: target.color.read(gpu)?,
        depth: target.depth.read(gpu)?,
        canonical: target.canonical.read(gpu)?,
    })
}

/// A `RenderTarget` on the CPU.
#[derive(Debug, Clone, PartialEq)]
pub struct Pictures {
    pub color: Vec<[f32; 4]>,
    pub depth: Vec<f32>,
    pub canonical: Vec<[f32; 4]>,
}

impl Pictures {
    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        let all = |v: &[[f32; 4]]| v.as_flattened().iter().all(|x| x.is_finite());
        all(&self.color) && all(&self.canonical) && self.depth.iter().all(|x| x.is_finite())
    }
}

/// Differences of two sets of images.
#[derive(Debug, Clone, Copy, Default)]
pub struct Difference {
    /// Colour and alpha.
    pub color_max: f64,
    pub color_mean: f64,
    /// Share of pixels whose colour differs by more than 1/255.
    pub color_visible: f64,
    /// Depth times alpha, metres.
    pub depth_max: f64,
    pub depth_mean: f64,
    /// Metres times alpha.
    pub canonical_max: f64,
    pub canonical_mean: f64,
}

impl Difference {
    pub fn between(ours: &Pictures, reference: &Picture) -> Self {
        let mut d = Self::default();
        let pixels = ours.color.len().max(1) as f64;
        for i in 0..ours.color.len() {
            let worst = |a: &[f32; 4], b: &[f64; 4]| {
                a.iter().zip(b).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max)
            };
            let color = worst(&ours.color[i], &reference.color[i]);
            let canonical = worst(&ours.canonical[i], &reference.canonical[i]);
            let depth = (f64::from(ours.depth[i]) * f64::from(ours.color[i][3])
                - reference.depth[i] * reference.color[i][3])
                .abs();
            d.color_max = d.color_max.max(color);
            d.color_mean += color / pixels;
            d.color_visible += f64::from(u8::from(color > 1.0 / 255.0)) / pixels;
            d.depth_max = d.depth_max.max(depth);
            d.depth_mean += depth / pixels;
            d.canonical_max = d.canonical_max.max(canonical);
            d.canonical_mean += canonical / pixels;
        }
        d
    }
}

impl From<&Pictures> for Picture {
    fn from(p: &Pictures) -> Self {
        Self {
            color: p.color.iter().map(|v| v.map(f64::from)).collect(),
            depth: p.depth.iter().map(|v| f64::from(*v)).collect(),
            canonical: p.canonical.iter().map(|v| v.map(f64::from)).collect(),
        }
    }
}

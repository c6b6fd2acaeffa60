//! Runs the kernels on anisotropic Gaussians and compares their derivatives with the reference.
#![allow(dead_code)]

use std::error::Error;

use flyrig_gpu::GpuContext;
use flyrig_renderer::{
    AnisotropicGradients, BackwardRasterizer, ImageGradients, RasterSettings, Rasterizer, RenderTarget,
};
use flyrig_types::Camera;
use rand::RngExt;
use rand::rngs::StdRng;

use super::anisotropic::{Ellipsoids, backward, errors, poison, random_ellipsoids, upload};
use super::random_scene::{LENSES, random_camera};
use super::reference_backward::{Incoming, touched_by};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// dL/d colours and depths; what pixels carry elsewhere is poison, since nothing may read it.
pub fn random_incoming(rng: &mut StdRng, pixels: usize) -> Incoming {
    let four = |rng: &mut StdRng| [(); 4].map(|()| rng.random_range(-1.0f32..1.0));
    Incoming {
        color: (0..pixels).map(|_| four(rng)).collect(),
        depth_carry: (0..pixels).map(|_| [four(rng)[0], 0.0, 0.0, 0.0]).collect(),
    }
}

impl Incoming {
    /// Zeroes the gradients of pixels where rounding decides.
    pub fn only_clear(&mut self, unclear: &[bool]) {
        for (at, _) in unclear.iter().enumerate().filter(|(_, unclear)| **unclear) {
            self.color[at] = [0.0; 4];
            self.depth_carry[at] = [0.0; 4];
        }
    }
}

/// Forward and backward kernels.
pub struct Kernels<'a> {
    gpu: &'a GpuContext,
    forward: Rasterizer,
    backward: BackwardRasterizer,
}

impl<'a> Kernels<'a> {
    pub fn new(gpu: &'a GpuContext) -> Result<Self> {
        Ok(Self { gpu, forward: Rasterizer::new(gpu, 16)?, backward: BackwardRasterizer::new(gpu)? })
    }

    /// Derivatives with respect to the attributes in their order, over one or more views.
    pub fn run(
        &mut self,
        scene: &Ellipsoids,
        views: &[(&Camera, &Incoming)],
        settings: &RasterSettings,
    ) -> Result<[Vec<[f32; 4]>; 4]> {
        self.add(scene, scene, views, settings)
    }

    /// Runs as above, with `other` drawn in place of the scene.
    pub fn run_other(
        &mut self,
        scene: &Ellipsoids,
        other: &Ellipsoids,
        view: (&Camera, &Incoming),
        settings: &RasterSettings,
    ) -> Result<[Vec<[f32; 4]>; 4]> {
        self.add(scene, other, &[view], settings)
    }

    fn add(
        &mut self,
        scene: &Ellipsoids,
        drawn: &Ellipsoids,
        views: &[(&Camera, &Incoming)],
        settings: &RasterSettings,
    ) -> Result<[Vec<[f32; 4]>; 4]> {
        let gpu = self.gpu;
        let (gaussians, drawn) = (upload(gpu, scene)?, upload(gpu, drawn)?);
        let out = AnisotropicGradients::zeroed(gpu, scene.count(), scene.order)?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        out.clear(&mut encoder);
        for (camera, incoming) in views {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let target = RenderTarget::new(gpu, width, height)?;
            let gradients = ImageGradients::zeroed(gpu, width, height)?;
            gradients.color.write(gpu, &incoming.color);
            let poisoned: Vec<_> =
                incoming.depth_carry.iter().map(|d| [d[0], f32::NAN, f32::INFINITY, f32::NAN]).collect();
            gradients.depth_carry.write(gpu, &poisoned);
            self.forward.encode(gpu, &mut encoder, &drawn, camera, settings, &target)?;
            self.backward.encode_anisotropic(
                gpu,
                &mut encoder,
                &self.forward,
                &gaussians,
                &target,
                &gradients,
                &out,
            )?;
        }
        gpu.queue.submit([encoder.finish()]);
        let [center, scale, rotation, harmonics] = out.attributes().map(|attribute| attribute.read(gpu));
        Ok([center?, scale?, rotation?, harmonics?])
    }
}

/// Errors of one random scene, every seventh of them poisoned.
pub fn random_round(rng: &mut StdRng, kernels: &mut Kernels<'_>, round: usize) -> Result<[f64; 5]> {
    let (width, height) = (rng.random_range(1..33), rng.random_range(1..33));
    let camera = random_camera(rng, LENSES[round % LENSES.len()], width, height);
    let count = rng.random_range(1..80);
    let mut scene = random_ellipsoids(rng, count, flyrig_renderer::HarmonicOrder::ALL[round % 3]);
    if round % 7 == 6 {
        poison(rng, &mut scene);
    }
    scene.clear_of_clamp(&camera);
    let mip = RasterSettings::default();
    let settings = if round % 5 == 4 { mip.with_classic_filter() } else { mip };
    let touched = touched_by(scene.splats(&camera, &settings), (width, height));
    let mut incoming = random_incoming(rng, (width * height) as usize);
    incoming.only_clear(&touched.unclear);
    let expected = backward(&scene, &camera, &settings, width, &touched, &incoming);
    let found = kernels.run(&scene, &[(&camera, &incoming)], &settings)?;
    if !found.iter().flatten().flatten().all(|v| v.is_finite()) {
        return Err(format!("scene {round}: a derivative is not finite").into());
    }
    Ok(errors(&found, &expected))
}

/// Median, 99 % and worst of each error.
pub fn summary(errors: &[[f64; 5]]) -> [[f64; 3]; 5] {
    [0, 1, 2, 3, 4].map(|attribute| {
        let mut list: Vec<f64> = errors.iter().map(|errors| errors[attribute]).collect();
        list.sort_by(f64::total_cmp);
        let at = |share: f64| list[((list.len().max(1) - 1) as f64 * share) as usize];
        [at(0.5), at(0.99), at(1.0)]
    })
}

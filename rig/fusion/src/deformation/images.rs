//! Images of one frame set as the solver's data term.

use std::time::{Duration, Instant};

use flyrig_body::GpuSkinner;
use flyrig_gpu::{GpuContext, StorageBuffer, read_all};
use flyrig_renderer::{
    BackwardRasterizer, Carry, GaussianBuffers, GaussianGradients, ImageGradients, ImageLoss, ImageSums, LossSettings,
    Outputs, RasterSettings, Rasterizer, RenderTarget, WantedImage,
};
use flyrig_tracker::{DataTerm, PointDerivatives};
use flyrig_types::Camera;

use super::{
    area::ViewPlan,
    scene::{TrackedPerson, TrackedView, ViewAgreement},
};
use crate::error::FusionError;

type Result<T, E = FusionError> = std::result::Result<T, E>;

/// λ_mask of Eq. 3, for the sum of squared differences over all pixels.
const MASK_WEIGHT: f32 = 2.0;
/// Agreement of the best view from which others can be distrusted.
const AGREES: f64 = 0.6;
/// Agreement up to which a view is then distrusted.
const DISAGREES: f64 = 0.25;

/// Buffers of one view. Each view has its own rasteriser, since the derivatives walk the tile lists of the rendering again: no view is
/// rendered twice.
#[derive(Debug)]
pub struct ViewBuffers {
    /// Width and height of the image, pixels.
    source: [u32; 2],
    /// Number of halvings.
    level: u32,
    rasterizer: Rasterizer,
    target: RenderTarget,
    wanted: WantedImage,
    incoming: ImageGradients,
}

impl ViewBuffers {
    /// Creates the buffers for images of size `source` that are halved `level` times.
    pub fn new(gpu: &GpuContext, gaussians: usize, source: [u32; 2], level: u32) -> Result<Self> {
        let wanted = WantedImage::zeroed(gpu, source, level)?;
        let [width, height] = wanted.size();
        Ok(Self {
            source,
            level,
            rasterizer: Rasterizer::new(gpu, gaussians)?,
            target: RenderTarget::new(gpu, width, height)?,
            wanted,
            incoming: ImageGradients::zeroed(gpu, width, height)?,
        })
    }

    /// Returns whether the buffers are for images of this size, halved as often.
    pub fn fits(&self, source: [u32; 2], level: u32) -> bool {
        (self.source, self.level) == (source, level)
    }
}

/// Kernels and buffers of the deformation that belong to no single view.
pub struct DeformKernels<'a> {
    pub skinner: &'a GpuSkinner,
    pub posed: &'a [GaussianBuffers],
    pub loss: &'a ImageLoss,
    pub backward: &'a mut BackwardRasterizer,
    pub displacement: &'a StorageBuffer<[f32; 4]>,
    pub gradients: &'a [GaussianGradients],
}

/// Renders the person into all views and compares it with their images.
pub struct Images<'a> {
    person: TrackedPerson<'a>,
    views: &'a [TrackedView<'a>],
    /// Camera of each view at the size that is compared.
    cameras: Vec<Camera>,
    buffers: &'a mut [ViewBuffers],
    settings: Vec<LossSettings>,
    kernels: DeformKernels<'a>,
    /// Whether each view counts.
    trusted: Vec<bool>,
    /// Sums of the current rendering, one element per view.
    sums: Vec<ImageSums>,
    /// Sums of the rendering from which the last derivatives were computed.
    derived_sums: Vec<ImageSums>,
    /// Displacement that is rendered now, and its loss.
    rendered: Option<(Vec<[f32; 4]>, f64)>,
    draw_time: Duration,
    derivatives_time: Duration,
}

impl<'a> Images<'a> {
    /// Prepares the images at the size that is compared. `color_weight` is λ_color of Eq. 3.
    pub fn new(
        person: TrackedPerson<'a>,
        views: &'a [TrackedView<'a>],
        plans: &[ViewPlan],
        buffers: &'a mut [ViewBuffers],
        kernels: DeformKernels<'a>,
        // 0 before there are colours: then only the masks are informative.
        color_weight: f32,
    ) -> Self {
        let settings: Vec<LossSettings> = views
            .iter()
            .zip(plans)
            .map(|(view, plan)| LossSettings {
                color_weight: color_weight * plan.weight as f32,
                mask_weight: MASK_WEIGHT * plan.weight as f32,
                area: plan.area,
                with_unknown: view.with_unknown,
            })
            .collect();
        let mut encoder = person.gpu.device.create_command_encoder(&Default::default());
        for ((view, buffers), settings) in views.iter().zip(&*buffers).zip(&settings) {
            kernels.loss.prepare(person.gpu, &mut encoder, &buffers.wanted, view.words, settings);
        }
        person.gpu.queue.submit([encoder.finish()]);
        let cameras = views.iter().zip(plans).map(|(view, plan)| view.camera.halved(plan.level)).collect();
        let (draw_time, derivatives_time) = Default::default();
        Self {
            person,
            views,
            cameras,
            buffers,
            settings,
            kernels,
            trusted: vec![true; views.len()],
            sums: Vec::new(),
            derived_sums: Vec::new(),
            rendered: None,
            draw_time,
            derivatives_time,
        }
    }

    /// Returns the time spent on rendering and on derivatives.
    pub fn times(&self) -> (Duration, Duration) {
        (self.draw_time, self.derivatives_time)
    }

    /// Leaves out views that disagree with all others: a camera that is covered, or whose mask shows something else.
    pub fn distrust(&mut self, displacement: &[[f32; 4]]) -> Result<()> {
        self.render(displacement)?;
        let best = self.sums.iter().map(agreement).fold(0.0, f64::max);
        if best > AGREES {
            self.trusted = self.sums.iter().map(|sums| agreement(sums) > DISAGREES).collect();
        }
        let loss = self.trusted_loss();
        if let Some((.., rendered_loss)) = &mut self.rendered {
            *rendered_loss = loss;
        }
        Ok(())
    }

    /// Returns the agreement of each view with this displacement, for which loss or derivatives must have been computed last.
    pub fn agreement(&self, displacement: &[[f32; 4]]) -> Vec<ViewAgreement> {
        let is_rendered = self.rendered.as_ref().is_some_and(|(d, _)| d == displacement);
        let sums = if is_rendered || self.derived_sums.is_empty() { &self.sums } else { &self.derived_sums };
        let view = |(sums, &is_trusted)| ViewAgreement { fraction: agreement(sums), is_trusted };
        sums.iter().zip(&self.trusted).map(view).collect()
    }

    /// Sums the loss of the views that count.
    fn trusted_loss(&self) -> f64 {
        self.sums.iter().zip(&self.trusted).filter(|(_, trusted)| **trusted).map(|(sums, _)| sums.loss).sum()
    }

    /// Renders all views, unless this displacement is rendered already, and returns the loss.
    fn render(&mut self, displacement: &[[f32; 4]]) -> Result<f64> {
        if let Some((moved, loss)) = &self.rendered
            && moved == displacement
        {
            return Ok(*loss);
        }
        let start = Instant::now();
        self.rendered = None;
        let TrackedPerson { gpu, skeleton, poses: instants, .. } = &self.person;
        let DeformKernels { skinner, posed, loss, .. } = &self.kernels;
        self.kernels.displacement.write(gpu, displacement);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for (pose, gaussians) in instants.iter().zip(*posed) {
            let (centers, normals) = (&gaussians.center_scale, &gaussians.normal);
            skinner.encode(gpu, &mut encoder, skeleton, pose, Some(self.kernels.displacement), centers, normals)?;
        }
        for (i, (view, settings)) in self.views.iter().zip(&self.settings).enumerate() {
            let Some(gaussians) = posed.get(view.instant) else { continue };
            let plain = RasterSettings::default();
            let raster = RasterSettings {
                outputs: Outputs::COLOR,
                area: Some(settings.area),
                // As wide as in the whole image: a wider filter renders a wider person, and the solver makes it thinner.
                filter_variance_px2: plain.filter_variance_px2 * 0.25f32.powi(self.buffers[i].level as i32),
                ..plain
            };
            let ViewBuffers { rasterizer, target, wanted, incoming, .. } = &mut self.buffers[i];
            rasterizer.encode(gpu, &mut encoder, gaussians, &self.cameras[i], &raster, target)?;
            loss.encode(gpu, &mut encoder, i, target, wanted, settings, incoming);
        }
        gpu.queue.submit([encoder.finish()]);
        self.sums = loss.read(gpu, self.views.len())?;
        let loss = self.trusted_loss();
        self.rendered = Some((displacement.to_vec(), loss));
        self.draw_time += start.elapsed();
        Ok(loss)
    }
}

impl DataTerm for Images<'_> {
    type Error = FusionError;

    fn loss(&mut self, displacement: &[[f32; 4]]) -> Result<f64> {
        self.render(displacement)
    }

    fn derivatives(&mut self, displacement: &[[f32; 4]], out: &mut Vec<PointDerivatives>) -> Result<f64> {
        let loss = self.render(displacement)?;
        self.derived_sums.clone_from(&self.sums);
        let start = Instant::now();
        let TrackedPerson { gpu, skeleton, poses: instants, .. } = &self.person;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for gradients in self.kernels.gradients.iter().take(instants.len()) {
            gradients.clear(&mut encoder);
        }
        let trusted = self.views.iter().zip(&*self.buffers).zip(&self.trusted).filter(|(_, trusted)| **trusted);
        for ((view, buffers), _) in trusted {
            let DeformKernels { posed, gradients, .. } = self.kernels;
            let Some((gaussians, sums)) = posed.get(view.instant).zip(gradients.get(view.instant)) else { continue };
            let ViewBuffers { rasterizer, target, incoming, .. } = buffers;
            let what = (incoming, Carry::Lift);
            self.kernels.backward.encode(gpu, &mut encoder, rasterizer, gaussians, target, what, sums)?;
        }
        gpu.queue.submit([encoder.finish()]);
        let sums = self.kernels.gradients.iter().take(instants.len()).flat_map(|sums| [&sums.center, &sums.carried]);
        let mut read = read_all(gpu, &sums.collect::<Vec<_>>())?.into_iter();
        out.clear();
        for pose in *instants {
            let (Some(gradient), Some(curvature)) = (read.next(), read.next()) else { break };
            let world_from_canonical = skeleton.world_from_canonical(pose);
            out.push(PointDerivatives { world_from_canonical, gradient, curvature });
        }
        self.derivatives_time += start.elapsed();
        Ok(loss)
    }
}

/// Returns the fraction of the person that is where the image shows it, less what is rendered elsewhere, 0..=1.
fn agreement(sums: &ImageSums) -> f64 {
    if sums.wanted > 0.0 && sums.mask.is_finite() { (1.0 - sums.mask / sums.wanted).max(0.0) } else { 0.0 }
}

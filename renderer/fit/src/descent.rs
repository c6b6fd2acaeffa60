//! Gradient descent of a model on the images of a take.

use std::collections::{BTreeMap, btree_map::Entry};

use flyrig_gpu::{GpuContext, read_all};
use flyrig_renderer::{
    AnisotropicBuffers, AnisotropicGradients, BackwardRasterizer, ImageGradients, Outputs, RasterSettings, Rasterizer,
    RenderTarget,
};
use rand::{SeedableRng as _, rngs::StdRng, seq::SliceRandom as _};

use crate::error::FitError;
use crate::image_error::{ErrorWeights, ImageDifference};
use crate::model::{Model, Step};
use crate::surface_error::{SurfaceDifference, SurfaceWeights};
use crate::training_view::TrainingView;

/// Multiplier of the round in the seed of its order, which separates the rounds of consecutive seeds.
const ROUND_SEED: u64 = 0x9e37_79b9_7f4a_7c15;

/// Settings of a fit that do not depend on the model.
#[derive(Debug, Clone, PartialEq)]
pub struct FitSettings {
    /// Seed of the order of images.
    pub seed: u64,
    /// Weights of the error's terms.
    pub weights: ErrorWeights,
    /// Weights of the error against known surfaces, of views that have one.
    pub surface: SurfaceWeights,
}

impl Default for FitSettings {
    fn default() -> Self {
        Self { seed: 1, weights: ErrorWeights::default(), surface: SurfaceWeights::default() }
    }
}

/// Result of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Weighted error of the step's image.
    pub loss: f64,
    /// PSNR of the step's image, decibels.
    pub decibels: f64,
    /// Mean distance of the drawn planes from the known surface along the optical axis, metres; `None` for an image without one.
    pub depth_m: Option<f64>,
}

/// Rendered image and its derivatives, of one size, on the adapter.
#[derive(Debug)]
struct Targets {
    rendered: RenderTarget,
    slopes: ImageGradients,
}

impl Targets {
    fn new(gpu: &GpuContext, [width, height]: [u32; 2], planes: bool) -> Result<Self, FitError> {
        let rendered = RenderTarget::new(gpu, width, height)?;
        let slopes = ImageGradients::zeroed(gpu, width, height)?;
        if !planes {
            return Ok(Self { rendered, slopes });
        }
        Ok(Self { rendered: rendered.with_planes(gpu)?, slopes: slopes.with_planes(gpu)? })
    }
}

/// Difference of a drawn view from its photograph, and from its known surface.
struct Difference {
    image: ImageDifference,
    surface: Option<SurfaceDifference>,
}

/// Fit of a model to images.
#[derive(Debug)]
pub struct Fit<M> {
    gpu: GpuContext,
    settings: FitSettings,
    pub(crate) model: M,
    views: Vec<TrainingView>,
    rasterizer: Rasterizer,
    backward: BackwardRasterizer,
    gaussians: AnisotropicBuffers,
    gradients: AnisotropicGradients,
    targets: BTreeMap<[u32; 2], Targets>,
    pub(crate) step: u64,
    /// Views in the order of a round, and the round's number.
    round: (Vec<usize>, u64),
}

impl<M: Model> Fit<M> {
    /// Prepares the fit of a model to images of its frames.
    ///
    /// # Errors
    /// [`FitError::Images`] without an image, or for an image of a missing frame; [`FitError::Gpu`].
    pub fn new(gpu: &GpuContext, model: M, views: Vec<TrainingView>, settings: FitSettings) -> Result<Self, FitError> {
        if views.is_empty() {
            return Err(FitError::Images("no person is in any image; check masks, cameras and frames".to_owned()));
        }
        if views.iter().any(|view| view.frame >= model.frames()) {
            return Err(FitError::Images("an image is of a frame without a pose".to_owned()));
        }
        let (count, order) = (model.gaussians(), model.order());
        let planes = views.iter().any(TrainingView::has_surface);
        let mut targets = BTreeMap::new();
        for view in &views {
            if let Entry::Vacant(entry) = targets.entry(view.size()) {
                entry.insert(Targets::new(gpu, view.size(), planes)?);
            }
        }
        Ok(Self {
            gpu: gpu.clone(),
            rasterizer: Rasterizer::new(gpu, count)?,
            backward: BackwardRasterizer::new(gpu)?,
            gaussians: AnisotropicBuffers::zeroed(gpu, count, order)?,
            gradients: AnisotropicGradients::zeroed(gpu, count, order)?,
            targets,
            step: 0,
            round: (Vec::new(), 0),
            settings,
            model,
            views,
        })
    }

    /// Returns the model.
    #[must_use]
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Returns the model as it is after the last step.
    #[must_use]
    pub fn into_model(self) -> M {
        self.model
    }

    /// Returns the number of images.
    #[must_use]
    pub fn images(&self) -> usize {
        self.views.len()
    }

    /// Returns the number of steps so far.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Descends by one step on the next image; `progress` in 0..=1 is the completed share of all steps.
    ///
    /// # Errors
    /// [`FitError::Gpu`], [`FitError::Backward`].
    pub fn step(&mut self, progress: f32) -> Result<StepReport, FitError> {
        let index = self.next_view();
        let Difference { image: mut error, surface } = self.draw(index)?;
        let view = &self.views[index];
        let Some(Targets { rendered, slopes }) = self.targets.get(&view.size()) else {
            return Err(FitError::Images("an image has no target".to_owned()));
        };
        if let (Some(surface), Some(planes)) = (&surface, &slopes.planes) {
            error.slope.iter_mut().zip(&surface.coverage).for_each(|(slope, coverage)| slope[3] += coverage);
            planes.write(&self.gpu, &surface.planes);
        }
        slopes.color.write(&self.gpu, &error.slope);
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.gradients.clear(&mut encoder);
        self.backward.encode_anisotropic(
            &self.gpu,
            &mut encoder,
            &self.rasterizer,
            &self.gaussians,
            rendered,
            slopes,
            &self.gradients,
        )?;
        self.gpu.queue.submit([encoder.finish()]);
        let mut found = read_all(&self.gpu, &self.gradients.attributes())?;
        self.step += 1;
        self.model.descend(view.frame, &mut found, Step { count: self.step, progress });
        Ok(StepReport {
            loss: error.loss + surface.as_ref().map_or(0.0, |surface| surface.loss),
            decibels: -10.0 * error.squared.max(1e-10).log10(),
            depth_m: surface.map(|surface| surface.depth_m),
        })
    }

    /// Returns the view of the next step. Rounds are shuffled by their number, so that a fit that resumes from a checkpoint sees the same
    /// views.
    fn next_view(&mut self) -> usize {
        let count = self.views.len().max(1) as u64;
        let (number, at) = (self.step / count, (self.step % count) as usize);
        if self.round.0.is_empty() || self.round.1 != number {
            let mut order: Vec<usize> = (0..self.views.len()).collect();
            let seed = self.settings.seed.wrapping_add(number.wrapping_mul(ROUND_SEED));
            order.shuffle(&mut StdRng::seed_from_u64(seed));
            self.round = (order, number);
        }
        self.round.0[at]
    }

    /// Computes the mean PSNR of the model over all images, decibels of the mean squared error.
    ///
    /// # Errors
    /// [`FitError::Gpu`].
    pub fn decibels(&mut self) -> Result<f64, FitError> {
        let mut sum = 0.0;
        for view in 0..self.views.len() {
            sum += self.draw(view)?.image.squared;
        }
        Ok(-10.0 * (sum / self.views.len().max(1) as f64).max(1e-10).log10())
    }

    /// Renders a view and compares it with its photograph, and with its surface where one is known.
    fn draw(&mut self, view: usize) -> Result<Difference, FitError> {
        let view = &self.views[view];
        let [center, scale_opacity, rotation, harmonics] =
            self.model.place(view.frame, view.camera.position().as_vec3());
        self.gaussians.center.write(&self.gpu, center);
        self.gaussians.scale_opacity.write(&self.gpu, scale_opacity);
        self.gaussians.rotation.write(&self.gpu, rotation);
        self.gaussians.harmonics.write(&self.gpu, harmonics);
        let size = view.size();
        let Targets { rendered, .. } = match self.targets.entry(size) {
            Entry::Occupied(entry) => entry.into_mut(),
            Entry::Vacant(entry) => entry.insert(Targets::new(&self.gpu, size, view.has_surface())?),
        };
        let outputs = if view.has_surface() { Outputs::PLANES } else { Outputs::COLOR };
        let settings = RasterSettings { outputs, ..RasterSettings::default() };
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.rasterizer.encode(&self.gpu, &mut encoder, &self.gaussians, &view.camera, &settings, rendered)?;
        self.gpu.queue.submit([encoder.finish()]);
        let pixels = rendered.color.read(&self.gpu)?;
        let image = ImageDifference::of(&pixels, view.photograph(), size[0] as usize, &self.settings.weights);
        let surface = match (&view.surface, &rendered.planes) {
            (Some(known), Some(planes)) => {
                let planes = planes.read(&self.gpu)?;
                let below_m = self.model.below_surface_m();
                Some(SurfaceDifference::of([&pixels, &planes], known, below_m, view.person(), &self.settings.surface))
            }
            _ => None,
        };
        Ok(Difference { image, surface })
    }
}

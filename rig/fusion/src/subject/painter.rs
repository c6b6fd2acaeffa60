//! Colours of one person's Gaussians: direct appearance, and networks that correct it in the learned modes.
//!
//! Direct appearance is FlyHuman, Eq. 5-12, with linear RGB as the feature: pixel colours at the rendered surface, weighted by angle and
//! canonical distance, sharpened by the residual of the rendered input views, diffused over the deformation graph for unseen parts, and
//! remembered over time. Networks run on the processor, from observations read back from the GPU. Direct appearance continues from its own
//! colours, never from those of the networks.

use std::time::Instant;

use flyrig_body::{DeformationGraph, SurfaceGaussians};
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::{
    AppearanceSettings, DirectAppearance, GaussianBuffers, Observations, Outputs, RasterSettings, Rasterizer,
    RenderTarget, ViewInput,
};
use flyrig_stfa::{BodyGraph, LearnedAppearance, ViewImage};

use super::{
    geometry::{Geometry, UNPAINTED},
    inputs::{InputImage, InputView, Inputs},
    instants::Instants,
    memory::{NetworkMemory, PersonMemory},
    stage_clock::{StageClock, TimedStage},
};
use crate::{error::FusionError, health::stage_times::StageTimes, settings::session::SessionSettings};

/// Inputs of one painting: the skinned Gaussians and the images of a frame set.
#[derive(Clone, Copy)]
pub(super) struct PaintInputs<'a> {
    pub gpu: &'a GpuContext,
    pub geometry: &'a Geometry,
    pub instants: &'a Instants<'a>,
    pub views: &'a [InputView<'a>],
    pub images: &'a Inputs,
}

/// Rasteriser and clocks of a painting.
pub(super) struct PaintTools<'a> {
    pub rasterizer: &'a mut Rasterizer,
    pub clock: &'a mut StageClock,
    pub stages: &'a mut StageTimes,
}

/// Painter of a person's Gaussians.
#[derive(Debug)]
pub(super) enum GaussianPainter {
    /// Colours projected from the images, diffused and remembered.
    Direct(Box<DirectPainter>),
    /// Direct colours corrected by networks.
    Learned(Box<LearnedPainter>),
}

impl GaussianPainter {
    /// Creates the painter of the settings' mode for as many views as there are `cameras`.
    pub fn new(
        gpu: &GpuContext,
        surface: &SurfaceGaussians,
        graph: &DeformationGraph,
        body: &BodyGraph,
        (cameras, is_avatar): (usize, bool),
        settings: &SessionSettings,
    ) -> Result<Self, FusionError> {
        let mut direct = DirectPainter {
            appearance: DirectAppearance::new(gpu, surface, graph, cameras)?,
            settings: settings.appearance.mode.settings(),
            visibility: Vec::new(),
            painted: Vec::new(),
        };
        if is_avatar {
            direct.settings.corrects = true;
            return Ok(Self::Direct(Box::new(direct)));
        }
        let Some(parameters) = settings.appearance.load_networks()? else { return Ok(Self::Direct(Box::new(direct))) };
        direct.appearance.keep_observations(gpu)?;
        let networks = LearnedAppearance::new(&parameters, body.clone());
        let colors = StorageBuffer::zeroed(gpu, "direct colours", surface.len())?;
        colors.write(gpu, &vec![UNPAINTED; surface.len()]);
        Ok(Self::Learned(Box::new(LearnedPainter { direct, networks, colors })))
    }

    /// Paints the Gaussians from the images of one frame set. Views that are not trusted paint nothing.
    pub fn paint(&mut self, inputs: PaintInputs<'_>, tools: &mut PaintTools<'_>) -> Result<(), FusionError> {
        match self {
            Self::Direct(direct) => direct.paint(inputs, tools),
            Self::Learned(learned) => learned.paint(inputs, tools),
        }
    }

    /// Leaves a frame set out: no view has painted in it.
    pub fn skip(&mut self) {
        self.direct_mut().painted.clear();
    }

    /// Returns the views that painted in the last update, as indices.
    pub fn painted(&self) -> &[usize] {
        &self.direct().painted
    }

    /// Keeps what each view observed from the next update on, for [`Self::observations`].
    pub fn keep_observations(&mut self, gpu: &GpuContext) -> Result<(), FusionError> {
        Ok(self.direct_mut().appearance.keep_observations(gpu)?)
    }

    /// Reads back what the views of [`Self::painted`] observed.
    pub fn observations(&self, gpu: &GpuContext) -> Result<Observations, FusionError> {
        self.direct().observations(gpu)
    }

    /// Reads back the accumulated linear RGB of each Gaussian with its weight.
    pub fn memory(&self, gpu: &GpuContext) -> Result<Vec<[f32; 4]>, FusionError> {
        Ok(self.direct().appearance.memory(gpu)?)
    }

    /// Reads back the direct colours of the Gaussians: linear RGB and opacity. `shown` are the Gaussians as they are drawn.
    pub fn direct_colors(&self, gpu: &GpuContext, shown: &GaussianBuffers) -> Result<Vec<[f32; 4]>, FusionError> {
        let colors = match self {
            Self::Direct(_) => &shown.color,
            Self::Learned(learned) => &learned.colors,
        };
        Ok(colors.read(gpu)?)
    }

    /// Returns a copy of what networks have accumulated; `None` without any.
    pub fn network_memory(&self) -> Option<NetworkMemory> {
        let Self::Learned(learned) = self else { return None };
        let LearnedPainter { networks, .. } = &**learned;
        (!networks.memory().weights().is_empty())
            .then(|| NetworkMemory { digest: networks.digest(), memory: networks.memory().clone() })
    }

    /// Resumes from the colours of `memory`, and shows them.
    pub fn resume(
        &mut self,
        gpu: &GpuContext,
        shown: &GaussianBuffers,
        memory: &PersonMemory,
    ) -> Result<(), FusionError> {
        self.direct_mut().appearance.resume(gpu, &memory.memory)?;
        shown.color.write(gpu, &memory.colors);
        if let Self::Learned(learned) = self {
            learned.colors.write(gpu, &memory.colors);
        }
        Ok(())
    }

    /// Resumes the networks, if they are those that accumulated `memory`.
    pub fn resume_networks(&mut self, memory: &NetworkMemory) {
        if let Self::Learned(learned) = self
            && learned.networks.digest() == memory.digest
        {
            learned.networks.restore(memory.memory.clone());
        }
    }

    /// Takes over the networks' memory from the painter of the same person on another device.
    pub fn take_over(&mut self, old: &Self) {
        if let (Self::Learned(learned), Self::Learned(old)) = (self, old) {
            learned.networks.restore(old.networks.memory().clone());
        }
    }

    /// Paints corrections of an avatar's colours from now on, or the colours of the surface.
    pub fn correct(&mut self, corrects: bool) {
        self.direct_mut().settings.corrects = corrects;
        self.reset();
    }

    /// Forgets all colours that were seen.
    pub fn reset(&mut self) {
        self.direct_mut().appearance.reset();
        if let Self::Learned(learned) = self {
            learned.networks.reset();
        }
    }

    fn direct(&self) -> &DirectPainter {
        match self {
            Self::Direct(direct) => direct,
            Self::Learned(learned) => &learned.direct,
        }
    }

    fn direct_mut(&mut self) -> &mut DirectPainter {
        match self {
            Self::Direct(direct) => direct,
            Self::Learned(learned) => &mut learned.direct,
        }
    }
}

/// Direct appearance with the renderings that it needs.
#[derive(Debug)]
pub(super) struct DirectPainter {
    appearance: DirectAppearance,
    settings: AppearanceSettings,
    /// One target per input view; grows with the rig, and is remade when an image's size changes.
    visibility: Vec<RenderTarget>,
    /// Views that painted in the last update.
    painted: Vec<usize>,
}

impl DirectPainter {
    fn paint(&mut self, inputs: PaintInputs<'_>, tools: &mut PaintTools<'_>) -> Result<(), FusionError> {
        self.painted.clear();
        self.render_views(inputs, tools)?;
        self.update(inputs, tools)
    }

    /// Renders canonical positions and the last colours into every view.
    fn render_views(&mut self, inputs: PaintInputs<'_>, tools: &mut PaintTools<'_>) -> Result<(), FusionError> {
        let PaintInputs { gpu, geometry, instants, views, .. } = inputs;
        let start = Instant::now();
        let settings = RasterSettings { outputs: Outputs::SURFACE, ..RasterSettings::default() };
        for (i, view) in views.iter().enumerate() {
            self.fit_target(gpu, i, (view.image.width(), view.image.height()))?;
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let gaussians = geometry.drawn(instants.of_view(i));
            tools.rasterizer.encode(gpu, &mut encoder, gaussians, view.camera, &settings, &self.visibility[i])?;
            if i + 1 == views.len() {
                tools.clock.mark(&mut encoder, TimedStage::Visibility);
            }
            gpu.queue.submit([encoder.finish()]);
        }
        tools.clock.wait(gpu, TimedStage::Visibility, start, tools.stages)
    }

    /// Gives a view a target of its image's size.
    fn fit_target(&mut self, gpu: &GpuContext, view: usize, (width, height): (u32, u32)) -> Result<(), FusionError> {
        if self.visibility.get(view).is_some_and(|target| (target.width, target.height) == (width, height)) {
            return Ok(());
        }
        let target = RenderTarget::new(gpu, width, height)?;
        if view < self.visibility.len() {
            self.visibility[view] = target;
        } else {
            self.visibility.push(target);
        }
        Ok(())
    }

    /// Updates direct appearance from the trusted views.
    fn update(&mut self, inputs: PaintInputs<'_>, tools: &mut PaintTools<'_>) -> Result<(), FusionError> {
        let PaintInputs { gpu, geometry, instants, views, images } = inputs;
        let start = Instant::now();
        self.painted.extend((0..views.len()).filter(|&i| geometry.is_trusted(i)));
        let observing: Vec<ViewInput<'_>> = (self.painted.iter())
            .map(|&i| ViewInput {
                camera: views[i].camera,
                picture: &images.images()[i].words,
                canonical: &self.visibility[i].canonical,
                rendered: &self.visibility[i].color,
                gaussians: (instants.of_view(i) > 0).then(|| geometry.at(instants.of_view(i))),
            })
            .collect();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        if views.is_empty() {
            tools.clock.mark(&mut encoder, TimedStage::Visibility);
        }
        self.appearance.update(gpu, &mut encoder, geometry.painted(), &observing, &self.settings)?;
        geometry.encode_colors(gpu, &mut encoder);
        tools.clock.mark(&mut encoder, TimedStage::Appearance);
        tools.clock.finish(&mut encoder);
        gpu.queue.submit([encoder.finish()]);
        tools.clock.wait(gpu, TimedStage::Appearance, start, tools.stages)
    }

    fn observations(&self, gpu: &GpuContext) -> Result<Observations, FusionError> {
        Ok(self.appearance.observations(gpu, self.painted.len())?)
    }
}

/// Direct appearance with networks on the processor that correct it. The Gaussians show the corrected colours.
#[derive(Debug)]
pub(super) struct LearnedPainter {
    direct: DirectPainter,
    networks: LearnedAppearance,
    /// Colours of direct appearance, which continues from them and never from those of the networks.
    colors: StorageBuffer<[f32; 4]>,
}

impl LearnedPainter {
    fn paint(&mut self, inputs: PaintInputs<'_>, tools: &mut PaintTools<'_>) -> Result<(), FusionError> {
        let shown = &inputs.geometry.gaussians().color;
        self.colors.copy_to(inputs.gpu, shown);
        self.direct.paint(inputs, tools)?;
        if tools.clock.is_supported() {
            inputs.gpu.wait()?;
        }
        let start = Instant::now();
        shown.copy_to(inputs.gpu, &self.colors);
        self.correct(inputs, start, tools.stages)
    }

    /// Replaces the colours that are shown by those of the networks.
    fn correct(
        &mut self,
        PaintInputs { gpu, geometry, images, .. }: PaintInputs<'_>,
        start: Instant,
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        let picture = |&i: &usize| {
            let InputImage { size: [width, height], rgba, .. } = &images.images()[i];
            ViewImage { width: *width, height: *height, rgba }
        };
        let pictures: Vec<_> = self.direct.painted.iter().map(picture).collect();
        let observed = self.direct.observations(gpu)?;
        let before = self.networks.counts;
        let colors = self.networks.paint(&observed, &pictures, &self.direct.settings)?;
        geometry.gaussians().color.write(gpu, &colors);
        stages.add("networks", start.elapsed());
        let counts = self.networks.counts;
        stages.count("corrections that were no numbers", counts.poisoned - before.poisoned);
        Ok(())
    }
}

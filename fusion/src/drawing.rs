//! Draws all people of a session into one view.

use flyrig_gpu::GpuContext;
use flyrig_renderer::{GaussianBuffers, Outputs, RasterSettings, Rasterizer, RenderTarget, rgba8_from_target};
use flyrig_types::{Camera, RenderedView};

use crate::{FusionError, StageTimes};

/// Targets kept for views of different sizes.
const TARGETS: usize = 4;

/// The rasteriser and its targets, shared by all people and views.
#[derive(Debug)]
pub(crate) struct Drawing {
    pub rasterizer: Rasterizer,
    /// Most recently used last.
    targets: Vec<RenderTarget>,
    /// Gaussians of several people, one after the other.
    joined: Option<GaussianBuffers>,
    /// Whether `joined` holds the people as they are now.
    is_current: bool,
}

impl Drawing {
    pub fn new(gpu: &GpuContext, max_gaussians: usize) -> Result<Self, FusionError> {
        let rasterizer = Rasterizer::new(gpu, max_gaussians)?;
        Ok(Self { rasterizer, targets: Vec::new(), joined: None, is_current: false })
    }

    /// Somebody has moved or changed colour.
    pub fn people_changed(&mut self) {
        self.is_current = false;
    }

    /// Draws these people as `camera` sees them. People hide each other.
    pub fn render(
        &mut self,
        gpu: &GpuContext,
        people: &[&GaussianBuffers],
        camera: &Camera,
        stages: &mut StageTimes,
    ) -> Result<RenderedView, FusionError> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let start = std::time::Instant::now();
        let target = match self.targets.iter().position(|target| (target.width, target.height) == (width, height)) {
            Some(known) => self.targets.remove(known),
            None => {
                if self.targets.len() >= TARGETS {
                    self.targets.remove(0);
                }
                RenderTarget::of_color(gpu, width, height)?
            }
        };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let gaussians = match people {
            [one] => one,
            people => {
                self.join(gpu, &mut encoder, people)?;
                match &self.joined {
                    Some(joined) => joined,
                    // Not reached: joining makes it.
                    None => return Ok(RenderedView { width, height, rgba: Vec::new() }),
                }
            }
        };
        let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
        self.rasterizer.encode(gpu, &mut encoder, gaussians, camera, &settings, &target)?;
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()?;
        stages.add("render a view", start.elapsed());
        let rgba = stages.time("read a view back", || -> Result<_, FusionError> {
            Ok(rgba8_from_target(&target.color.read(gpu)?))
        })?;
        self.targets.push(target);
        Ok(RenderedView { width, height, rgba })
    }

    /// Copies the people's Gaussians into one set of buffers, unless they are there already.
    fn join(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut wgpu::CommandEncoder,
        people: &[&GaussianBuffers],
    ) -> Result<(), FusionError> {
        let count = people.iter().map(|gaussians| gaussians.count()).sum();
        let joined = match self.joined.take().filter(|joined| joined.count() == count) {
            Some(joined) => joined,
            None => {
                self.is_current = false;
                GaussianBuffers::zeroed(gpu, count)?
            }
        };
        if !self.is_current {
            let mut first = 0;
            for gaussians in people {
                gaussians.encode_copy(encoder, &joined, first);
                first += gaussians.count();
            }
            self.is_current = true;
        }
        self.joined = Some(joined);
        Ok(())
    }
}

//! Draws all people of a session into one view.

use flyrig_gpu::{GpuContext, StageTimer};
use flyrig_renderer::{GaussianBuffers, Outputs, RasterSettings, Rasterizer, RenderTarget, ViewBytes};
use flyrig_types::{Camera, RenderedView};

use crate::{FusionError, StageTimes};

/// Name of the stage.
const STAGE: &str = "render a view";
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
    /// Of [`STAGE`].
    timer: StageTimer,
    bytes: ViewBytes,
}

impl Drawing {
    pub fn new(gpu: &GpuContext, max_gaussians: usize) -> Result<Self, FusionError> {
        let rasterizer = Rasterizer::new(gpu, max_gaussians)?;
        let (timer, bytes) = (StageTimer::new(gpu, 1), ViewBytes::new(gpu)?);
        Ok(Self { rasterizer, targets: Vec::new(), joined: None, is_current: false, timer, bytes })
    }

    /// Somebody has moved or changed colour.
    pub fn people_changed(&mut self) {
        self.is_current = false;
    }

    /// Whether views are timed without waiting for what was submitted before.
    pub fn is_timed_by_adapter(&self) -> bool {
        self.timer.is_supported()
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
        self.timer.begin(&mut encoder);
        let gaussians = match people {
            [one] => one,
            people => {
                let is_current = std::mem::replace(&mut self.is_current, true);
                join(gpu, &mut encoder, people, &mut self.joined, is_current)?
            }
        };
        let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
        self.rasterizer.encode(gpu, &mut encoder, gaussians, camera, &settings, &target)?;
        self.bytes.encode(gpu, &mut encoder, &target)?;
        self.timer.mark(&mut encoder, STAGE);
        self.timer.finish(&mut encoder);
        gpu.queue.submit([encoder.finish()]);
        if !self.timer.is_supported() {
            gpu.wait()?;
            stages.add(STAGE, start.elapsed());
        }
        // Where the adapter measures its own time, reading back is also what waits for it.
        let rgba = stages.time("read a view back", || self.bytes.read(gpu, &target))?;
        for stage in self.timer.collect() {
            stages.add_of_adapter(stage.name, stage.time);
        }
        self.targets.push(target);
        Ok(RenderedView { width, height, rgba })
    }
}

/// Returns the people's Gaussians in one set of buffers; those of `joined` are kept if they are current.
fn join<'a>(
    gpu: &GpuContext,
    encoder: &mut wgpu::CommandEncoder,
    people: &[&GaussianBuffers],
    joined: &'a mut Option<GaussianBuffers>,
    is_current: bool,
) -> Result<&'a GaussianBuffers, FusionError> {
    let count = people.iter().map(|gaussians| gaussians.count()).sum();
    let known = joined.take().filter(|known| known.count() == count);
    let is_current = is_current && known.is_some();
    let buffers = match known {
        Some(known) => known,
        None => GaussianBuffers::zeroed(gpu, count)?,
    };
    if !is_current {
        let mut first = 0;
        for gaussians in people {
            gaussians.encode_copy(encoder, &buffers, first);
            first += gaussians.count();
        }
    }
    Ok(joined.insert(buffers))
}

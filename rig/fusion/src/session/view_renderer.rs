//! Rendering of all people of a session into one view.

use flyrig_gpu::{GpuContext, StageTimer};
use flyrig_renderer::{
    GaussianBuffers, GaussianJoin, Gaussians, Outputs, RasterSettings, Rasterizer, RenderTarget, ViewBytes,
};
use flyrig_types::{Camera, RenderedView};

use crate::{error::FusionError, health::stage_times::StageTimes};

/// Name of the stage.
const STAGE: &str = "render a view";
/// Largest number of targets that are kept for views of different sizes.
const TARGETS: usize = 4;

/// Rasteriser and its targets, shared by all people and views.
#[derive(Debug)]
pub(crate) struct ViewRenderer {
    pub rasterizer: Rasterizer,
    /// Targets, the most recently used last.
    targets: Vec<RenderTarget>,
    /// Gaussians of several people without avatars, one after the other.
    joined: Option<GaussianBuffers>,
    /// Gaussians of several people, avatars among them.
    join: GaussianJoin,
    /// Whether the joined Gaussians are the people as they are now.
    is_current: bool,
    /// Timer of [`STAGE`].
    timer: StageTimer,
    bytes: ViewBytes,
}

impl ViewRenderer {
    pub fn new(gpu: &GpuContext, max_gaussians: usize) -> Result<Self, FusionError> {
        let rasterizer = Rasterizer::new(gpu, max_gaussians)?;
        let (timer, bytes) = (StageTimer::new(gpu, 1), ViewBytes::new(gpu)?);
        Ok(Self {
            rasterizer,
            targets: Vec::new(),
            joined: None,
            join: GaussianJoin::new(gpu)?,
            is_current: false,
            timer,
            bytes,
        })
    }

    /// Notes that a person has moved or changed colour.
    pub fn people_changed(&mut self) {
        self.is_current = false;
    }

    /// Returns whether views are timed without waiting for earlier submissions.
    pub fn is_timed_by_adapter(&self) -> bool {
        self.timer.is_supported()
    }

    /// Renders these people as `camera` sees them. People hide each other.
    pub fn render(
        &mut self,
        gpu: &GpuContext,
        people: &[Gaussians<'_>],
        camera: &Camera,
        stages: &mut StageTimes,
    ) -> Result<RenderedView, FusionError> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let start = std::time::Instant::now();
        let target = self.target(gpu, (width, height))?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        self.timer.begin(&mut encoder);
        let gaussians = match people {
            [one] => *one,
            people => {
                let is_current = std::mem::replace(&mut self.is_current, true);
                let surfaces: Vec<&GaussianBuffers> = people.iter().filter_map(isotropic).collect();
                if surfaces.len() == people.len() {
                    join(gpu, &mut encoder, &surfaces, &mut self.joined, is_current)?.into()
                } else if let (true, Some(joined)) = (is_current, self.join.joined()) {
                    joined.into()
                } else {
                    self.join.encode(gpu, &mut encoder, people)?.into()
                }
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
        // Where the adapter measures its own time, only reading back waits for it.
        let rgba = stages.time("read a view back", || self.bytes.read(gpu, &target))?;
        for stage in self.timer.collect() {
            stages.add_of_adapter(stage.name, stage.time);
        }
        self.targets.push(target);
        Ok(RenderedView { width, height, rgba })
    }

    /// Takes the target of this size out of those that are kept, or creates one.
    fn target(&mut self, gpu: &GpuContext, size: (u32, u32)) -> Result<RenderTarget, FusionError> {
        if let Some(known) = self.targets.iter().position(|target| (target.width, target.height) == size) {
            return Ok(self.targets.remove(known));
        }
        if self.targets.len() >= TARGETS {
            self.targets.remove(0);
        }
        Ok(RenderTarget::of_color(gpu, size.0, size.1)?)
    }
}

/// Returns the Gaussians of a person without an avatar.
fn isotropic<'a>(person: &Gaussians<'a>) -> Option<&'a GaussianBuffers> {
    match person {
        Gaussians::Isotropic(gaussians) => Some(gaussians),
        Gaussians::Anisotropic(_) => None,
    }
}

/// Copies the people's Gaussians into one set of buffers, unless `joined` holds them already.
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

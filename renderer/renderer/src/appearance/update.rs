//! Buffers of direct appearance and the recording of an update.

use flyrig_body::{DeformationGraph, SurfaceGaussians};
use flyrig_gpu::{CameraConstants, GpuContext, GpuError, GpuTimer, StorageBuffer, dispatch_1d};
use flyrig_types::MAX_IMAGE_SIDE;
use wgpu::{Buffer, BufferUsages, CommandEncoder, ComputePassDescriptor};

use crate::appearance::graph_buffers::GraphBuffers;
use crate::appearance::kernels::{AppearanceKernels, SettingsConstants, WORKGROUP};
use crate::appearance::processor::{self, ObservationSums};
use crate::appearance::settings::{AppearanceError, AppearanceSettings, Observations, ViewInput};
use crate::buffers::GaussianBuffers;
use crate::color::linear_from_srgb;

const KEPT: &str = "observations of a view";

/// Painter of every Gaussian from the images of one instant and a memory of earlier ones.
///
/// Buffers and pipelines are created once.
#[derive(Debug)]
pub struct DirectAppearance {
    /// `None` on the processor.
    device: Option<DeviceKernels>,
    graph: GraphBuffers,
    linear_from_srgb: StorageBuffer<f32>,
    /// Observations of each view alone; empty unless observations are kept.
    kept: Vec<StorageBuffer<[f32; 4]>>,
    /// Sum of weight times linear RGB, sum of weights.
    seen: StorageBuffer<[f32; 4]>,
    /// Sum of Eq. 6 weights; exp(-k d) of the best view.
    quality: StorageBuffer<[f32; 2]>,
    /// Accumulated linear RGB and its weight.
    memory: StorageBuffer<[f32; 4]>,
    forget: bool,
}

/// Kernels on the device and the buffers of their constants.
#[derive(Debug)]
struct DeviceKernels {
    kernels: AppearanceKernels,
    settings: Buffer,
    /// One per view.
    cameras: Vec<Buffer>,
}

impl DirectAppearance {
    /// Creates the buffers for the Gaussians and graph of one body and at most `max_views` images per frame.
    ///
    /// # Errors
    /// [`AppearanceError::Graph`] where the two do not fit, [`AppearanceError::Gpu`].
    pub fn new(
        gpu: &GpuContext,
        gaussians: &SurfaceGaussians,
        graph: &DeformationGraph,
        max_views: usize,
    ) -> Result<Self, AppearanceError> {
        let count = gaussians.positions.len();
        let graph = GraphBuffers::new(gpu, count, graph)?;
        let constants = |label, size: usize| {
            gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: size as u64,
                usage: BufferUsages::STORAGE | BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        };
        let device = (!gpu.is_on_processor()).then(|| DeviceKernels {
            kernels: AppearanceKernels::new(gpu),
            settings: constants("appearance settings", size_of::<SettingsConstants>()),
            cameras: (0..max_views).map(|_| constants("view camera", size_of::<CameraConstants>())).collect(),
        });
        let decoded: Vec<f32> = (0..=255u8).map(|byte| linear_from_srgb(f32::from(byte) / 255.0)).collect();
        Ok(Self {
            device,
            graph,
            linear_from_srgb: StorageBuffer::from_slice(gpu, "linear values of sRGB bytes", &decoded)?,
            kept: (0..max_views).map(|_| StorageBuffer::zeroed(gpu, KEPT, 0)).collect::<Result<_, GpuError>>()?,
            seen: StorageBuffer::zeroed(gpu, "observed colours", count)?,
            quality: StorageBuffer::zeroed(gpu, "observation quality", count)?,
            memory: StorageBuffer::zeroed(gpu, "colour memory", count)?,
            forget: true,
        })
    }

    /// Records the painting of [`GaussianBuffers::color`] (opacity 1) and uploads the cameras. `views` may have any
    /// number of views up to the maximum; a camera without an image is left out.
    ///
    /// Submit the encoder before the next update: uploads take effect at the submission.
    ///
    /// # Errors
    /// [`AppearanceError`] names the view or setting that does not fit; nothing was recorded then.
    pub fn update(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: &GaussianBuffers,
        views: &[ViewInput<'_>],
        settings: &AppearanceSettings,
    ) -> Result<(), AppearanceError> {
        self.update_timed(gpu, encoder, gaussians, views, settings, None)
    }

    /// Records an update as [`Self::update`] does and measures its stages: `observe`, `gather`, `diffuse`, `paint`.
    ///
    /// # Errors
    /// As [`Self::update`].
    pub fn update_timed(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        gaussians: &GaussianBuffers,
        views: &[ViewInput<'_>],
        settings: &AppearanceSettings,
        mut timer: Option<&mut GpuTimer>,
    ) -> Result<(), AppearanceError> {
        self.check(gaussians, views, settings)?;
        let constants = SettingsConstants::new(settings, !self.forget);
        if std::mem::take(&mut self.forget) {
            self.memory.encode_clear(encoder);
        }
        self.seen.encode_clear(encoder);
        self.quality.encode_clear(encoder);
        self.kept.iter().filter(|kept| !kept.is_empty()).for_each(|kept| kept.encode_clear(encoder));
        let Some(DeviceKernels { kernels, settings: settings_buffer, cameras }) = &self.device else {
            self.update_on_processor(gaussians, views, &constants);
            return Ok(());
        };
        for (camera, view) in cameras.iter().zip(views) {
            gpu.queue.write_buffer(camera, 0, bytemuck::bytes_of(&CameraConstants::from(view.camera)));
        }
        gpu.queue.write_buffer(settings_buffer, 0, bytemuck::bytes_of(&constants));
        let mut stage = |encoder: &mut CommandEncoder, name, kernel: &wgpu::ComputePipeline, binds: &[_], groups| {
            let timestamp_writes = timer.as_deref_mut().and_then(|timer| timer.stage(name));
            let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor { label: Some(name), timestamp_writes });
            pass.set_pipeline(kernel);
            let (x, y): (u32, u32) = groups;
            for bind in binds {
                pass.set_bind_group(0, bind, &[]);
                gpu.count_dispatch();
                pass.dispatch_workgroups(x, y, 1);
            }
        };
        let all_gaussians = dispatch_1d(self.seen.len() as u32, WORKGROUP);
        let observations: Vec<_> = cameras
            .iter()
            .zip(&self.kept)
            .zip(views)
            .map(|((camera, kept), view)| {
                let resources = [
                    settings_buffer.as_entire_binding(),
                    camera.as_entire_binding(),
                    view.picture.raw().as_entire_binding(),
                    view.canonical.raw().as_entire_binding(),
                    view.gaussians.unwrap_or(gaussians).center_scale.raw().as_entire_binding(),
                    view.gaussians.unwrap_or(gaussians).normal.raw().as_entire_binding(),
                    gaussians.canonical.raw().as_entire_binding(),
                    self.seen.raw().as_entire_binding(),
                    self.quality.raw().as_entire_binding(),
                    self.linear_from_srgb.raw().as_entire_binding(),
                    view.rendered.raw().as_entire_binding(),
                    gaussians.color.raw().as_entire_binding(),
                    kept.raw().as_entire_binding(),
                ];
                kernels.observe.bind(gpu, &resources)
            })
            .collect();
        stage(encoder, "observe", &kernels.observe.pipeline, &observations, all_gaussians);
        if settings.space {
            let bind = self.graph.bind_gather(gpu, &kernels.gather, &self.seen);
            let all_nodes = dispatch_1d(self.graph.node_count, WORKGROUP);
            stage(encoder, "gather", &kernels.gather.pipeline, &[bind], all_nodes);
            let bind = self.graph.bind_diffuse(gpu, &kernels.diffuse, settings_buffer);
            stage(encoder, "diffuse", &kernels.diffuse.pipeline, &[bind], (1, 1));
        }
        let bind = kernels.paint.bind(
            gpu,
            &[
                settings_buffer.as_entire_binding(),
                self.seen.raw().as_entire_binding(),
                self.quality.raw().as_entire_binding(),
                self.graph.node_color.raw().as_entire_binding(),
                self.graph.gaussian_nodes.raw().as_entire_binding(),
                self.graph.gaussian_weights.raw().as_entire_binding(),
                self.memory.raw().as_entire_binding(),
                gaussians.color.raw().as_entire_binding(),
            ],
        );
        stage(encoder, "paint", &kernels.paint.pipeline, &[bind], all_gaussians);
        Ok(())
    }

    /// Runs the update on the processor.
    fn update_on_processor(&self, gaussians: &GaussianBuffers, views: &[ViewInput<'_>], settings: &SettingsConstants) {
        let (Some(mut seen), Some(mut quality)) = (self.seen.slice_mut(), self.quality.slice_mut()) else { return };
        let Some(linear) = self.linear_from_srgb.slice() else { return };
        for (view, kept) in views.iter().zip(&self.kept) {
            let Some(mut kept) = kept.slice_mut() else { return };
            let out = ObservationSums { seen: &mut seen, quality: &mut quality, kept: &mut kept };
            processor::observe(settings, view, gaussians, &linear, out);
        }
        if settings.space != 0 {
            processor::gather(&self.graph, &seen);
            processor::diffuse(&self.graph, settings);
        }
        let (Some(mut memory), Some(mut color)) = (self.memory.slice_mut(), gaussians.color.slice_mut()) else {
            return;
        };
        processor::paint(settings, &self.graph, (&seen, &quality), &mut memory, &mut color);
    }

    /// Keeps the observations of each view from the next update on, for [`Self::observations`].
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn keep_observations(&mut self, gpu: &GpuContext) -> Result<(), GpuError> {
        for kept in &mut self.kept {
            *kept = StorageBuffer::zeroed(gpu, KEPT, self.seen.len())?;
        }
        Ok(())
    }

    /// Reads back the observations of the last update, which must have been submitted. `views` is its number of views;
    /// their lists are empty without [`Self::keep_observations`].
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn observations(&self, gpu: &GpuContext, views: usize) -> Result<Observations, GpuError> {
        let nodes = self.graph.node_count as usize;
        Ok(Observations {
            views: self.kept.iter().take(views).map(|kept| kept.read(gpu)).collect::<Result<_, _>>()?,
            seen: self.seen.read(gpu)?,
            quality: self.quality.read(gpu)?,
            node_seen: self.graph.node_seen.read_first(gpu, nodes)?,
            node_color: self.graph.node_color.read_first(gpu, nodes)?,
        })
    }

    /// Reads the colour memory back: accumulated linear RGB of each Gaussian and its weight.
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn memory(&self, gpu: &GpuContext) -> Result<Vec<[f32; 4]>, GpuError> {
        self.memory.read(gpu)
    }

    /// Resumes from the colour memory of an earlier appearance of the same Gaussians.
    ///
    /// # Errors
    /// [`AppearanceError::GaussianCount`] for another number of Gaussians.
    pub fn resume(&mut self, gpu: &GpuContext, memory: &[[f32; 4]]) -> Result<(), AppearanceError> {
        let (expected, found) = (self.seen.len(), memory.len());
        if found != expected {
            return Err(AppearanceError::GaussianCount { expected, found });
        }
        self.memory.write(gpu, memory);
        self.forget = false;
        Ok(())
    }

    /// Forgets all earlier frames, from the next update on.
    pub fn reset(&mut self) {
        self.forget = true;
    }

    fn check(
        &self,
        gaussians: &GaussianBuffers,
        views: &[ViewInput<'_>],
        settings: &AppearanceSettings,
    ) -> Result<(), AppearanceError> {
        settings.validate()?;
        let (expected, found) = (self.seen.len(), gaussians.count());
        if found != expected {
            return Err(AppearanceError::GaussianCount { expected, found });
        }
        let (max, found) = (self.kept.len(), views.len());
        if found > max {
            return Err(AppearanceError::TooManyViews { max, found });
        }
        for view in views {
            let camera = view.camera.id.clone();
            let (width, height) = (view.camera.intrinsics.width, view.camera.intrinsics.height);
            let pixels = width as usize * height as usize;
            if pixels == 0 || width.max(height) > MAX_IMAGE_SIDE {
                return Err(AppearanceError::ImageSize { camera, width, height });
            }
            let inputs = [
                ("the image", "pixels", pixels, view.picture.len()),
                ("the canonical map", "pixels", pixels, view.canonical.len()),
                ("the rendered image", "pixels", pixels, view.rendered.len()),
            ];
            for (what, unit, needed, found) in inputs {
                if needed != found {
                    return Err(AppearanceError::ViewSize { camera, what, unit, width, height, needed, found });
                }
            }
        }
        Ok(())
    }
}

//! Buffers of direct appearance and the recording of one frame.

use flyrig_body::{DeformationGraph, SurfaceGaussians};
use flyrig_gpu::{CameraUniform, GpuContext, GpuTimer, StorageBuffer, dispatch_1d};
use wgpu::{
    BindingResource, Buffer, BufferUsages, CommandEncoder, ComputePassDescriptor, Extent3d, Texture, TextureView,
};

use super::{
    AppearanceError, AppearanceSettings, ViewInput,
    graph_buffers::GraphBuffers,
    kernels::{Kernels, SettingsUniform, WORKGROUP},
};
use crate::GaussianBuffers;

/// Paints every Gaussian from the pictures of this instant and a memory of earlier ones.
///
/// Buffers and pipelines are made once, pictures when a view's size changes.
#[derive(Debug)]
pub struct DirectAppearance {
    kernels: Kernels,
    graph: GraphBuffers,
    settings: Buffer,
    views: Vec<ViewSlot>,
    /// Sum of weight times linear RGB, sum of weights.
    seen: StorageBuffer<[f32; 4]>,
    /// Sum of Eq. 6 weights, exp(-k d) of the best view.
    quality: StorageBuffer<[f32; 2]>,
    /// Accumulated linear RGB and its weight.
    memory: StorageBuffer<[f32; 4]>,
    forget: bool,
}

/// What is uploaded for one view.
#[derive(Debug)]
struct ViewSlot {
    camera: Buffer,
    picture: Option<(Texture, TextureView)>,
}

impl DirectAppearance {
    /// For the Gaussians and graph of one body and at most `max_views` pictures a frame.
    ///
    /// # Errors
    /// [`AppearanceError::Graph`] when the two do not fit, [`AppearanceError::Gpu`].
    pub fn new(
        gpu: &GpuContext,
        gaussians: &SurfaceGaussians,
        graph: &DeformationGraph,
        max_views: usize,
    ) -> Result<Self, AppearanceError> {
        let count = gaussians.positions.len();
        let graph = GraphBuffers::new(gpu, count, graph)?;
        let uniform = |label, size: usize| {
            gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: size as u64,
                usage: BufferUsages::UNIFORM | BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        };
        let view = || ViewSlot { camera: uniform("view camera", size_of::<CameraUniform>()), picture: None };
        Ok(Self {
            kernels: Kernels::new(gpu),
            graph,
            settings: uniform("appearance settings", size_of::<SettingsUniform>()),
            views: std::iter::repeat_with(view).take(max_views).collect(),
            seen: StorageBuffer::zeroed(gpu, "observed colours", count)?,
            quality: StorageBuffer::zeroed(gpu, "observation quality", count)?,
            memory: StorageBuffer::zeroed(gpu, "colour memory", count)?,
            forget: true,
        })
    }

    /// Records the painting of [`GaussianBuffers::color`] (opacity 1) and uploads the pictures. Any number of views
    /// up to the maximum will do; a camera that gave no picture is left out of `views`.
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

    /// [`Self::update`] with the time of its stages: `observe`, `gather`, `diffuse`, `paint`.
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
        self.check(gpu, gaussians, views, settings)?;
        gpu.queue.write_buffer(&self.settings, 0, bytemuck::bytes_of(&SettingsUniform::from(settings)));
        if std::mem::take(&mut self.forget) {
            encoder.clear_buffer(self.memory.raw(), 0, None);
        }
        encoder.clear_buffer(self.seen.raw(), 0, None);
        encoder.clear_buffer(self.quality.raw(), 0, None);
        let mut stage = |encoder: &mut CommandEncoder, name, kernel: &wgpu::ComputePipeline, binds: &[_], groups| {
            let timestamp_writes = timer.as_deref_mut().and_then(|timer| timer.stage(name));
            let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor { label: Some(name), timestamp_writes });
            pass.set_pipeline(kernel);
            let (x, y): (u32, u32) = groups;
            for bind in binds {
                pass.set_bind_group(0, bind, &[]);
                pass.dispatch_workgroups(x, y, 1);
            }
        };
        let all_gaussians = dispatch_1d(self.seen.len() as u32, WORKGROUP);
        let binds: Vec<_> = self.views.iter_mut().zip(views).map(|(slot, view)| slot.upload(gpu, view)).collect();
        let observations: Vec<_> = self
            .views
            .iter()
            .zip(&binds)
            .zip(views)
            .map(|((slot, picture), view)| {
                let resources = [
                    self.settings.as_entire_binding(),
                    slot.camera.as_entire_binding(),
                    BindingResource::TextureView(picture),
                    view.canonical.raw().as_entire_binding(),
                    gaussians.center_scale.raw().as_entire_binding(),
                    gaussians.normal.raw().as_entire_binding(),
                    gaussians.canonical.raw().as_entire_binding(),
                    self.seen.raw().as_entire_binding(),
                    self.quality.raw().as_entire_binding(),
                ];
                self.kernels.observe.bind(gpu, &resources)
            })
            .collect();
        stage(encoder, "observe", &self.kernels.observe.pipeline, &observations, all_gaussians);
        if settings.space {
            let bind = self.graph.bind_gather(gpu, &self.kernels.gather, &self.seen);
            let all_nodes = dispatch_1d(self.graph.node_count, WORKGROUP);
            stage(encoder, "gather", &self.kernels.gather.pipeline, &[bind], all_nodes);
            let bind = self.graph.bind_diffuse(gpu, &self.kernels.diffuse, &self.settings);
            stage(encoder, "diffuse", &self.kernels.diffuse.pipeline, &[bind], (1, 1));
        }
        let bind = self.kernels.paint.bind(
            gpu,
            &[
                self.settings.as_entire_binding(),
                self.seen.raw().as_entire_binding(),
                self.quality.raw().as_entire_binding(),
                self.graph.node_color.raw().as_entire_binding(),
                self.graph.gaussian_nodes.raw().as_entire_binding(),
                self.graph.gaussian_weights.raw().as_entire_binding(),
                self.memory.raw().as_entire_binding(),
                gaussians.color.raw().as_entire_binding(),
            ],
        );
        stage(encoder, "paint", &self.kernels.paint.pipeline, &[bind], all_gaussians);
        Ok(())
    }

    /// Forgets all earlier frames, from the next update on.
    pub fn reset(&mut self) {
        self.forget = true;
    }

    fn check(
        &self,
        gpu: &GpuContext,
        gaussians: &GaussianBuffers,
        views: &[ViewInput<'_>],
        settings: &AppearanceSettings,
    ) -> Result<(), AppearanceError> {
        settings.validate()?;
        let (expected, found) = (self.seen.len(), gaussians.count());
        if found != expected {
            return Err(AppearanceError::GaussianCount { expected, found });
        }
        let (max, found) = (self.views.len(), views.len());
        if found > max {
            return Err(AppearanceError::TooManyViews { max, found });
        }
        let limit = gpu.device.limits().max_texture_dimension_2d;
        for view in views {
            let camera = view.camera.id.clone();
            let (width, height) = (view.camera.intrinsics.width, view.camera.intrinsics.height);
            let pixels = width as usize * height as usize;
            if width.max(height) > limit || pixels == 0 {
                return Err(AppearanceError::PictureSize { camera, width, height, limit });
            }
            let inputs = [
                ("the picture", "bytes", pixels * 4, view.rgba.len()),
                ("the canonical map", "pixels", pixels, view.canonical.len()),
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

impl ViewSlot {
    /// Queues the upload of camera and picture.
    fn upload(&mut self, gpu: &GpuContext, view: &ViewInput<'_>) -> TextureView {
        gpu.queue.write_buffer(&self.camera, 0, bytemuck::bytes_of(&CameraUniform::from(view.camera)));
        let size = Extent3d {
            width: view.camera.intrinsics.width,
            height: view.camera.intrinsics.height,
            depth_or_array_layers: 1,
        };
        if self.picture.as_ref().is_some_and(|(texture, _)| texture.size() != size) {
            self.picture = None;
        }
        let (texture, picture) = self.picture.get_or_insert_with(|| {
            let texture = gpu.device.create_texture(&wgpu::TextureDescriptor {
                label: Some("view picture"),
                size,
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                // The texture unit decodes sRGB, so interpolation happens in linear light; alpha stays as it is.
                format: wgpu::TextureFormat::Rgba8UnormSrgb,
                usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
                view_formats: &[],
            });
            let picture = texture.create_view(&Default::default());
            (texture, picture)
        });
        let rows = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(size.width * 4), rows_per_image: None };
        gpu.queue.write_texture(texture.as_image_copy(), view.rgba, rows, size);
        picture.clone()
    }
}

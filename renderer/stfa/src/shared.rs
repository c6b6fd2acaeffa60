//! Networks on the device that also draws (feature `wgpu`): what direct appearance found out goes to them, and the colours
//! back, without the processor.

use std::{any::Any, sync::Mutex};

use burn_cubecl::{
    CubeBackend,
    cubecl::wgpu::{AutoCompiler, WgpuServer},
};
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_learn::burn_tensor::{Device, Tensor, wgpu::WgpuSetup};
use flyrig_renderer::{AppearanceSettings, DirectAppearance, GaussianBuffers};

use crate::{
    BodyGraph, Parameters, StfaError,
    crops::{Crops, ViewImage},
    device_paint::{DevicePainter, ObservedTensors},
};

/// The drawing device as burn knows it, and which one it is: burn does not notice a second registration.
static REGISTERED: Mutex<Vec<(wgpu::Device, Device)>> = Mutex::new(Vec::new());

/// [`LearnedAppearance`](crate::LearnedAppearance) on the drawing device. It keeps nothing from frame to frame but the memory,
/// and counts nothing.
#[derive(Debug)]
pub struct SharedAppearance {
    painter: DevicePainter,
    device: Device,
}

impl SharedAppearance {
    /// For one body. The same weights serve every body.
    ///
    /// # Errors
    /// [`StfaError::Device`] when the networks' library does not take the device.
    pub fn new(gpu: &GpuContext, parameters: &Parameters, body: &BodyGraph) -> Result<Self, StfaError> {
        let device = registered(gpu)?;
        Ok(Self { painter: DevicePainter::new(parameters, body, &device), device })
    }

    /// Forgets all earlier frames.
    pub fn reset(&mut self) {
        self.painter.reset();
    }

    /// Repaints [`GaussianBuffers::color`] from what `direct` observed with these settings in these images, view by view.
    /// Direct appearance must keep its observations, and its update must have been submitted.
    ///
    /// # Errors
    /// [`StfaError::Frame`] when observations and images do not fit, [`StfaError::Device`].
    pub fn paint(
        &mut self,
        gpu: &GpuContext,
        direct: &DirectAppearance,
        gaussians: &GaussianBuffers,
        pictures: &[ViewImage<'_>],
        settings: &AppearanceSettings,
    ) -> Result<(), StfaError> {
        let crops = Crops::cut(pictures)?;
        let mut copies = Copies::new(gpu, &self.device);
        let buffers = direct.observation_buffers();
        for (what, found, expected) in [
            ("Gaussians", gaussians.count(), self.painter.gaussians()),
            ("nodes", buffers.nodes, self.painter.nodes()),
            ("images", pictures.len(), pictures.len().min(buffers.views.len())),
        ] {
            if found != expected {
                return Err(StfaError::Frame(format!("{found} {what}, expected {expected}")));
            }
        }
        let observed = ObservedTensors {
            views: (buffers.views.iter().take(pictures.len()))
                .map(|kept| copies.tensor(kept, gaussians.count()))
                .collect::<Result<_, _>>()?,
            seen: copies.tensor(buffers.seen, gaussians.count())?,
            quality: copies.tensor(buffers.quality, gaussians.count())?,
            node_seen: copies.tensor(buffers.node_seen, buffers.nodes)?,
            node_color: copies.tensor(buffers.node_color, buffers.nodes)?,
        };
        copies.submit();
        let colors = self.painter.paint(&observed, &crops, settings)?;
        copies.write(colors, &gaussians.color)
    }
}

/// The drawing device for networks, registered once.
pub(crate) fn registered(gpu: &GpuContext) -> Result<Device, StfaError> {
    let refuse = |what: String| StfaError::Device(what);
    let mut known = REGISTERED.lock().map_err(|_| refuse("an earlier use ended in a panic".to_owned()))?;
    if let Some((_, device)) = known.iter().find(|(device, _)| *device == gpu.device) {
        return Ok(device.clone());
    }
    let (instance, adapter) = gpu.handles();
    let setup = WgpuSetup {
        instance: instance.clone(),
        adapter: adapter.clone(),
        device: gpu.device.clone(),
        queue: gpu.queue.clone(),
        backend: adapter.get_info().backend,
    };
    let device = Device::wgpu_options().setup(setup).init().map_err(|error| refuse(error.to_string()))?;
    known.push((gpu.device.clone(), device.clone()));
    Ok(device)
}

/// Copies between our buffers and burn's, on the queue that both use.
struct Copies<'a> {
    gpu: &'a GpuContext,
    device: &'a Device,
    encoder: wgpu::CommandEncoder,
    /// Burn's tables that what was recorded names by their address: while these are held, they stay where they are.
    held: Vec<Box<dyn Any>>,
}

impl<'a> Copies<'a> {
    fn new(gpu: &'a GpuContext, device: &'a Device) -> Self {
        Self { gpu, device, encoder: gpu.device.create_command_encoder(&Default::default()), held: Vec::new() }
    }

    /// Records the copy of a buffer of `rows` rows into a new tensor.
    fn tensor<const C: usize>(
        &mut self,
        buffer: &StorageBuffer<[f32; C]>,
        rows: usize,
    ) -> Result<Tensor<2>, StfaError> {
        if buffer.len() < rows {
            return Err(StfaError::Frame(format!("{} rows of observations, expected {rows}", buffer.len())));
        }
        let tensor = Tensor::empty([rows, C], self.device);
        let bytes = (rows * C * size_of::<f32>()) as u64;
        self.record(tensor.clone(), |encoder, theirs, offset| {
            encoder.copy_buffer_to_buffer(buffer.raw(), 0, theirs, offset, bytes);
        })?;
        Ok(tensor)
    }

    /// Copies a tensor out into a buffer of the same form, before anything later on the queue.
    fn write<const C: usize>(mut self, tensor: Tensor<2>, buffer: &StorageBuffer<[f32; C]>) -> Result<(), StfaError> {
        let bytes = (buffer.len() * C * size_of::<f32>()) as u64;
        if tensor.dims() != [buffer.len(), C] {
            return Err(StfaError::Frame(format!("{:?} colours for {} Gaussians", tensor.dims(), buffer.len())));
        }
        self.record(tensor, |encoder, theirs, offset| {
            encoder.copy_buffer_to_buffer(theirs, offset, buffer.raw(), 0, bytes);
        })?;
        self.submit();
        Ok(())
    }

    /// Finds a tensor's place in burn's memory. What burn was told before is on the queue after this.
    fn record(
        &mut self,
        tensor: Tensor<2>,
        copy: impl FnOnce(&mut wgpu::CommandEncoder, &wgpu::Buffer, u64),
    ) -> Result<(), StfaError> {
        let refuse = |what: String| StfaError::Device(what);
        let tensor = tensor.try_into_primitive::<CubeBackend>().map_err(|error| refuse(format!("{error:?}")))?;
        if !tensor.is_contiguous() {
            return Err(refuse("a table with gaps between its rows".to_owned()));
        }
        let managed = (tensor.client)
            .get_resource::<WgpuServer<AutoCompiler>>(tensor.handle.clone())
            .map_err(|error| refuse(error.to_string()))?;
        tensor.client.flush().map_err(|error| refuse(error.to_string()))?;
        let resource = managed.resource();
        copy(&mut self.encoder, &resource.buffer, resource.offset);
        self.held.push(Box::new(managed));
        Ok(())
    }

    /// Puts what was recorded on the queue.
    fn submit(&mut self) {
        let encoder = std::mem::replace(&mut self.encoder, self.gpu.device.create_command_encoder(&Default::default()));
        self.gpu.queue.submit([encoder.finish()]);
        self.held.clear();
    }
}

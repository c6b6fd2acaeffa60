//! Choice of an adapter and opening of a device.

use std::sync::{Arc, Mutex};

use flyrig_types::lock;
use wgpu::{
    Adapter, AdapterInfo, BackendOptions, Backends, Device, DeviceType, Features, Instance, InstanceDescriptor, Limits,
    NoopBackendOptions, Queue,
};

use crate::{GpuError, GpuObjects, shared::Shared};

/// Adapter to open.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum AdapterChoice {
    /// Adapter of the fastest available kind: discrete, integrated, virtual, then software.
    #[default]
    Best,
    /// First adapter whose name contains this text, ignoring case.
    Named(String),
}

/// Largest array of a context without an adapter, bytes; a software adapter binds no larger ones either.
const MOST_BYTES: u64 = 1 << 27;

/// Open device with its queue. Clones share both.
#[derive(Debug, Clone)]
pub struct GpuContext {
    /// wgpu's device.
    pub device: Device,
    /// wgpu's queue.
    pub queue: Queue,
    instance: Instance,
    adapter: Adapter,
    info: AdapterInfo,
    choice: AdapterChoice,
    on_processor: bool,
    /// Context of the chosen adapter, for one that was created without; opened when it is first needed.
    on_adapter: Arc<Mutex<Option<Box<GpuContext>>>>,
    pub(crate) shared: Arc<Shared>,
}

impl GpuContext {
    /// Opens the chosen adapter.
    ///
    /// # Errors
    /// [`GpuError`] names what is missing and what to install.
    pub fn new(choice: &AdapterChoice) -> Result<Self, GpuError> {
        pollster::block_on(async { Self::open(adapters().await, choice).await })
    }

    /// Opens the chosen adapter, unless kernels run faster on the processor: without an adapter, or with a software one that was not
    /// chosen by name. Then no driver takes memory; [`Self::with_adapter`] opens the adapter where something must be drawn on it.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn fastest_of(choice: &AdapterChoice) -> Result<Self, GpuError> {
        pollster::block_on(async {
            if *choice != AdapterChoice::Best {
                return Self::open(adapters().await, choice).await;
            }
            if may_have_hardware() {
                let found = adapters().await;
                if found.1.iter().any(|adapter| adapter.get_info().device_type != DeviceType::Cpu) {
                    return Self::open(found, choice).await;
                }
            }
            Self::without_adapter().await
        })
    }

    /// Creates a context without an adapter: wgpu's backend that does nothing stands in, and kernels run on the processor.
    async fn without_adapter() -> Result<Self, GpuError> {
        let limits =
            Limits { max_buffer_size: MOST_BYTES, max_storage_buffer_binding_size: MOST_BYTES, ..Limits::unlimited() };
        let noop = NoopBackendOptions { enable: true, limits: Some(limits), ..NoopBackendOptions::default() };
        let instance = Instance::new(InstanceDescriptor {
            backends: Backends::NOOP,
            backend_options: BackendOptions { noop, ..BackendOptions::default() },
            ..InstanceDescriptor::new_without_display_handle()
        });
        let adapters = instance.enumerate_adapters(Backends::NOOP).await;
        let context = Self::open((instance, adapters), &AdapterChoice::Best).await?;
        Ok(Self { on_processor: true, ..context })
    }

    async fn open(
        (instance, mut adapters): (Instance, Vec<Adapter>),
        choice: &AdapterChoice,
    ) -> Result<Self, GpuError> {
        if adapters.is_empty() {
            return Err(GpuError::NoAdapter);
        }
        let adapter = match choice {
            AdapterChoice::Best => adapters.swap_remove(0),
            AdapterChoice::Named(wanted) => {
                let name = |adapter: &Adapter| adapter.get_info().name;
                let lower = wanted.to_lowercase();
                match adapters.iter().position(|adapter| name(adapter).to_lowercase().contains(&lower)) {
                    Some(index) => adapters.swap_remove(index),
                    None => {
                        let found = adapters.iter().map(name).collect::<Vec<_>>().join(", ");
                        return Err(GpuError::NoSuchAdapter { wanted: wanted.clone(), found });
                    }
                }
            }
        };
        let info = adapter.get_info();
        let limits = adapter.limits();
        let check = |limit, found: u64, needed: u64| {
            if found >= needed {
                Ok(())
            } else {
                Err(GpuError::Limit { adapter: info.name.clone(), limit, found, needed })
            }
        };
        check("max_storage_buffers_per_shader_stage", limits.max_storage_buffers_per_shader_stage.into(), 13)?;
        check("max_compute_invocations_per_workgroup", limits.max_compute_invocations_per_workgroup.into(), 256)?;
        // The networks' library assumes that these features are enabled wherever the adapter has them.
        let networks = Features::SUBGROUP
            | Features::SHADER_F16
            | Features::SHADER_F64
            | Features::SHADER_INT64
            | Features::SHADER_FLOAT32_ATOMIC;
        let wanted = Features::TIMESTAMP_QUERY | networks;
        let (device, queue) = adapter
            .request_device(&wgpu::DeviceDescriptor {
                label: Some("flyrig"),
                required_features: adapter.features() & wanted,
                required_limits: limits,
                ..Default::default()
            })
            .await
            .map_err(|source| GpuError::Open { adapter: info.name.clone(), source })?;
        tracing::debug!(adapter = %info.name, backend = %info.backend, driver = %info.driver_info, "graphics adapter");
        let shared = Arc::new(Shared::default());
        shared.fault.watch(&device);
        let choice = choice.clone();
        let on_adapter = Arc::default();
        Ok(Self { device, queue, instance, adapter, info, choice, on_processor: false, on_adapter, shared })
    }

    /// Opens the chosen adapter again, after the loss of a device. The new context shares nothing with this one.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn reopen(&self) -> Result<Self, GpuError> {
        if !self.has_adapter() {
            return pollster::block_on(Self::without_adapter());
        }
        Ok(Self { on_processor: self.on_processor, ..Self::new(&self.choice)? })
    }

    /// Returns this context for kernels that run natively on the processor: its arrays lie in the processor's memory
    /// ([`StorageBuffer::slice`](crate::StorageBuffer::slice)), and its kernels compute when they are recorded. Kernels and arrays of
    /// the two kinds do not mix.
    #[must_use]
    pub fn on_processor(&self) -> Self {
        Self { on_processor: true, ..self.clone() }
    }

    /// Returns this context with kernels on the adapter, which is opened where it was not yet: for what has no native form, such as the
    /// pictures of the simulator. All clones share one such context.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_adapter(&self) -> Result<Self, GpuError> {
        if self.has_adapter() {
            return Ok(Self { on_processor: false, ..self.clone() });
        }
        let mut opened = lock(&self.on_adapter);
        if let Some(context) = &*opened {
            return Ok((**context).clone());
        }
        let context = Self::new(&self.choice)?;
        *opened = Some(Box::new(context.clone()));
        Ok(context)
    }

    /// Returns whether an adapter is open, and not only its stand-in.
    fn has_adapter(&self) -> bool {
        self.info.backend != wgpu::Backend::Noop
    }

    /// Returns whether kernels run natively on the processor.
    #[must_use]
    pub fn is_on_processor(&self) -> bool {
        self.on_processor
    }

    /// Returns this context with kernels where they run fastest: [`Self::on_processor`] for a software adapter that was not chosen by
    /// name, else on the adapter.
    #[must_use]
    pub fn fastest(&self) -> Self {
        let is_named = matches!(self.choice, AdapterChoice::Named(_));
        if self.is_software() && !is_named { self.on_processor() } else { self.clone() }
    }

    /// Checks that the device was not lost, did not run out of memory and rejected no command.
    ///
    /// # Errors
    /// The first fault since the device was opened.
    pub fn check(&self) -> Result<(), GpuError> {
        self.shared.fault.check()
    }

    /// Destroys the device, as a driver's reset would; for tests of the recovery.
    pub fn simulate_loss(&self) {
        self.device.destroy();
    }

    /// Returns the numbers of GPU objects created so far.
    #[must_use]
    pub fn objects(&self) -> GpuObjects {
        self.shared.objects()
    }

    /// Returns name, backend and driver of the adapter, for reports.
    #[must_use]
    pub fn adapter_name(&self) -> String {
        if self.on_processor {
            let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
            return format!("processor ({threads} threads)");
        }
        format!("{} ({}, {})", self.info.name, self.info.backend, self.info.driver_info)
    }

    /// Returns instance and adapter of the device, for libraries that share it.
    #[must_use]
    pub fn handles(&self) -> (&Instance, &Adapter) {
        (&self.instance, &self.adapter)
    }

    /// Returns whether the adapter is implemented in software.
    #[must_use]
    pub fn is_software(&self) -> bool {
        self.info.device_type == DeviceType::Cpu
    }

    /// Waits until all submitted work is done.
    ///
    /// # Errors
    /// [`GpuError::Lost`], or the device's first fault.
    pub fn wait(&self) -> Result<(), GpuError> {
        if self.on_processor {
            return self.check();
        }
        self.shared.traffic.wait();
        let waited = self.device.poll(wgpu::PollType::wait_indefinitely());
        self.check()?;
        waited.map(|_| ()).map_err(|error| GpuError::Lost(error.to_string()))
    }
}

/// Returns false where no driver of a graphics processor has a device file. Then the adapters need not be listed: Mesa's software
/// driver stays in memory once it was loaded, with 60 MB.
#[cfg(target_os = "linux")]
fn may_have_hardware() -> bool {
    /// Beginnings of the names: desktop and server drivers, Tegra, Windows' own below Linux, Adreno, Mali, PowerVR.
    const NAMES: [&str; 8] = ["dri", "nvidia", "nvhost", "nvmap", "dxg", "kgsl", "mali", "pvr"];
    let Ok(devices) = std::fs::read_dir("/dev") else { return true };
    devices.filter_map(Result::ok).any(|entry| {
        let name = entry.file_name();
        NAMES.iter().any(|start| name.as_encoded_bytes().starts_with(start.as_bytes()))
    })
}

#[cfg(not(target_os = "linux"))]
fn may_have_hardware() -> bool {
    true
}

/// Lists all adapters, the fastest kind first.
async fn adapters() -> (Instance, Vec<Adapter>) {
    let instance = Instance::new(InstanceDescriptor {
        backends: Backends::VULKAN | Backends::METAL | Backends::DX12,
        ..InstanceDescriptor::new_without_display_handle()
    });
    let mut adapters = instance.enumerate_adapters(Backends::all()).await;
    adapters.sort_by_key(|adapter| rank(adapter.get_info().device_type));
    (instance, adapters)
}

/// Returns name, backend, driver and kind of each adapter, in the order of [`AdapterChoice::Best`].
#[must_use]
pub fn adapter_names() -> Vec<String> {
    let name = |adapter: Adapter| {
        let info = adapter.get_info();
        let kind = if info.device_type == DeviceType::Cpu { ", software" } else { "" };
        format!("{} ({}, {}{kind})", info.name, info.backend, info.driver_info)
    };
    pollster::block_on(adapters()).1.into_iter().map(name).collect()
}

fn rank(kind: DeviceType) -> u8 {
    match kind {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::StorageBuffer;

    fn without_adapter() -> GpuContext {
        pollster::block_on(GpuContext::without_adapter()).unwrap()
    }

    #[test]
    fn arrays_need_no_adapter() {
        let gpu = without_adapter();
        assert!(
            gpu.is_on_processor() && gpu.fastest().is_on_processor() && gpu.adapter_name().starts_with("processor")
        );
        let values = StorageBuffer::from_slice(&gpu, "values", &[1.0f32, 2.0, 3.0]).unwrap();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        values.encode_write(&gpu, &mut encoder, &[4.0, 5.0]);
        gpu.queue.submit([encoder.finish()]);
        gpu.wait().unwrap();
        assert_eq!(values.read(&gpu).unwrap(), [4.0, 5.0, 3.0]);
        let again = gpu.reopen().unwrap();
        assert!(again.is_on_processor() && !again.has_adapter());
        let error = StorageBuffer::<[f32; 4]>::zeroed(&gpu, "too many", 1 << 24).unwrap_err();
        assert!(matches!(error, GpuError::TooLarge { .. }), "{error}");
    }

    #[test]
    fn the_adapter_is_opened_once_for_all_clones() {
        let gpu = without_adapter();
        let (first, second) = (gpu.with_adapter().unwrap(), gpu.clone().with_adapter().unwrap());
        assert!(first.has_adapter() && !first.is_on_processor());
        assert_eq!(first.device, second.device);
        let back = first.on_processor().with_adapter().unwrap();
        assert!(back.device == first.device && !back.is_on_processor());
    }

    #[test]
    fn an_adapter_chosen_by_name_is_opened() {
        let name = crate::testing::device().info.name;
        let named = GpuContext::fastest_of(&AdapterChoice::Named(name)).unwrap();
        assert!(named.has_adapter() && !named.is_on_processor());
        let best = GpuContext::fastest_of(&AdapterChoice::Best).unwrap();
        assert_eq!(best.has_adapter(), !best.is_software());
        let error = GpuContext::fastest_of(&AdapterChoice::Named("no such card".to_owned())).unwrap_err();
        assert!(matches!(error, GpuError::NoSuchAdapter { .. }), "{error}");
    }
}

//! Layer over wgpu: one device and queue, errors with advice, typed arrays on the device or in the processor's memory, the camera
//! model in WGSL and in Rust, and stage timers. Any wgpu adapter serves.
//!
//! ```no_run
//! use flyrig_gpu::{AdapterChoice, ComputeKernel, GpuContext, StorageBuffer, dispatch_1d};
//!
//! const DOUBLE: &str = "
//! @group(0) @binding(0) var<storage, read_write> values: array<f32>;
//! @compute @workgroup_size(64)
//! fn double(@builtin(global_invocation_id) id: vec3<u32>) {
//!     if id.x < arrayLength(&values) { values[id.x] *= 2.0; }
//! }";
//!
//! let gpu = GpuContext::new(&AdapterChoice::Best)?;
//! let values = StorageBuffer::from_slice(&gpu, "values", &[1.0f32, 2.0])?;
//! let kernel = ComputeKernel::new(&gpu, "double", &[DOUBLE], "double");
//! let mut encoder = gpu.device.create_command_encoder(&Default::default());
//! {
//!     let mut pass = encoder.begin_compute_pass(&Default::default());
//!     pass.set_pipeline(&kernel.pipeline);
//!     pass.set_bind_group(0, &kernel.bind(&gpu, &[values.raw().as_entire_binding()]), &[]);
//!     let (x, y) = dispatch_1d(2, 64);
//!     pass.dispatch_workgroups(x, y, 1);
//! }
//! gpu.queue.submit([encoder.finish()]);
//! assert_eq!(values.read(&gpu)?, [2.0, 4.0]);
//! # Ok::<(), flyrig_gpu::GpuError>(())
//! ```

mod bind_groups;
mod buffer;
mod camera;
mod context;
mod error;
mod objects;
mod shader;
mod shared;
mod stage_timer;
#[doc(hidden)]
pub mod testing;
mod timer;
mod traffic;
mod uploads;

pub use buffer::{StorageBuffer, read_all, read_back};
pub use camera::{CAMERA_WGSL, CameraConstants, Distorted};
pub use context::{AdapterChoice, GpuContext, adapter_names};
pub use error::GpuError;
pub use objects::GpuObjects;
pub use shader::{ComputeKernel, MAX_WORKGROUPS_PER_DIMENSION, bind, dispatch_1d};
pub use stage_timer::StageTimer;
pub use timer::{GpuTimer, StageTime};
pub use traffic::GpuTraffic;

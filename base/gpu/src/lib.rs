//! The GPU as flyrig sees it: one device and queue, errors with advice, typed arrays on the device or in the processor's
//! memory, the camera model in WGSL and in Rust, and stage timers. Any wgpu adapter will do.

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

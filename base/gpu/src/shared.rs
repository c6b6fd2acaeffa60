//! State that all clones of a [`crate::GpuContext`] share: compiled pipelines, bind groups, staging buffers, and the device's
//! first fault.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, atomic::Ordering},
};

use flyrig_types::lock;
use wgpu::{Buffer, BufferDescriptor, BufferUsages, ComputePipeline, Device};

use crate::{
    GpuError, GpuObjects, bind_groups::BindGroups, objects::Counters, traffic::TrafficCounters, uploads::Uploads,
};

/// Largest number of idle read-back buffers; a frame uses a few sizes.
const IDLE_READ_BACKS: usize = 24;

/// First fault of the device, written by wgpu's callbacks. Holds no wgpu object, which would keep the device alive.
#[derive(Debug, Clone, Default)]
pub(crate) struct FaultSlot(Arc<Mutex<Option<GpuError>>>);

impl FaultSlot {
    fn set(&self, fault: GpuError) {
        let mut slot = lock(&self.0);
        if slot.is_none() {
            tracing::error!("graphics device: {fault}");
            *slot = Some(fault);
        }
    }

    /// Registers the callbacks. Without them wgpu panics on the first uncaught error.
    pub fn watch(&self, device: &Device) {
        let slot = self.clone();
        device.set_device_lost_callback(move |reason, message| {
            slot.set(GpuError::Lost(format!("{reason:?}: {}", first_line(&message))));
        });
        let slot = self.clone();
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            slot.set(match error {
                wgpu::Error::OutOfMemory { .. } => GpuError::OutOfMemory,
                wgpu::Error::Validation { description, .. } | wgpu::Error::Internal { description, .. } => {
                    GpuError::Rejected(first_line(&description))
                }
            });
        }));
    }

    /// Returns the first fault as an error, if there was one.
    pub fn check(&self) -> Result<(), GpuError> {
        lock(&self.0).clone().map_or(Ok(()), Err)
    }
}

/// Characters after which messages of drivers are cut.
const LONGEST: usize = 300;

fn first_line(message: &str) -> String {
    let words: Vec<&str> = message.split_whitespace().collect();
    words.join(" ").chars().take(LONGEST).collect()
}

/// Caches and counters of one device.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    pub fault: FaultSlot,
    /// Pipelines by WGSL and entry point.
    pipelines: Mutex<HashMap<(String, String), ComputePipeline>>,
    /// Idle read-back buffers of any size, not mapped.
    read_backs: Mutex<Vec<Buffer>>,
    pub uploads: Uploads,
    pub bind_groups: BindGroups,
    pub counters: Counters,
    pub traffic: TrafficCounters,
}

impl Shared {
    /// Returns the pipeline of a source and entry point, compiled on first use.
    pub fn pipeline(
        &self,
        source: String,
        entry: &str,
        compile: impl FnOnce(&str) -> ComputePipeline,
    ) -> ComputePipeline {
        let key = (source, entry.to_owned());
        // Compiled outside of the lock: another thread may need a pipeline that is there.
        if let Some(known) = lock(&self.pipelines).get(&key) {
            return known.clone();
        }
        let pipeline = compile(&key.0);
        self.counters.pipelines.fetch_add(1, Ordering::Relaxed);
        lock(&self.pipelines).entry(key).or_insert(pipeline).clone()
    }

    /// Takes a buffer for reading `size` bytes back, an idle one of that size where there is one.
    pub fn take_read_back(&self, device: &Device, size: u64) -> Buffer {
        let idle = {
            let mut idle = lock(&self.read_backs);
            let found = idle.iter().position(|buffer| buffer.size() == size);
            found.map(|index| idle.remove(index))
        };
        idle.unwrap_or_else(|| {
            self.counters.read_backs.fetch_add(1, Ordering::Relaxed);
            device.create_buffer(&BufferDescriptor {
                label: Some("read back"),
                size,
                usage: BufferUsages::MAP_READ | BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        })
    }

    /// Returns an unmapped buffer; the longest idle one makes room.
    pub fn give_read_back(&self, buffer: Buffer) {
        let mut idle = lock(&self.read_backs);
        if idle.len() >= IDLE_READ_BACKS {
            idle.remove(0);
        }
        idle.push(buffer);
    }

    pub fn objects(&self) -> GpuObjects {
        self.counters.read()
    }
}

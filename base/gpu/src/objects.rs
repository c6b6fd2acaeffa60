//! Counts of created GPU objects.

use std::sync::atomic::{AtomicU64, Ordering};

/// Numbers of GPU objects created since the device was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GpuObjects {
    /// Compiled compute pipelines.
    pub pipelines: u64,
    /// Storage buffers.
    pub storage_buffers: u64,
    /// Staging buffers of read-backs.
    pub read_backs: u64,
    /// Staging buffers of constants and images.
    pub uploads: u64,
    /// Bind groups of compute kernels.
    pub bind_groups: u64,
}

/// Counters of [`GpuObjects`].
#[derive(Debug, Default)]
pub(crate) struct Counters {
    pub pipelines: AtomicU64,
    pub storage_buffers: AtomicU64,
    pub read_backs: AtomicU64,
    pub uploads: AtomicU64,
    pub bind_groups: AtomicU64,
}

impl Counters {
    /// Returns the numbers so far.
    pub fn read(&self) -> GpuObjects {
        let get = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let Self { pipelines, storage_buffers, read_backs, uploads, bind_groups } = self;
        GpuObjects {
            pipelines: get(pipelines),
            storage_buffers: get(storage_buffers),
            read_backs: get(read_backs),
            uploads: get(uploads),
            bind_groups: get(bind_groups),
        }
    }
}

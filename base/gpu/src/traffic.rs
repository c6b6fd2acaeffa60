//! Counts of the device's work and of data transfers.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::GpuContext;

/// Work and data transfers of the device since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GpuTraffic {
    /// Dispatches of compute kernels.
    pub dispatches: u64,
    /// Waits of the processor for the device.
    pub waits: u64,
    /// Bytes of arrays copied to the device.
    pub uploaded_bytes: u64,
    /// Bytes read back from the device.
    pub read_bytes: u64,
}

impl GpuTraffic {
    /// Returns the difference from an earlier count.
    #[must_use]
    pub fn since(self, earlier: Self) -> Self {
        Self {
            dispatches: self.dispatches.saturating_sub(earlier.dispatches),
            waits: self.waits.saturating_sub(earlier.waits),
            uploaded_bytes: self.uploaded_bytes.saturating_sub(earlier.uploaded_bytes),
            read_bytes: self.read_bytes.saturating_sub(earlier.read_bytes),
        }
    }
}

/// Counters of [`GpuTraffic`].
#[derive(Debug, Default)]
pub(crate) struct TrafficCounters {
    dispatches: AtomicU64,
    waits: AtomicU64,
    uploaded_bytes: AtomicU64,
    read_bytes: AtomicU64,
}

impl TrafficCounters {
    pub fn dispatch(&self) {
        self.dispatches.fetch_add(1, Ordering::Relaxed);
    }

    pub fn wait(&self) {
        self.waits.fetch_add(1, Ordering::Relaxed);
    }

    pub fn upload(&self, bytes: usize) {
        self.uploaded_bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    pub fn read_back(&self, bytes: u64) {
        self.read_bytes.fetch_add(bytes, Ordering::Relaxed);
    }
}

impl GpuContext {
    /// Returns the counts so far of all clones of this context, a simulator on the same device included. All are 0 where kernels run on
    /// the processor.
    #[must_use]
    pub fn traffic(&self) -> GpuTraffic {
        if self.is_on_processor() {
            return GpuTraffic::default();
        }
        let get = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let TrafficCounters { dispatches, waits, uploaded_bytes, read_bytes } = &self.shared.traffic;
        GpuTraffic {
            dispatches: get(dispatches),
            waits: get(waits),
            uploaded_bytes: get(uploaded_bytes),
            read_bytes: get(read_bytes),
        }
    }

    /// Adds a dispatch to [`Self::traffic`].
    pub fn count_dispatch(&self) {
        self.shared.traffic.dispatch();
    }
}

//! Counts of the work given to the device, and of the data that goes to it and comes back.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::GpuContext;

/// Work given to the device, and data copied to it and back, since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GpuTraffic {
    /// Dispatches of compute kernels.
    pub dispatches: u64,
    /// Waits of the processor for the device.
    pub waits: u64,
    /// Bytes of arrays copied to the device.
    pub uploaded_bytes: u64,
    /// Bytes read back from it.
    pub read_bytes: u64,
}

impl GpuTraffic {
    /// Returns what has been added since an earlier count.
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

/// [`GpuTraffic`] while it is counted.
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
    /// Returns the counts so far, of all clones of this context: a simulator that draws on the same device counts as well. All are 0
    /// where kernels run on the processor.
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

    /// Counts a dispatch for [`Self::traffic`].
    pub fn count_dispatch(&self) {
        self.shared.traffic.dispatch();
    }
}

//! Run times of compute passes on the GPU.

use std::time::Duration;

use wgpu::{
    Buffer, BufferUsages, CommandEncoder, ComputePassTimestampWrites, Features, QuerySet, QuerySetDescriptor, QueryType,
};

use crate::{GpuContext, GpuError, read_back};

/// Run time of one named stage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StageTime {
    /// Name given to [`GpuTimer::stage`].
    pub name: &'static str,
    /// Time from begin to end.
    pub time: Duration,
}

/// Timestamp queries around compute passes. Measures nothing on an adapter without them.
#[derive(Debug)]
pub struct GpuTimer {
    queries: Option<(QuerySet, Buffer)>,
    names: Vec<&'static str>,
    capacity: u32,
    period_nanos: f32,
}

impl GpuTimer {
    /// Creates a timer for `capacity` stages per frame.
    #[must_use]
    pub fn new(gpu: &GpuContext, capacity: u32) -> Self {
        let queries = gpu.device.features().contains(Features::TIMESTAMP_QUERY).then(|| {
            let set = gpu.device.create_query_set(&QuerySetDescriptor {
                label: Some("stage times"),
                ty: QueryType::Timestamp,
                count: capacity * 2,
            });
            let resolved = gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("stage times"),
                size: u64::from(capacity) * 16,
                usage: BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            });
            (set, resolved)
        });
        Self { queries, names: Vec::new(), capacity, period_nanos: gpu.queue.get_timestamp_period() }
    }

    /// Returns the timestamp writes of the next compute pass; stages beyond the capacity are not measured.
    pub fn stage(&mut self, name: &'static str) -> Option<ComputePassTimestampWrites<'_>> {
        let index = self.names.len() as u32;
        let (set, _) = self.queries.as_ref()?;
        if index >= self.capacity {
            return None;
        }
        self.names.push(name);
        Some(ComputePassTimestampWrites {
            query_set: set,
            beginning_of_pass_write_index: Some(index * 2),
            end_of_pass_write_index: Some(index * 2 + 1),
        })
    }

    /// Records the resolution of the timestamps, after the last pass and before the submission.
    pub fn resolve(&self, encoder: &mut CommandEncoder) {
        if let (Some((set, resolved)), true) = (&self.queries, !self.names.is_empty()) {
            encoder.resolve_query_set(set, 0..self.names.len() as u32 * 2, resolved, 0);
        }
    }

    /// Waits for the GPU, returns the stages in order and starts over.
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn collect(&mut self, gpu: &GpuContext) -> Result<Vec<StageTime>, GpuError> {
        let names = std::mem::take(&mut self.names);
        let Some((_, resolved)) = &self.queries else { return Ok(Vec::new()) };
        let ticks: Vec<u64> = read_back(gpu, resolved, names.len() * 2)?;
        let period = f64::from(self.period_nanos);
        Ok(names
            .into_iter()
            .zip(ticks.chunks_exact(2))
            .map(|(name, t)| StageTime {
                name,
                time: Duration::from_nanos((t[1].saturating_sub(t[0]) as f64 * period) as u64),
            })
            .collect())
    }
}

//! Run times of a frame's stages on the GPU without a wait.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU8, Ordering},
    },
    time::Duration,
};

use wgpu::{
    Buffer, BufferDescriptor, BufferUsages, CommandEncoder, ComputePassDescriptor, ComputePassTimestampWrites,
    Features, MapMode, QuerySet, QuerySetDescriptor, QueryType,
};

use crate::{GpuContext, StageTime};

/// Frames whose timestamps may be under way at once; a frame beyond them is not measured.
const FRAMES: usize = 4;

const IDLE: u8 = 0;
const UNDER_WAY: u8 = 1;
const MAPPED: u8 = 2;

/// Timestamps between the stages of a frame, collected when they have arrived: nobody waits for the GPU to know how long
/// it took.
///
/// ```ignore
/// timer.begin(&mut encoder);                 // in the frame's first encoder
/// timer.mark(&mut encoder, "skinning");      // after the stage's last command, in the same or a later encoder
/// timer.mark(&mut encoder, "appearance");
/// timer.finish(&mut encoder);                // in the frame's last encoder, before it is submitted
/// gpu.queue.submit([encoder.finish()]);
/// for stage in timer.collect() { .. }        // frames whose timestamps arrived with an earlier wait or read-back
/// ```
///
/// A stage lasts from the mark before it, or from the frame's begin, to its own mark; the GPU's pauses between submissions
/// count. On an adapter without `TIMESTAMP_QUERY` nothing is measured ([`Self::is_supported`]).
#[derive(Debug)]
pub struct StageTimer {
    /// Empty where the adapter has no timestamps.
    frames: Vec<Frame>,
    /// Index of the frame that is being recorded.
    recorded: Option<usize>,
    marks: u32,
    period_nanos: f64,
}

#[derive(Debug)]
struct Frame {
    queries: QuerySet,
    resolved: Buffer,
    read_back: Buffer,
    /// Of its marks, after the begin.
    names: Vec<&'static str>,
    state: Arc<AtomicU8>,
    /// Order of the frames.
    number: u64,
}

impl StageTimer {
    /// Room for `stages` marks a frame; more are not measured. Nothing is where kernels run on the processor: its own clock
    /// measures them.
    #[must_use]
    pub fn new(gpu: &GpuContext, stages: u32) -> Self {
        let marks = stages + 1;
        let size = u64::from(marks) * 8;
        let buffer = |usage| {
            gpu.device.create_buffer(&BufferDescriptor {
                label: Some("stage times"),
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        let frame = |_| Frame {
            queries: gpu.device.create_query_set(&QuerySetDescriptor {
                label: Some("stage times"),
                ty: QueryType::Timestamp,
                count: marks,
            }),
            resolved: buffer(BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC),
            read_back: buffer(BufferUsages::MAP_READ | BufferUsages::COPY_DST),
            names: Vec::new(),
            state: Arc::default(),
            number: 0,
        };
        let can_measure = gpu.device.features().contains(Features::TIMESTAMP_QUERY) && !gpu.is_on_processor();
        let frames = if can_measure { FRAMES } else { 0 };
        Self {
            frames: (0..frames).map(frame).collect(),
            recorded: None,
            marks,
            period_nanos: gpu.queue.get_timestamp_period().into(),
        }
    }

    /// Whether the adapter can measure.
    #[must_use]
    pub fn is_supported(&self) -> bool {
        !self.frames.is_empty()
    }

    /// Records the begin of a frame. One that was begun and not finished is given up.
    pub fn begin(&mut self, encoder: &mut CommandEncoder) {
        let number = self.frames.iter().map(|frame| frame.number).max().unwrap_or(0) + 1;
        self.recorded = self.frames.iter().position(|frame| frame.state.load(Ordering::Acquire) == IDLE);
        if let Some(frame) = self.recorded.and_then(|index| self.frames.get_mut(index)) {
            frame.names.clear();
            frame.number = number;
            stamp(encoder, &frame.queries, 0);
        }
    }

    /// Records the end of a stage.
    pub fn mark(&mut self, encoder: &mut CommandEncoder, name: &'static str) {
        if let Some(frame) = self.recorded.and_then(|index| self.frames.get_mut(index)) {
            let index = frame.names.len() as u32 + 1;
            if index < self.marks {
                frame.names.push(name);
                stamp(encoder, &frame.queries, index);
            }
        }
    }

    /// Records that the frame's timestamps are read back when `encoder` has been executed. A frame whose encoder is dropped
    /// is not measured.
    pub fn finish(&mut self, encoder: &mut CommandEncoder) {
        let Some(frame) = self.recorded.take().and_then(|index| self.frames.get_mut(index)) else { return };
        let count = frame.names.len() as u32 + 1;
        encoder.resolve_query_set(&frame.queries, 0..count, &frame.resolved, 0);
        encoder.copy_buffer_to_buffer(&frame.resolved, 0, &frame.read_back, 0, u64::from(count) * 8);
        frame.state.store(UNDER_WAY, Ordering::Release);
        let arrival = Arrival(Arc::clone(&frame.state));
        encoder.map_buffer_on_submit(&frame.read_back, MapMode::Read, .., move |mapped| {
            if mapped.is_ok() {
                arrival.0.store(MAPPED, Ordering::Release);
            }
        });
    }

    /// Returns the stages of the frames that have arrived since the last call, oldest frame first. Never waits: what is
    /// still under way comes with a later call, after any wait or read-back on this device.
    pub fn collect(&mut self) -> Vec<StageTime> {
        let mut arrived: Vec<&mut Frame> =
            self.frames.iter_mut().filter(|frame| frame.state.load(Ordering::Acquire) == MAPPED).collect();
        arrived.sort_by_key(|frame| frame.number);
        let mut stages = Vec::new();
        for frame in arrived {
            let bytes = (frame.names.len() as u64 + 1) * 8;
            if let Ok(view) = frame.read_back.get_mapped_range(..bytes) {
                let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&view[..]);
                stages.extend(frame.names.iter().zip(ticks.windows(2)).map(|(name, t)| StageTime {
                    name,
                    time: Duration::from_nanos((t[1].saturating_sub(t[0]) as f64 * self.period_nanos) as u64),
                }));
            }
            frame.read_back.unmap();
            frame.state.store(IDLE, Ordering::Release);
        }
        stages
    }
}

/// The callback of a frame under way. Dropped without success, it makes the frame idle.
#[derive(Debug)]
struct Arrival(Arc<AtomicU8>);

impl Drop for Arrival {
    fn drop(&mut self) {
        let _ = self.0.compare_exchange(UNDER_WAY, IDLE, Ordering::AcqRel, Ordering::Acquire);
    }
}

/// Writes a timestamp when everything recorded before is done. A pass without a dispatch needs no feature beyond
/// `TIMESTAMP_QUERY`.
fn stamp(encoder: &mut CommandEncoder, queries: &QuerySet, index: u32) {
    let timestamp_writes = ComputePassTimestampWrites {
        query_set: queries,
        beginning_of_pass_write_index: None,
        end_of_pass_write_index: Some(index),
    };
    drop(encoder.begin_compute_pass(&ComputePassDescriptor {
        label: Some("timestamp"),
        timestamp_writes: Some(timestamp_writes),
    }));
}

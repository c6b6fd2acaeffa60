//! Run times of a frame's stages on the GPU, without waits.

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

/// Frames whose timestamps may be pending at once; further frames are not measured.
const FRAMES: usize = 4;

const IDLE: u8 = 0;
const UNDER_WAY: u8 = 1;
const MAPPED: u8 = 2;

/// Timestamps between the stages of a frame, collected after they have arrived, so that nothing waits for the GPU.
///
/// ```no_run
/// # use flyrig_gpu::{AdapterChoice, GpuContext, StageTimer};
/// # let gpu = GpuContext::new(&AdapterChoice::Best)?;
/// let mut timer = StageTimer::new(&gpu, 2);
/// let mut encoder = gpu.device.create_command_encoder(&Default::default());
/// timer.begin(&mut encoder); // in the frame's first encoder
/// timer.mark(&mut encoder, "skinning"); // after the stage's last command, in this or a later encoder
/// timer.mark(&mut encoder, "appearance");
/// timer.finish(&mut encoder); // in the frame's last encoder, before it is submitted
/// gpu.queue.submit([encoder.finish()]);
/// for stage in timer.collect() {
///     println!("{} {:?}", stage.name, stage.time); // frames whose timestamps arrived with an earlier wait or read-back
/// }
/// # Ok::<(), flyrig_gpu::GpuError>(())
/// ```
///
/// A stage lasts from the previous mark, or from the frame's begin, to its own mark, pauses of the GPU between submissions included.
/// On an adapter without `TIMESTAMP_QUERY` nothing is measured ([`Self::is_supported`]).
#[derive(Debug)]
pub struct StageTimer {
    /// Pending and idle frames; empty where the adapter has no timestamps.
    frames: Vec<Frame>,
    /// Index of the frame being recorded.
    recorded: Option<usize>,
    marks: u32,
    period_nanos: f64,
}

#[derive(Debug)]
struct Frame {
    queries: QuerySet,
    resolved: Buffer,
    read_back: Buffer,
    /// Names of the frame's marks.
    names: Vec<&'static str>,
    state: Arc<AtomicU8>,
    /// Sequence number of the frame.
    number: u64,
}

impl StageTimer {
    /// Creates a timer for `stages` marks per frame; further marks are not measured. Measures nothing where kernels run on the
    /// processor, whose own clock serves.
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

    /// Returns whether the adapter has timestamps.
    #[must_use]
    pub fn is_supported(&self) -> bool {
        !self.frames.is_empty()
    }

    /// Records the begin of a frame. An unfinished frame is discarded.
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

    /// Records the read-back of the frame's timestamps, which takes place once `encoder` was executed. A frame whose encoder is
    /// dropped is not measured.
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

    /// Returns the stages of the frames that have arrived since the last call, oldest frame first. Never waits: pending frames follow
    /// with a later call, after any wait or read-back on this device.
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

/// Callback of a pending frame. Dropped without success, it makes the frame idle.
#[derive(Debug)]
struct Arrival(Arc<AtomicU8>);

impl Drop for Arrival {
    fn drop(&mut self) {
        let _ = self.0.compare_exchange(UNDER_WAY, IDLE, Ordering::AcqRel, Ordering::Acquire);
    }
}

/// Records a timestamp after all earlier commands, by a pass without a dispatch, which needs no feature beyond `TIMESTAMP_QUERY`.
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

//! Run times of an update's stages: by the adapter's timestamps where it has them, else by waiting after each stage.

use std::time::Instant;

use flyrig_gpu::{GpuContext, StageTimer};
use wgpu::CommandEncoder;

use crate::{error::FusionError, health::stage_times::StageTimes};

/// Stage of an update, in the order of execution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TimedStage {
    Skinning,
    Visibility,
    Appearance,
}

impl TimedStage {
    const COUNT: u32 = 3;

    fn name(self) -> &'static str {
        match self {
            Self::Skinning => "skinning",
            Self::Visibility => "visibility",
            Self::Appearance => "appearance",
        }
    }
}

/// Timer of the [`TimedStage`]s.
#[derive(Debug)]
pub(super) struct StageClock {
    timer: StageTimer,
}

impl StageClock {
    pub fn new(gpu: &GpuContext) -> Self {
        Self { timer: StageTimer::new(gpu, TimedStage::COUNT) }
    }

    /// Returns whether the adapter measures the stages itself, so that nothing needs to wait for them.
    pub fn is_supported(&self) -> bool {
        self.timer.is_supported()
    }

    /// Marks the start of the first stage.
    pub fn begin(&mut self, encoder: &mut CommandEncoder) {
        self.timer.begin(encoder);
    }

    /// Marks the end of a stage on the adapter.
    pub fn mark(&mut self, encoder: &mut CommandEncoder, stage: TimedStage) {
        self.timer.mark(encoder, stage.name());
    }

    /// Marks the end of the last stage.
    pub fn finish(&mut self, encoder: &mut CommandEncoder) {
        self.timer.finish(encoder);
    }

    /// Waits for a stage that began at `start` and adds its time, where the adapter measures none.
    pub fn wait(
        &self,
        gpu: &GpuContext,
        stage: TimedStage,
        start: Instant,
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        if !self.is_supported() {
            gpu.wait()?;
            stages.add(stage.name(), start.elapsed());
        }
        Ok(())
    }

    /// Adds the adapter's times of updates that were waited for.
    pub fn collect(&mut self, stages: &mut StageTimes) {
        for stage in self.timer.collect() {
            stages.add_of_adapter(stage.name, stage.time);
        }
    }
}

//! From camera threads to frame sets.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use anyhow::Result;
use flyrig_calib::{ClockAligner, ClockKind, SyncConfig, Synchronizer};
use flyrig_capture::{CameraSource, CaptureErrorKind, CaptureThreads, Pacing, PopError, ThreadsConfig};
use flyrig_types::{CameraId, FrameSet};

/// Frames a camera that may wait for the pipeline: enough to bridge a slow frame, few enough to stay live.
const WAITING_FRAMES_A_CAMERA: usize = 4;

/// Camera threads, their queue and the synchronizer.
pub struct Intake {
    threads: CaptureThreads,
    /// Only for cameras with clocks of their own.
    aligner: Option<ClockAligner>,
    sync: Synchronizer,
    ready: VecDeque<FrameSet>,
    cameras: Vec<CameraId>,
    every_set: bool,
    skipped_sets: u64,
    ended: bool,
}

impl Intake {
    /// Starts a thread a camera. With [`Pacing::Lossless`] every set comes, in order; else the newest one wins.
    pub fn start(
        sources: Vec<Box<dyn CameraSource>>,
        sync: &SyncConfig,
        clocks: ClockKind,
        pacing: Pacing,
    ) -> Result<Self> {
        let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
        let queue_capacity = WAITING_FRAMES_A_CAMERA * cameras.len().max(1);
        Ok(Self {
            threads: CaptureThreads::start(sources, ThreadsConfig { queue_capacity, pacing })?,
            aligner: (clocks == ClockKind::Triggered).then(|| ClockAligner::new(&cameras, sync.master.as_ref())),
            sync: Synchronizer::new(&cameras, sync),
            ready: VecDeque::new(),
            cameras,
            every_set: pacing == Pacing::Lossless,
            skipped_sets: 0,
            ended: false,
        })
    }

    /// The next frame set, or `None` when none came in time or all cameras have ended (see [`Self::ended`]).
    pub fn next_set(&mut self, timeout: Duration) -> Option<FrameSet> {
        let deadline = Instant::now() + timeout;
        loop {
            // A live rig takes all that waits first, so that the newest set is known.
            let enough = |ready: &VecDeque<FrameSet>| self.every_set && !ready.is_empty();
            let mut wait = Duration::ZERO;
            while !enough(&self.ready) && !self.ended {
                match self.threads.queue().pop(wait) {
                    Ok(frame) => {
                        let frame = match &mut self.aligner {
                            Some(aligner) => aligner.align(frame),
                            None => frame,
                        };
                        self.ready.extend(self.sync.push(frame));
                        wait = Duration::ZERO;
                    }
                    Err(PopError::Closed) => {
                        self.ended = true;
                        self.ready.extend(self.sync.flush());
                    }
                    Err(PopError::Timeout) => {
                        wait = deadline.saturating_duration_since(Instant::now());
                        if !self.ready.is_empty() || wait.is_zero() {
                            break;
                        }
                    }
                }
            }
            if !self.every_set && self.ready.len() > 1 {
                self.skipped_sets += self.ready.len() as u64 - 1;
                self.ready.drain(..self.ready.len() - 1);
            }
            if self.ended || !self.ready.is_empty() || Instant::now() >= deadline {
                return self.ready.pop_front();
            }
        }
    }

    /// Whether every camera has ended and every set was taken.
    pub fn ended(&self) -> bool {
        self.ended && self.ready.is_empty()
    }

    /// What was lost on the way in, by place.
    pub fn drops(&self) -> Vec<(String, u64)> {
        let counts = self.sync.counts();
        let mut drops = vec![
            ("sets older than the newest".to_owned(), self.skipped_sets),
            ("sets without a camera".to_owned(), counts.partial),
        ];
        let in_no_set = self.cameras.iter().zip(&counts.dropped_frames);
        drops.extend(in_no_set.map(|(camera, dropped)| (format!("frames of {camera} in no set"), dropped.total())));
        for camera in self.threads.stats() {
            drops.push((format!("frames of {} waiting too long", camera.camera), camera.dropped));
            let errors = camera.errors.iter().filter(|(kind, _)| **kind != CaptureErrorKind::Timeout);
            drops.push((format!("errors of {}", camera.camera), errors.map(|(_, count)| count).sum()));
            drops.push((format!("frames of {} lost before us", camera.camera), camera.health.lost_by_driver));
        }
        drops
    }
}

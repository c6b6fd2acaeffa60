//! Live frame sets: camera threads, their queue and the synchroniser.

use std::{
    collections::{HashMap, VecDeque},
    time::{Duration, Instant},
};

use flyrig_calib::WatchState;
use flyrig_capture::{
    CameraSource, CaptureError, CaptureThreads, Decoding, FrameStage, Pacing, PopError, SourceOpener, ThreadsConfig,
    monotonic_nanos,
};
use flyrig_sync::{ClockAligner, ClockKind, ClockState, DropCounts, SyncSettings, Synchronizer};
use flyrig_types::{CameraId, Frame, FrameSet, Rig};

use crate::{CameraHealth, FusionError, Health, health::STUCK_AFTER};

/// Frames a camera that may wait for the pipeline: enough to bridge a slow frame, few enough to stay live.
const WAITING_FRAMES_A_CAMERA: usize = 4;

/// Images that the cameras send.
#[derive(Debug, Clone, Copy)]
pub enum InputFormat<'a> {
    /// RGB: there is nothing to decode.
    Rgb,
    /// Any format, of the calibrated sizes; others are refused.
    OfRig(&'a Rig),
    /// Any format and size.
    AnySize,
}

/// Camera threads, their queue and the synchroniser: the source of a live session's frame sets.
#[derive(Debug)]
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
    /// By slot.
    timing: Vec<Timing>,
    /// Whether capture times are of this computer's clock.
    is_live: bool,
}

/// Means over about the last hundred frames of a camera.
#[derive(Debug, Clone, Copy, Default)]
struct Timing {
    last_nanos: Option<i64>,
    frames: f64,
    interval_ms: f64,
    /// Mean square of the distance from the mean interval.
    variance: f64,
    lateness_ms: f64,
    arrived: Option<Instant>,
}

impl Timing {
    const MEMORY: f64 = 100.0;

    fn add(&mut self, capture_nanos: i64, now_nanos: i64) {
        self.arrived = Some(Instant::now());
        if let Some(last) = self.last_nanos.replace(capture_nanos) {
            self.frames = (self.frames + 1.0).min(Self::MEMORY);
            let interval = capture_nanos.saturating_sub(last) as f64 * 1e-6;
            let off = interval - self.interval_ms;
            self.interval_ms += off / self.frames;
            self.variance += (off * off * (1.0 - 1.0 / self.frames) - self.variance) / self.frames;
            self.lateness_ms +=
                (now_nanos.saturating_sub(capture_nanos) as f64 * 1e-6 - self.lateness_ms) / self.frames;
        }
    }
}

impl Intake {
    /// Starts the threads of sources that are open already; see [`Self::start_opening`].
    ///
    /// # Errors
    /// As [`Self::start_opening`].
    pub fn start(
        sources: Vec<Box<dyn CameraSource>>,
        format: InputFormat<'_>,
        sync: &SyncSettings,
        pacing: Pacing,
    ) -> Result<Self, FusionError> {
        Self::start_opening(sources.into_iter().map(SourceOpener::ready).collect(), format, sync, pacing)
    }

    /// Starts a thread a camera, and another one each that makes RGB of its images where they are not. With
    /// [`Pacing::Lossless`] every set comes, in order; else the newest one wins. A live camera that cannot be opened yet
    /// joins later; meanwhile sets come without it.
    ///
    /// # Errors
    /// [`FusionError::Capture`] when two cameras have one name or the system gives no thread; with another pacing than
    /// [`Pacing::AsDelivered`] also when a source cannot be opened.
    pub fn start_opening(
        openers: Vec<SourceOpener>,
        format: InputFormat<'_>,
        sync: &SyncSettings,
        pacing: Pacing,
    ) -> Result<Self, FusionError> {
        let cameras: Vec<CameraId> = openers.iter().map(|opener| opener.camera().clone()).collect();
        let queue_capacity = WAITING_FRAMES_A_CAMERA * cameras.len().max(1);
        let config = ThreadsConfig { queue_capacity, pacing };
        let sizes: HashMap<CameraId, _> = match format {
            InputFormat::OfRig(rig) => rig.cameras.iter().map(|known| (known.id.clone(), known.size())).collect(),
            InputFormat::AnySize | InputFormat::Rgb => HashMap::new(),
        };
        let decoding =
            move |camera: &CameraId| Box::new(Decoding::new(sizes.get(camera).copied())) as Box<dyn FrameStage>;
        let threads = match format {
            InputFormat::Rgb => CaptureThreads::start_opening(openers, config)?,
            InputFormat::OfRig(_) | InputFormat::AnySize => {
                CaptureThreads::start_opening_staged(openers, decoding, config)?
            }
        };
        Ok(Self {
            threads,
            aligner: (sync.clocks == ClockKind::Triggered).then(|| ClockAligner::new(&cameras, sync.master.as_ref())),
            sync: Synchronizer::new(&cameras, sync),
            ready: VecDeque::new(),
            cameras,
            every_set: pacing == Pacing::Lossless,
            skipped_sets: 0,
            ended: false,
            timing: Vec::new(),
            is_live: false,
        })
    }

    /// The next frame set, or `None` when none came in time or all cameras have ended (see [`Self::ended`]).
    pub fn next_set(&mut self, timeout: Duration) -> Option<FrameSet> {
        let deadline = Instant::now() + timeout;
        loop {
            // A live rig takes all that waits first, so that the newest set is known.
            let every_set = self.every_set;
            let enough = |ready: &VecDeque<FrameSet>| every_set && !ready.is_empty();
            let mut wait = Duration::ZERO;
            while !enough(&self.ready) && !self.ended {
                match self.threads.queue().pop(wait) {
                    Ok(frame) => {
                        self.time(&frame);
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

    /// Declares that capture times are of this computer's clock, so that latency is measured.
    #[must_use]
    pub fn live(self) -> Self {
        Self { is_live: true, ..self }
    }

    fn time(&mut self, frame: &Frame) {
        self.timing.resize(self.cameras.len(), Timing::default());
        if let Some(slot) = self.cameras.iter().position(|camera| *camera == frame.camera) {
            self.timing[slot].add(frame.capture_nanos, monotonic_nanos());
        }
    }

    /// The last error of a camera.
    #[must_use]
    pub fn last_error(&self, slot: usize) -> Option<CaptureError> {
        self.threads.stats().into_iter().nth(slot).and_then(|stats| stats.last_error)
    }

    /// Reports the health of the cameras and sets; stages and memory are left empty.
    #[must_use]
    pub fn health(&self) -> Health {
        let counts = self.sync.counts();
        let clocks: Vec<ClockState> =
            self.aligner.iter().flat_map(|aligner| aligner.clocks().map(|(_, clock)| clock)).collect();
        let cameras = self.threads.stats().into_iter().enumerate().map(|(slot, stats)| {
            let timing = self.timing.get(slot).copied().unwrap_or_default();
            CameraHealth {
                stats,
                in_no_set: counts.dropped_frames.get(slot).map_or(0, DropCounts::total),
                interval_ms: timing.interval_ms,
                jitter_ms: timing.variance.max(0.0).sqrt(),
                lateness_ms: self.is_live.then_some(timing.lateness_ms),
                quiet_s: timing.arrived.map(|at| at.elapsed().as_secs_f64()),
                clock: clocks.get(slot).copied(),
                watch: WatchState::Unknown,
            }
        });
        Health {
            cameras: cameras.collect(),
            stuck: self.threads.stuck(STUCK_AFTER),
            threads: Vec::new(),
            complete_sets: counts.complete,
            partial_sets: counts.partial,
            skipped_sets: self.skipped_sets,
            stages: Vec::new(),
            budget: None,
            device_faults: 0,
            resident_mib: None,
        }
    }

    /// Whether every camera has ended and every set was taken.
    #[must_use]
    pub fn ended(&self) -> bool {
        self.ended && self.ready.is_empty()
    }

    /// Counts the frames and sets that were lost before the session, by place.
    #[must_use]
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
            drops.push((format!("frames of {} overtaken before their decoding", camera.camera), camera.overtaken));
            if let Some(network) = camera.health.network {
                for (place, count) in [
                    ("left on the camera's computer", network.overtaken_before),
                    ("lost on the way", network.lost_on_the_way),
                    ("overtaken when they had come", network.overtaken_here),
                    ("refused", network.refused),
                    ("before its clock was known", network.before_clock),
                ] {
                    drops.push((format!("frames of {} {place}", camera.camera), count));
                }
            }
            drops.push((format!("errors of {}", camera.camera), camera.errors.values().sum()));
            drops.push((format!("frames of {} lost before us", camera.camera), camera.health.lost_by_driver));
        }
        drops
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_jitter_and_lateness_are_means() {
        let mut timing = Timing::default();
        for n in 0..1000i64 {
            let capture = n * 33_000_000 + if n % 2 == 0 { 1_000_000 } else { 0 };
            timing.add(capture, capture + 7_000_000);
        }
        assert!((timing.interval_ms - 33.0).abs() < 0.1, "{timing:?}");
        // Intervals are 32 and 34 in turn.
        assert!((timing.variance.sqrt() - 1.0).abs() < 0.1, "{timing:?}");
        assert!((timing.lateness_ms - 7.0).abs() < 1e-6, "{timing:?}");
        timing.add(i64::MIN, i64::MAX);
        timing.add(i64::MAX, i64::MIN);
        assert!(timing.variance.is_finite());
    }
}

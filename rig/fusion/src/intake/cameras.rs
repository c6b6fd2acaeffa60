//! Live frame sets: camera threads, their queue and the synchroniser.
//!
//! `capture::CaptureThreads` read and decode every camera into one bounded queue, which drops the oldest frame and counts it.
//! `sync::Synchronizer` forms a [`FrameSet`] of the frames nearest to the master's time. Each frame keeps its own time.

use std::{
    collections::{HashMap, VecDeque},
    time::{Duration, Instant},
};

use flyrig_calib::WatchState;
use flyrig_capture::{
    CameraSource, CameraStats, CaptureError, CaptureThreads, Decoding, FrameStage, Pacing, PopError, SourceOpener,
    ThreadsConfig, monotonic_nanos,
};
use flyrig_sync::{ClockAligner, ClockKind, ClockState, DropCounts, SyncSettings, Synchronizer};
use flyrig_types::{CameraId, Frame, FrameSet, Rig};

use super::timing::Timing;
use crate::{
    error::FusionError,
    health::snapshot::{CameraHealth, Health, STUCK_AFTER},
};

/// Frames per camera that may wait for the pipeline: enough to bridge a slow frame set, few enough to stay live.
const WAITING_FRAMES_A_CAMERA: usize = 4;

/// Format of the images that the cameras send.
#[derive(Debug, Clone, Copy)]
pub enum InputFormat<'a> {
    /// RGB, which needs no decoding.
    Rgb,
    /// Any format, in the calibrated sizes; others are rejected.
    OfRig(&'a Rig),
    /// Any format and size.
    AnySize,
}

/// Source of a live session's frame sets: camera threads, their queue and the synchroniser.
#[derive(Debug)]
pub struct Intake {
    threads: CaptureThreads,
    /// Aligner of the cameras' own clocks, where they have any.
    aligner: Option<ClockAligner>,
    sync: Synchronizer,
    ready: VecDeque<FrameSet>,
    cameras: Vec<CameraId>,
    every_set: bool,
    skipped_sets: u64,
    ended: bool,
    /// Timing of each camera, one element per slot.
    timing: Vec<Timing>,
    /// Whether capture times are on this computer's clock.
    is_live: bool,
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

    /// Starts one thread per camera, and another one per camera whose images need decoding. With [`Pacing::Lossless`] every frame set
    /// comes, in order; else the newest one wins. A live camera that cannot be opened yet joins later; meanwhile frame sets come without
    /// it.
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

    /// Waits for the next frame set. Returns `None` when none came in time or all cameras have ended (see [`Self::ended`]).
    pub fn next_set(&mut self, timeout: Duration) -> Option<FrameSet> {
        let deadline = flyrig_types::deadline_after(timeout);
        loop {
            self.ingest_waiting(deadline);
            if !self.every_set && self.ready.len() > 1 {
                self.skipped_sets += self.ready.len() as u64 - 1;
                self.ready.drain(..self.ready.len() - 1);
            }
            if self.ended || !self.ready.is_empty() || Instant::now() >= deadline {
                return self.ready.pop_front();
            }
        }
    }

    /// Ingests frames until a frame set is ready or the deadline has passed. A live rig ingests all waiting frames, so that the newest frame
    /// set is known.
    fn ingest_waiting(&mut self, deadline: Instant) {
        let mut wait = Duration::ZERO;
        while !(self.ended || self.every_set && !self.ready.is_empty()) {
            match self.threads.queue().pop(wait) {
                Ok(frame) => {
                    let now_nanos = monotonic_nanos();
                    self.time(&frame, now_nanos);
                    let frame = match &mut self.aligner {
                        Some(aligner) => aligner.align(frame),
                        None => frame,
                    };
                    self.ready.extend(self.sync.push_at(frame, now_nanos));
                    wait = Duration::ZERO;
                }
                Err(PopError::Closed) => {
                    self.ended = true;
                    self.ready.extend(self.sync.flush());
                }
                Err(PopError::Timeout) => {
                    let overdue = self.give_up();
                    wait = deadline.saturating_duration_since(Instant::now());
                    if !self.ready.is_empty() || wait.is_zero() {
                        break;
                    }
                    wait = overdue.map_or(wait, |overdue| wait.min(overdue));
                }
            }
        }
    }

    /// Forms the live frame sets whose missing frames would have arrived by now. Returns the time until that is so for the next one; `None`
    /// where only a frame completes it.
    fn give_up(&mut self) -> Option<Duration> {
        if self.every_set {
            return None;
        }
        let now_nanos = monotonic_nanos();
        self.ready.extend(self.sync.give_up(now_nanos));
        let left = self.sync.next_deadline()?.saturating_sub(now_nanos);
        Some(Duration::from_nanos(u64::try_from(left).unwrap_or(0)))
    }

    /// Declares that capture times are on this computer's clock, so that latency is measured.
    #[must_use]
    pub fn live(self) -> Self {
        Self { is_live: true, ..self }
    }

    /// Updates the timing of a frame's camera.
    fn time(&mut self, frame: &Frame, now_nanos: i64) {
        self.timing.resize(self.cameras.len(), Timing::default());
        if let Some(slot) = self.cameras.iter().position(|camera| *camera == frame.camera) {
            self.timing[slot].add(frame.capture_nanos, now_nanos);
        }
    }

    /// Returns the last error of a camera.
    #[must_use]
    pub fn last_error(&self, slot: usize) -> Option<CaptureError> {
        self.threads.stats().into_iter().nth(slot).and_then(|stats| stats.last_error)
    }

    /// Reports the health of cameras and frame sets; stages and memory are left empty.
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
            learning: None,
            device_faults: 0,
            resident_mib: None,
        }
    }

    /// Returns whether every camera has ended and every frame set was taken.
    #[must_use]
    pub fn ended(&self) -> bool {
        self.ended && self.ready.is_empty()
    }

    /// Counts the frames and frame sets that were lost before the session, by place.
    #[must_use]
    pub fn drops(&self) -> Vec<(String, u64)> {
        let counts = self.sync.counts();
        let mut drops = vec![
            ("sets older than the newest".to_owned(), self.skipped_sets),
            ("sets without a camera".to_owned(), counts.partial),
        ];
        let in_no_set = self.cameras.iter().zip(&counts.dropped_frames);
        drops.extend(in_no_set.map(|(camera, dropped)| (format!("frames of {camera} in no set"), dropped.total())));
        drops.extend(self.threads.stats().iter().flat_map(camera_drops));
        drops
    }
}

/// Counts the frames of one camera that were lost, by place.
fn camera_drops(camera: &CameraStats) -> Vec<(String, u64)> {
    let mut drops = vec![
        (format!("frames of {} waiting too long", camera.camera), camera.dropped),
        (format!("frames of {} overtaken before their decoding", camera.camera), camera.overtaken),
    ];
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
    drops
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Image, PixelFormat};

    use super::*;

    const PERIOD: Duration = Duration::from_millis(100);

    /// Camera that captures for two seconds at a time, each followed by a pause in which nothing comes.
    struct Paused {
        camera: CameraId,
        start: Instant,
        next: u32,
        /// Whether the last frame before each pause is lost.
        loses_last: bool,
    }

    impl CameraSource for Paused {
        fn camera(&self) -> &CameraId {
            &self.camera
        }

        fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
            let number = self.next;
            // Twenty frames of every sixty.
            let due = self.start + PERIOD * number;
            let wait = due.saturating_duration_since(Instant::now());
            std::thread::sleep(wait.min(timeout));
            let is_late = || CaptureError::new(&self.camera, flyrig_capture::CaptureErrorKind::Timeout, "not yet");
            if wait > timeout {
                return Err(is_late());
            }
            self.next += 1;
            let turn = number % 60;
            if turn >= 20 || turn == 19 && self.loses_last {
                return Err(is_late());
            }
            Ok(Frame {
                camera: self.camera.clone(),
                sequence: u64::from(number),
                capture_nanos: i64::from(number) * PERIOD.as_nanos() as i64,
                exposure_nanos: None,
                image: Image::new(1, 1, PixelFormat::Rgb8, vec![0; 3]).unwrap(),
                mask: None,
            })
        }
    }

    #[test]
    fn a_set_without_a_lost_frame_comes_before_any_later_frame() {
        let start = Instant::now();
        let source = |name: &str, loses_last: bool| {
            Box::new(Paused { camera: name.into(), start, next: 0, loses_last }) as Box<dyn CameraSource>
        };
        let sources = vec![source("a", false), source("b", true)];
        let mut intake =
            Intake::start(sources, InputFormat::Rgb, &SyncSettings::default(), Pacing::AsDelivered).unwrap();
        // On a busy machine frames arrive irregularly, and a set may wait for the frames after the pause.
        let is_early = (0..400).any(|_| {
            let set = intake.next_set(Duration::from_millis(500));
            let number = set.map(|set| set.master_nanos / PERIOD.as_nanos() as i64);
            number.is_some_and(|number| number % 60 == 19 && start.elapsed() < PERIOD * (number as u32 + 35))
        });
        assert!(is_early, "every set waited for the frames after its pause");
    }
}

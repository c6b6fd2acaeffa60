//! Observed rig: cameras, their threads and the synchronizer.

use std::time::{Duration, Instant};

use flyrig_capture::{
    CameraControls, CameraIdentity, CameraOptions, CameraSource, CameraStats, CaptureErrorKind, CaptureThreads,
    Decoding, FormatChoice, PopError, SourceHealth, ThreadsConfig, V4l2Camera, monotonic_nanos,
};
use flyrig_sync::{SyncSettings, Synchronizer};
use flyrig_types::SetKind;

use super::{bus, host::cpu_secs};

/// Returns the options of a camera of the test driver.
pub fn options(bus: &str) -> CameraOptions {
    CameraOptions {
        identity: CameraIdentity::Bus(bus.to_owned()),
        width: 640,
        height: 360,
        fps: super::FPS,
        format: FormatChoice::Yuyv,
        controls: CameraControls::default(),
        readout_secs: 0.0,
        lag_secs: 0.0,
        buffers: 6,
    }
}

/// Running rig of cameras.
pub struct Rig {
    cameras: usize,
    threads: CaptureThreads,
    sync: Synchronizer,
    seen: Vec<Seen>,
    last: Vec<Option<(Instant, i64)>>,
    started: Instant,
    first_stats: Vec<CameraStats>,
}

/// Observations of one camera.
#[derive(Clone)]
pub struct Seen {
    pub frames: u64,
    pub lost: u64,
    pub longest_gap_ms: f64,
    /// Number of frames whose timestamp is not later than the previous one.
    pub backwards: u64,
    pub health: SourceHealth,
    /// Exposure time of the last frame.
    pub exposure_nanos: Option<u64>,
    seconds: f64,
    last_frame: Option<Instant>,
    errors: Vec<(CaptureErrorKind, u64)>,
}

/// Observations of all cameras over an interval.
pub struct Watched {
    pub cameras: Vec<Seen>,
    pub complete: u64,
    pub partial: u64,
    pub cpu_percent: f64,
    latencies_ms: Vec<f64>,
}

/// Time in milliseconds until a condition held, or until the wait was given up.
#[derive(Clone, Copy)]
pub enum Share {
    After(f64),
    Never(f64),
}

impl Share {
    pub fn ms(self) -> f64 {
        match self {
            Self::After(ms) | Self::Never(ms) => ms,
        }
    }
}

impl Seen {
    fn new() -> Self {
        Self {
            frames: 0,
            lost: 0,
            longest_gap_ms: 0.0,
            backwards: 0,
            health: SourceHealth::default(),
            exposure_nanos: None,
            seconds: 0.0,
            last_frame: None,
            errors: Vec::new(),
        }
    }

    /// Returns the frame rate, frames per second.
    pub fn rate(&self) -> f64 {
        self.frames as f64 / self.seconds.max(1e-9)
    }

    /// Reports whether frames arrived without errors and long gaps. Single lost frames are allowed: a slow machine loses some.
    pub fn is_sound(&self) -> bool {
        self.errors.is_empty() && self.longest_gap_ms < 500.0 && self.frames > 0
    }

    pub fn errors_of(&self, kind: CaptureErrorKind) -> u64 {
        self.errors.iter().filter(|(found, _)| *found == kind).map(|(_, count)| count).sum()
    }

    /// Returns the fraction of the driver's frames that were lost.
    pub fn lost_share(&self) -> f64 {
        self.lost as f64 / (self.lost + self.frames).max(1) as f64
    }

    /// Returns the milliseconds since the last frame.
    pub fn silent_ms(&self) -> f64 {
        self.last_frame.map_or(f64::INFINITY, |at| at.elapsed().as_secs_f64() * 1e3)
    }
}

impl Watched {
    pub fn frames(&self) -> u64 {
        self.cameras.iter().map(|camera| camera.frames).sum()
    }

    pub fn errors(&self) -> u64 {
        self.cameras.iter().flat_map(|camera| &camera.errors).map(|(_, count)| count).sum()
    }

    /// Returns the quantile `share` of the latency from capture to frame set, milliseconds.
    pub fn latency_ms(&self, share: f64) -> f64 {
        let mut sorted = self.latencies_ms.clone();
        sorted.sort_by(f64::total_cmp);
        let last = sorted.len().saturating_sub(1);
        sorted.get((last as f64 * share).round() as usize).copied().unwrap_or(f64::NAN)
    }
}

impl Rig {
    /// Opens the first `cameras` cameras of the test driver.
    pub fn start(cameras: usize) -> Self {
        Self::start_with(&(0..cameras).map(|camera| options(&bus(camera))).collect::<Vec<_>>())
    }

    /// Opens cameras; a failure ends the program, since nothing can be tested then.
    pub fn start_with(wanted: &[CameraOptions]) -> Self {
        let mut sources: Vec<Box<dyn CameraSource>> = Vec::new();
        for (camera, options) in wanted.iter().enumerate() {
            let name = format!("{camera:02}");
            match V4l2Camera::open(&name.as_str().into(), options) {
                Ok(source) => sources.push(Box::new(source)),
                Err(error) => {
                    println!("BROKEN: cannot start: {error}");
                    std::process::exit(1);
                }
            }
        }
        Self::of(sources)
    }

    /// Starts a rig of open cameras with the names 00, 01 and so on.
    pub fn of(sources: Vec<Box<dyn CameraSource>>) -> Self {
        let cameras = sources.len();
        let ids: Vec<_> = sources.iter().map(|source| source.camera().clone()).collect();
        let config = ThreadsConfig { queue_capacity: 4 * cameras, ..ThreadsConfig::default() };
        let threads = match CaptureThreads::start_staged(sources, |_| Box::new(Decoding::new(None)), config) {
            Ok(threads) => threads,
            Err(error) => {
                println!("BROKEN: cannot start: {error}");
                std::process::exit(1);
            }
        };
        let first_stats = threads.stats();
        Self {
            cameras,
            threads,
            sync: Synchronizer::new(&ids, &SyncSettings::default()),
            seen: vec![Seen::new(); cameras],
            last: vec![None; cameras],
            started: Instant::now(),
            first_stats,
        }
    }

    /// Closes the rig and opens it again with the same number of cameras.
    pub fn restarted(self) -> Self {
        let cameras = self.cameras;
        drop(self);
        Self::start(cameras)
    }

    /// Runs for `duration` and returns the observations of that interval alone.
    pub fn watch(&mut self, duration: Duration) -> Watched {
        self.seen = vec![Seen::new(); self.cameras];
        self.started = Instant::now();
        self.first_stats = self.threads.stats();
        let (mut complete, mut partial, mut latencies_ms) = (0, 0, Vec::new());
        let cpu = cpu_secs();
        let deadline = Instant::now() + duration;
        while let Some(left) = deadline.checked_duration_since(Instant::now()) {
            for set in self.step(left.min(Duration::from_millis(50))) {
                match set.kind() {
                    SetKind::Complete => complete += 1,
                    SetKind::Partial => partial += 1,
                }
                latencies_ms.push((monotonic_nanos() - set.master_nanos) as f64 / 1e6);
            }
        }
        let cpu_percent = 100.0 * (cpu_secs() - cpu) / duration.as_secs_f64();
        Watched { complete, partial, cpu_percent, latencies_ms, cameras: self.summary() }
    }

    /// Runs until the condition holds, for `most` at the longest. It gets frames since this call, and errors and health since the
    /// start.
    pub fn until(&mut self, most: Duration, is_so: impl Fn(&[Seen]) -> bool) -> Share {
        let start = Instant::now();
        for seen in &mut self.seen {
            seen.frames = 0;
        }
        while start.elapsed() < most {
            self.step(Duration::from_millis(10));
            if is_so(&self.now()) {
                return Share::After(start.elapsed().as_secs_f64() * 1e3);
            }
        }
        Share::Never(start.elapsed().as_secs_f64() * 1e3)
    }

    fn step(&mut self, wait: Duration) -> Vec<flyrig_types::FrameSet> {
        let frame = match self.threads.queue().pop(wait) {
            Ok(frame) => frame,
            Err(PopError::Timeout | PopError::Closed) => return Vec::new(),
        };
        let slot: usize = frame.camera.as_str().parse().unwrap_or(0);
        let (now, seen) = (Instant::now(), &mut self.seen[slot]);
        seen.frames += 1;
        seen.exposure_nanos = frame.exposure_nanos;
        seen.last_frame = Some(now);
        if let Some((before, nanos)) = self.last[slot] {
            let gap = now.duration_since(before.max(self.started)).as_secs_f64() * 1e3;
            seen.longest_gap_ms = seen.longest_gap_ms.max(gap);
            seen.backwards += u64::from(frame.capture_nanos <= nanos);
        }
        self.last[slot] = Some((now, frame.capture_nanos));
        self.sync.push(frame)
    }

    /// Summarizes the observations since the interval began.
    fn summary(&self) -> Vec<Seen> {
        let seconds = self.started.elapsed().as_secs_f64();
        let now = self.threads.stats();
        let rows = self.seen.iter().zip(&now).zip(&self.first_stats).zip(&self.last);
        rows.map(|(((seen, now), first), last)| {
            let errors = now.errors.iter().filter_map(|(&kind, &count)| {
                let fresh = count - first.errors.get(&kind).copied().unwrap_or(0);
                (fresh > 0).then_some((kind, fresh))
            });
            let health = SourceHealth {
                lost_by_driver: now.health.lost_by_driver - first.health.lost_by_driver,
                reconnects: now.health.reconnects - first.health.reconnects,
                silences: now.health.silences - first.health.silences,
                stamps_replaced: now.health.stamps_replaced - first.health.stamps_replaced,
                mode: now.health.mode.clone(),
                network: None,
            };
            // The gap that has not ended counts too.
            let open_gap = last.map_or(0.0, |(at, _)| at.max(self.started).elapsed().as_secs_f64() * 1e3);
            Seen {
                errors: errors.collect(),
                lost: health.lost_by_driver,
                health,
                seconds,
                longest_gap_ms: seen.longest_gap_ms.max(open_gap),
                ..seen.clone()
            }
        })
        .collect()
    }

    /// Returns [`Self::summary`] with errors and health since the threads started.
    pub fn now(&self) -> Vec<Seen> {
        let stats = self.threads.stats();
        let with = |(seen, stats): (&Seen, CameraStats)| Seen {
            errors: stats.errors.into_iter().collect(),
            health: stats.health,
            ..seen.clone()
        };
        self.seen.iter().zip(stats).map(with).collect()
    }
}

//! Health of a running command: once per second to the metrics page, the terminal's table and the service manager.
//!
//! The service manager's watchdog is fed by steps of the pipeline; while a session is built, by the growing number of GPU objects; and not
//! at all while a thread is stuck.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    sync::mpsc::{RecvTimeoutError, sync_channel},
    thread::Builder,
    time::{Duration, Instant, SystemTime},
};

use anyhow::{Result, anyhow};
use flyrig_access::KeyEnds;
use flyrig_calib::WatchState;
use flyrig_capture::{CameraStats, CaptureThreads, Recorded};
use flyrig_fusion::{CameraHealth, Health, STUCK_AFTER, resident_mib};
use flyrig_gpu::GpuContext;
use flyrig_types::CameraId;

use crate::{
    image_origin::ImageOrigin,
    metrics_text::{self, KeyDays},
    page_server::PageServer,
    rate_watch::RateWatch,
    table,
};

/// Time from one report to the next.
const EVERY: Duration = Duration::from_secs(1);
/// Time from one look at the ends of keys to the next.
const KEYS_EVERY: Duration = Duration::from_secs(60);

/// Reporter of a command's health, from its start to its end. Every loop of the command calls [`Self::report`].
///
/// # Example
/// ```
/// use flyrig_fusion::Health;
/// use flyrig_monitor::Monitor;
///
/// // No metrics page, no table: only the log and the service manager.
/// let mut monitor = Monitor::start("", false)?;
/// Monitor::ready();
/// for _ in 0..3 {
///     monitor.stepped();
///     monitor.report(|| (Health::default(), None));
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Monitor {
    metrics: Option<PageServer>,
    show_table: bool,
    /// Time of the last report.
    reported: Option<Instant>,
    watchdog: Watchdog,
    /// Restarts of each thread, and whether it is stuck, as logged last.
    logged: BTreeMap<String, (u64, bool)>,
    /// Cameras that were reported as silent.
    silent: BTreeSet<CameraId>,
    origin: ImageOrigin,
    rates: RateWatch,
    /// Status that the service manager has.
    status: String,
    /// Folder of the rig's keys; empty without keys.
    keys: PathBuf,
    /// Time of the last look at the ends of keys, and what it found.
    key_days: Option<(Instant, KeyDays)>,
}

impl Monitor {
    /// Starts the metrics page where there is an address for it, and publishes the state of a command that is starting.
    ///
    /// # Errors
    /// Names the address when it cannot be listened on.
    pub fn start(listen: &str, show_table: bool) -> Result<Self> {
        let metrics = if listen.is_empty() {
            None
        } else {
            Some(PageServer::start("health.listen", listen, metrics_text::KIND)?)
        };
        if let Some(metrics) = &metrics {
            eprintln!("metrics at http://{}/metrics", metrics.address());
            let health = Health { resident_mib: resident_mib(), ..Health::default() };
            metrics.publish(metrics_text::prometheus(&health, None, KeyDays::default()));
        }
        let (reported, watchdog, logged, silent, origin, rates, status, keys, key_days) = Default::default();
        Ok(Self { metrics, show_table, reported, watchdog, logged, silent, origin, rates, status, keys, key_days })
    }

    /// Sets where the images come from, which decides the advice on silent cameras and stuck threads.
    #[must_use]
    pub fn with_origin(mut self, origin: ImageOrigin) -> Self {
        self.origin = origin;
        self
    }

    /// Shows when the keys in this folder end, if it is not empty.
    #[must_use]
    pub fn with_keys(mut self, folder: &Path) -> Self {
        folder.clone_into(&mut self.keys);
        self
    }

    /// Tells the service manager that the service is up. The watchdog is in force from here on.
    pub fn ready() {
        notify("READY=1");
    }

    /// Notes that the pipeline made a step: a frame set was processed.
    pub fn stepped(&mut self) {
        self.watchdog.stepped = true;
    }

    /// Runs work that makes no steps, such as building a session, and feeds the watchdog whenever the number of GPU objects has changed. Work
    /// that hangs does not feed it.
    pub fn during<T>(&mut self, gpu: &GpuContext, work: impl FnOnce() -> T) -> T {
        let done = during(EVERY, || gpu.objects(), || notify("WATCHDOG=1"), work);
        self.stepped();
        done
    }

    /// Reports the health, at most once per second. `snapshot` returns it, with the state of a recording where there is one.
    pub fn report(&mut self, snapshot: impl FnOnce() -> (Health, Option<Recorded>)) {
        if self.reported.is_some_and(|at| at.elapsed() < EVERY) {
            return;
        }
        // After a long step frames wait to be taken, and their cameras are not to blame.
        let was_busy = self.reported.is_some_and(|at| at.elapsed() > 2 * EVERY);
        self.reported = Some(Instant::now());
        let (health, recorded) = snapshot();
        self.log(&health, was_busy);
        let (feeds, status) = self.watchdog.assess(&health);
        if feeds {
            notify("WATCHDOG=1");
        }
        if status != self.status {
            notify(&format!("STATUS={status}"));
            self.status = status;
        }
        let keys = self.key_days();
        if let Some(metrics) = &self.metrics {
            metrics.publish(metrics_text::prometheus(&health, recorded.as_ref(), keys));
        }
        if self.show_table {
            // Clears the terminal first.
            eprint!("\x1b[2J\x1b[H{}", table::table(&health, recorded.as_ref()));
        }
    }

    /// Returns the days until keys end, at most a minute old.
    fn key_days(&mut self) -> KeyDays {
        if self.metrics.is_none() || self.keys.as_os_str().is_empty() {
            return KeyDays::default();
        }
        match self.key_days {
            Some((at, days)) if at.elapsed() < KEYS_EVERY => days,
            _ => {
                let days = key_days(&self.keys, SystemTime::now());
                self.key_days = Some((Instant::now(), days));
                days
            }
        }
    }

    /// Logs changes: silent cameras, restarts, and threads that are stuck or work again.
    fn log(&mut self, health: &Health, was_busy: bool) {
        for camera in &health.cameras {
            let name = &camera.stats.camera;
            match table::silence_s(camera) {
                Some(seconds) if !was_busy && self.silent.insert(name.clone()) => tracing::warn!(
                    "camera {name}: no frame for {seconds:.0} s, and no error either; {}",
                    self.origin.silence_advice()
                ),
                None if self.silent.remove(name) => tracing::info!("camera {name}: frames come again"),
                _ => {}
            }
        }
        for change in self.rates.changes(health) {
            change.log();
        }
        for (thread, restarts) in table::thread_restarts(health) {
            let logged = self.logged.entry(thread.clone()).or_default();
            if restarts > logged.0 {
                tracing::warn!("thread '{thread}' was restarted, {restarts} times so far");
            }
            logged.0 = restarts;
        }
        let seconds = STUCK_AFTER.as_secs();
        for thread in &health.stuck {
            if !std::mem::replace(&mut self.logged.entry(thread.clone()).or_default().1, true) {
                tracing::error!("thread '{thread}' made no turn for {seconds} s; {}", self.origin.stuck_advice());
            }
        }
        for (thread, (_, is_stuck)) in &mut self.logged {
            if *is_stuck && !health.stuck.contains(thread) {
                tracing::info!("thread '{thread}' works again");
                *is_stuck = false;
            }
        }
    }
}

impl Drop for Monitor {
    fn drop(&mut self) {
        notify("STOPPING=1");
    }
}

/// Returns the days from `now` until keys end; unknown where the folder cannot be read, which the gate reports.
fn key_days(folder: &Path, now: SystemTime) -> KeyDays {
    let days = |end: SystemTime| match end.duration_since(now) {
        Ok(left) => left.as_secs_f64() / 86_400.0,
        Err(past) => -past.duration().as_secs_f64() / 86_400.0,
    };
    KeyEnds::read(folder, now).map_or(KeyDays::default(), |ends| KeyDays {
        next_key: ends.next_key.map(|(_, end)| days(end)),
        certificate: Some(days(ends.certificate)),
    })
}

/// Decision whether the service manager's watchdog is fed: by progress, not by time.
#[derive(Debug, Default)]
struct Watchdog {
    /// Whether the pipeline has made a step since the watchdog was last fed.
    stepped: bool,
}

impl Watchdog {
    /// Returns whether to feed the watchdog now, and the state in words.
    fn assess(&mut self, health: &Health) -> (bool, String) {
        let ours = |thread: &&String| !thread.starts_with("open ");
        let stuck: Vec<&str> = health.stuck.iter().filter(ours).map(String::as_str).collect();
        if !stuck.is_empty() {
            return (false, format!("stuck: {}", stuck.join(", ")));
        }
        let up = health.cameras.iter().filter(|camera| camera.is_up()).count();
        if up == 0 {
            let stats: Vec<&CameraStats> = health.cameras.iter().map(|camera| &camera.stats).collect();
            return (true, format!("no camera delivers frames{}", last_errors(&stats)));
        }
        let status = format!("{up} of {} cameras deliver frames", health.cameras.len());
        (std::mem::take(&mut self.stepped), status)
    }
}

/// Runs `work`, and meanwhile calls `feed` whenever `progress` has changed within `every`.
fn during<P: PartialEq + Send, T>(
    every: Duration,
    progress: impl Fn() -> P + Send,
    feed: impl Fn() + Send,
    work: impl FnOnce() -> T,
) -> T {
    std::thread::scope(|scope| {
        // Dropped at the end of the work, or by its panic.
        let (_working, is_over) = sync_channel::<()>(0);
        let mut last = progress();
        let watch = move || {
            while is_over.recv_timeout(every) == Err(RecvTimeoutError::Timeout) {
                let now = progress();
                if now != last {
                    feed();
                    last = now;
                }
            }
        };
        if let Err(error) = Builder::new().name("progress".to_owned()).spawn_scoped(scope, watch) {
            tracing::warn!("the watchdog is not fed for a while, since the system starts no thread: {error}");
        }
        work()
    })
}

/// Sends a state to the service manager, where there is one. A service manager that does not listen must not hold up the rig.
#[cfg(target_os = "linux")]
fn notify(state: &str) {
    if let Err(error) = sd_notify::notify(&[sd_notify::NotifyState::Custom(&state.replace('\n', " "))]) {
        tracing::debug!("{state} did not reach the service manager: {error}");
    }
}

/// Does nothing: only Linux has systemd.
#[cfg(not(target_os = "linux"))]
fn notify(_state: &str) {}

/// Returns the error of a live rig that ended without a request.
#[must_use]
pub fn ended_by_itself(cameras: &[CameraStats]) -> anyhow::Error {
    let all: Vec<&CameraStats> = cameras.iter().collect();
    anyhow!("all cameras have ended{}", last_errors(&all))
}

/// Formats the cameras' last errors, after a colon; empty without any.
fn last_errors(cameras: &[&CameraStats]) -> String {
    let errors: Vec<String> =
        cameras.iter().filter_map(|camera| camera.last_error.as_ref()).map(ToString::to_string).collect();
    if errors.is_empty() { String::new() } else { format!(": {}", errors.join("; ")) }
}

/// Arrival of each camera's last frame, for commands without a [`flyrig_fusion::Intake`].
pub struct Arrivals(Vec<(CameraId, Option<Instant>)>);

impl Arrivals {
    /// Creates the state before any frame.
    pub fn new(cameras: &[CameraId]) -> Self {
        Self(cameras.iter().map(|camera| (camera.clone(), None)).collect())
    }

    /// Notes the arrival of a camera's frame.
    pub fn add(&mut self, camera: &CameraId) {
        if let Some((_, at)) = self.0.iter_mut().find(|(known, _)| known == camera) {
            *at = Some(Instant::now());
        }
    }

    /// Returns whether a camera has delivered no frame for at least this time.
    pub fn is_silent(&self, camera: &CameraId, longer_than: Duration) -> bool {
        let at = self.0.iter().find(|(known, _)| known == camera).and_then(|(_, at)| *at);
        at.is_none_or(|at| at.elapsed() >= longer_than)
    }

    /// Returns the health of cameras whose frames form no frame sets.
    pub fn health(&self, threads: &CaptureThreads) -> Health {
        let camera = |(stats, (_, last)): (CameraStats, &(CameraId, Option<Instant>))| CameraHealth {
            stats,
            in_no_set: 0,
            interval_ms: 0.0,
            jitter_ms: 0.0,
            lateness_ms: None,
            quiet_s: last.map(|at| at.elapsed().as_secs_f64()),
            clock: None,
            watch: WatchState::Unknown,
        };
        Health {
            cameras: threads.stats().into_iter().zip(&self.0).map(camera).collect(),
            stuck: threads.stuck(STUCK_AFTER),
            resident_mib: resident_mib(),
            ..Health::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use flyrig_access::{Ring, Role};
    use flyrig_capture::{CaptureError, CaptureErrorKind};

    use super::*;
    use crate::table::tests::health;

    #[test]
    fn the_watchdog_is_fed_by_steps_alone_while_cameras_deliver() {
        let (mut watchdog, mut health) = (Watchdog::default(), health());
        assert!(!watchdog.assess(&health).0, "frames come and nothing is made of them");
        watchdog.stepped = true;
        assert_eq!(watchdog.assess(&health), (true, "1 of 1 cameras deliver frames".to_owned()));
        assert!(!watchdog.assess(&health).0, "one step feeds once");
        watchdog.stepped = true;
        health.stuck = vec!["open left".to_owned()];
        assert!(watchdog.assess(&health).0, "opening a camera may take any time");
        watchdog.stepped = true;
        health.stuck.push("stage left".to_owned());
        assert_eq!(watchdog.assess(&health), (false, "stuck: stage left".to_owned()));
    }

    #[test]
    fn days_until_keys_end_are_those_of_the_next_key_and_of_the_certificate() {
        let folder = tempfile::tempdir().unwrap();
        let keys = folder.path().join("keys");
        assert_eq!(key_days(&keys, SystemTime::now()), KeyDays::default());
        let mut ring = Ring::create(&keys, "studio", &["rig.local".to_owned()], 7450).unwrap();
        ring.add("long", Role::Viewer, 300).unwrap();
        ring.add("desk", Role::Viewer, 40).unwrap();
        let at = |days: u64| key_days(&keys, SystemTime::now() + Duration::from_secs(days * 86_400));
        let near = |found: Option<f64>, days: f64| found.is_some_and(|found| (found - days).abs() < 0.01);
        assert!(near(at(10).next_key, 30.0) && near(at(10).certificate, 3640.0), "{:?}", at(10));
        assert!(near(at(50).next_key, 250.0), "{:?}", at(50));
        assert!(at(301).next_key.is_none() && near(at(3651).certificate, -1.0), "{:?}", at(3651));
        let mut monitor = Monitor::start("127.0.0.1:0", false).unwrap().with_keys(&keys);
        assert!(near(monitor.key_days().next_key, 40.0), "{:?}", monitor.key_days());
    }

    #[test]
    fn a_rig_without_any_camera_is_alive_and_says_so() {
        let (mut watchdog, mut health) = (Watchdog::default(), health());
        health.cameras[0].quiet_s = None;
        let error = CaptureError::new(&"left".into(), CaptureErrorKind::NotFound, "is not plugged in");
        health.cameras[0].stats.last_error = Some(error);
        let expected = "no camera delivers frames: camera left: is not plugged in";
        assert_eq!(watchdog.assess(&health), (true, expected.to_owned()));
        let ended = ended_by_itself(&[health.cameras[0].stats.clone()]).to_string();
        assert_eq!(ended, "all cameras have ended: camera left: is not plugged in");
    }

    #[test]
    fn work_that_goes_on_is_fed_for_and_work_that_hangs_is_not() {
        use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
        let (progress, fed, every) = (AtomicU64::new(0), AtomicU64::new(0), Duration::from_millis(5));
        let feed = || {
            fed.fetch_add(1, SeqCst);
        };
        let wait = |count| {
            while fed.load(SeqCst) < count {
                std::thread::sleep(every);
            }
        };
        let done = during(
            every,
            || progress.load(SeqCst),
            feed,
            || {
                for step in 1..=3 {
                    progress.store(step, SeqCst);
                    wait(step);
                }
                std::thread::sleep(20 * every);
                "done"
            },
        );
        assert_eq!((done, fed.load(SeqCst)), ("done", 3), "once for each step, and not while it hung");
    }
}

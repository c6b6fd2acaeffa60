//! Health of a rig, as a snapshot.

use std::time::Duration;

use flyrig_calib::WatchState;
use flyrig_capture::CameraStats;
use flyrig_sync::ClockState;
use flyrig_transport::BudgetStats;
use flyrig_types::ThreadHealth;

use crate::{FusionError, StageSummary};

/// A camera whose last frame is older than this, or than five intervals, is down, seconds.
const UP_WITHIN_S: f64 = 5.0;
/// A thread of a camera without a turn for so long is stuck.
pub const STUCK_AFTER: Duration = Duration::from_secs(10);

/// Health of one camera.
#[derive(Debug, Clone)]
pub struct CameraHealth {
    /// Counts of its threads and source.
    pub stats: CameraStats,
    /// Frames that came into no set.
    pub in_no_set: u64,
    /// Mean interval between capture times, milliseconds.
    pub interval_ms: f64,
    /// Standard deviation of that interval, milliseconds.
    pub jitter_ms: f64,
    /// Latency from capture to synchroniser, milliseconds; known for cameras of this computer.
    pub lateness_ms: Option<f64>,
    /// Time since the last frame, seconds; `None` before the first.
    pub quiet_s: Option<f64>,
    /// State of the camera's own clock, where it has one.
    pub clock: Option<ClockState>,
    /// Whether it still stands as calibrated; unknown without a [`crate::RigWatch`].
    pub watch: WatchState,
}

impl CameraHealth {
    /// Whether frames come.
    #[must_use]
    pub fn is_up(&self) -> bool {
        self.stats.running && self.quiet_s.is_some_and(|quiet| quiet < (5e-3 * self.interval_ms).max(UP_WITHIN_S))
    }
}

/// Health of a rig.
#[derive(Debug, Clone, Default)]
pub struct Health {
    /// One element a camera.
    pub cameras: Vec<CameraHealth>,
    /// Names of camera threads (`camera NAME`, `stage NAME`, `open NAME`) that hang in somebody else's code.
    pub stuck: Vec<String>,
    /// Threads that are restarted after a panic: `pipeline` and those that publish or compare clocks.
    pub threads: Vec<ThreadHealth>,
    /// Sets with a frame of every camera.
    pub complete_sets: u64,
    /// Sets without at least one camera.
    pub partial_sets: u64,
    /// Sets that were older than the newest when the pipeline could take one.
    pub skipped_sets: u64,
    /// Run times of the session's stages.
    pub stages: Vec<StageSummary>,
    /// Level of effort, where there is a budget.
    pub budget: Option<BudgetStats>,
    /// How often the graphics device was opened again after a fault.
    pub device_faults: u64,
    /// Resident memory of the process, MiB.
    pub resident_mib: Option<f64>,
}

/// Checks that every thread still does its work.
///
/// # Errors
/// [`FusionError::ThreadFailed`] for the first one that panicked too often.
pub fn check_threads(threads: impl IntoIterator<Item = ThreadHealth>) -> Result<(), FusionError> {
    match threads.into_iter().find(|thread| thread.has_failed) {
        Some(ThreadHealth { name, panic, .. }) => {
            Err(FusionError::ThreadFailed { name, panic: panic.unwrap_or_else(|| "?".to_owned()) })
        }
        None => Ok(()),
    }
}

//! Snapshot of a rig's health: cameras, threads, frame sets, stages and memory.

use std::time::Duration;

use flyrig_calib::WatchState;
use flyrig_capture::CameraStats;
use flyrig_sync::ClockState;
use flyrig_transport::{BudgetStats, LearningStats};
use flyrig_types::ThreadHealth;

use super::stage_times::StageSummary;
use crate::error::FusionError;

/// Largest age of the last frame of a camera that is up, seconds; at least five intervals.
const UP_WITHIN_S: f64 = 5.0;
/// Time without a turn after which a camera's thread is stuck.
pub const STUCK_AFTER: Duration = Duration::from_secs(10);

/// Health of one camera.
#[derive(Debug, Clone)]
pub struct CameraHealth {
    /// Counts of its threads and source.
    pub stats: CameraStats,
    /// Number of frames that fitted into no frame set.
    pub in_no_set: u64,
    /// Mean interval between capture times, milliseconds.
    pub interval_ms: f64,
    /// Standard deviation of that interval, milliseconds.
    pub jitter_ms: f64,
    /// Latency from capture to synchroniser, milliseconds; `None` for cameras of other computers.
    pub lateness_ms: Option<f64>,
    /// Time since the last frame, seconds; `None` before the first.
    pub quiet_s: Option<f64>,
    /// State of the camera's own clock; `None` where it has none.
    pub clock: Option<ClockState>,
    /// Whether the camera still stands as calibrated; unknown without a [`crate::RigWatch`].
    pub watch: WatchState,
}

impl CameraHealth {
    /// Returns whether frames come.
    #[must_use]
    pub fn is_up(&self) -> bool {
        self.stats.running && self.quiet_s.is_some_and(|quiet| quiet < (5e-3 * self.interval_ms).max(UP_WITHIN_S))
    }
}

/// Health of a rig.
#[derive(Debug, Clone, Default)]
pub struct Health {
    /// Cameras, one element per slot.
    pub cameras: Vec<CameraHealth>,
    /// Names of camera threads (`camera NAME`, `stage NAME`, `open NAME`) that hang in a driver or library.
    pub stuck: Vec<String>,
    /// Threads that are restarted after a panic: `pipeline` and those that publish or compare clocks.
    pub threads: Vec<ThreadHealth>,
    /// Number of frame sets with a frame of every camera.
    pub complete_sets: u64,
    /// Number of frame sets that lack at least one camera.
    pub partial_sets: u64,
    /// Number of frame sets that were no longer the newest when the pipeline could take one.
    pub skipped_sets: u64,
    /// Run times of the session's stages.
    pub stages: Vec<StageSummary>,
    /// Level of effort; `None` without a budget.
    pub budget: Option<BudgetStats>,
    /// Progress of learning; `None` where no person is learnt.
    pub learning: Option<LearningStats>,
    /// Number of times that the graphics device was opened again after a fault.
    pub device_faults: u64,
    /// Resident memory of the process, MiB; `None` where the system does not report it.
    pub resident_mib: Option<f64>,
}

/// Checks that no thread has failed for good.
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

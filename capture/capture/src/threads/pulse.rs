//! Heartbeats of threads.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::{Duration, Instant},
};

/// Value in place of a time while no heartbeat is expected.
const RESTING: u64 = u64::MAX;

/// Heartbeat of one thread.
#[derive(Debug)]
pub(crate) struct Pulse {
    name: String,
    epoch: Instant,
    /// Nanoseconds since the epoch, or [`RESTING`].
    at: AtomicU64,
}

impl Pulse {
    /// Creates the heartbeat of a thread that rests until its first turn.
    pub fn new(name: String) -> Self {
        Self { name, epoch: Instant::now(), at: AtomicU64::new(RESTING) }
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// Marks the begin of a turn.
    pub fn beat(&self) {
        let nanos = u64::try_from(self.epoch.elapsed().as_nanos()).unwrap_or(RESTING - 1);
        self.at.store(nanos, Ordering::Relaxed);
    }

    /// Marks that the thread has ended, or waits for a reader that may take any time.
    pub fn rest(&self) {
        self.at.store(RESTING, Ordering::Relaxed);
    }

    /// Returns the time since the last turn began; `None` for a thread that rests.
    pub fn quiet(&self) -> Option<Duration> {
        match self.at.load(Ordering::Relaxed) {
            RESTING => None,
            nanos => Some(self.epoch.elapsed().saturating_sub(Duration::from_nanos(nanos))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resting_thread_is_never_quiet() {
        let pulse = Pulse::new("camera a".to_owned());
        assert_eq!((pulse.name(), pulse.quiet()), ("camera a", None));
        pulse.beat();
        std::thread::sleep(Duration::from_millis(5));
        assert!(pulse.quiet().unwrap() >= Duration::from_millis(5));
        pulse.rest();
        assert_eq!(pulse.quiet(), None);
    }
}

//! Rate limit for restarts of failed work.

use std::time::{Duration, Instant};

/// Restarts in a row without a long pause, each of work that lasted for less than [`WINDOW`].
const AT_ONCE: u32 = 5;
/// Pause between further restarts.
const WINDOW: Duration = Duration::from_secs(60);
/// Shortest pause between a failure and the restart.
const PAUSE: Duration = Duration::from_millis(100);

/// Rate limit for the restarts of one source or thread, so that one that always fails keeps neither a core nor a bus busy.
/// Five restarts follow each other at once, then one per minute. Callers that cannot wait so long give up once the restarts are
/// [exhausted](Self::are_exhausted).
///
/// ```
/// use std::time::{Duration, Instant};
///
/// let mut restarts = flyrig_types::Restarts::default();
/// let failed = Instant::now();
/// assert_eq!(restarts.after_failure(failed), failed + Duration::from_millis(100));
/// assert!(!restarts.are_exhausted());
/// ```
#[derive(Debug, Default)]
pub struct Restarts {
    last: Option<Instant>,
    in_a_row: u32,
}

impl Restarts {
    /// Returns the time at which work that has failed `now` may be restarted, and counts that restart.
    pub fn after_failure(&mut self, now: Instant) -> Instant {
        if self.last.is_some_and(|last| now.saturating_duration_since(last) >= WINDOW) {
            self.in_a_row = 0;
        }
        self.in_a_row = self.in_a_row.saturating_add(1);
        let due = match self.last {
            Some(last) if self.in_a_row > AT_ONCE => (last + WINDOW).max(now + PAUSE),
            _ => now + PAUSE,
        };
        self.last = Some(due);
        due
    }

    /// Returns whether the latest restart is beyond those that may follow each other at once.
    #[must_use]
    pub fn are_exhausted(&self) -> bool {
        self.in_a_row > AT_ONCE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fails_at_once_gets_five_restarts_and_then_one_a_minute() {
        let (start, mut restarts) = (Instant::now(), Restarts::default());
        let mut now = start;
        let mut times = Vec::new();
        for count in 1..=8 {
            now = restarts.after_failure(now);
            times.push((now - start).as_millis());
            assert_eq!(restarts.are_exhausted(), count > 5);
        }
        assert_eq!(times, [100, 200, 300, 400, 500, 60_500, 120_500, 180_500]);
        // One that has worked for a minute starts over.
        now = restarts.after_failure(now + WINDOW);
        assert_eq!((now - start).as_millis(), 240_600);
        assert!(!restarts.are_exhausted());
        assert_eq!(restarts.after_failure(now) - now, PAUSE);
    }
}

//! Age of a frame set when it has been published, by the rig's own clock.

use std::time::{Duration, Instant};

use flyrig_capture::monotonic_nanos;

/// Name of the age among the stages.
pub(crate) const AGE: &str = "age when published";

/// Comparison of the cameras' clock with the rig's. The frame set that came soonest after its capture has age 0 at its arrival, so that an
/// age leaves out the least latency from the lens to here (exposure, transfer, decoding, joining).
#[derive(Debug)]
pub(crate) struct Ages {
    started: Instant,
    /// `CLOCK_MONOTONIC` at `started`, nanoseconds.
    started_nanos: i64,
    /// Least difference between a frame set's arrival, since the start, and its time, nanoseconds; `None` before the first.
    soonest: Option<i64>,
}

impl Ages {
    pub fn new() -> Self {
        Self { started: Instant::now(), started_nanos: monotonic_nanos(), soonest: None }
    }

    /// Notes the arrival of a frame set with this time.
    pub fn arrived(&mut self, master_nanos: i64) {
        let after = self.after(master_nanos);
        self.soonest = Some(self.soonest.map_or(after, |soonest| soonest.min(after)));
    }

    /// Returns the current age of a frame set; `None` before the first arrival.
    pub fn of(&self, master_nanos: i64) -> Option<Duration> {
        let age = self.after(master_nanos).saturating_sub(self.soonest?);
        Some(Duration::from_nanos(u64::try_from(age).unwrap_or(0)))
    }

    /// Returns `CLOCK_MONOTONIC` minus the cameras' clock, nanoseconds, from the frame set that came soonest; `None` before the first arrival.
    pub fn clock_offset_nanos(&self) -> Option<i64> {
        self.soonest.map(|soonest| self.started_nanos.saturating_add(soonest))
    }

    /// Returns the time since the start minus a frame set's time, nanoseconds.
    fn after(&self, master_nanos: i64) -> i64 {
        let elapsed = i64::try_from(self.started.elapsed().as_nanos()).unwrap_or(i64::MAX);
        elapsed.saturating_sub(master_nanos)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_set_that_came_soonest_is_the_measure() {
        let mut ages = Ages::new();
        assert_eq!(ages.of(0), None, "nothing has come");
        // An hour by the cameras' clock, whose zero is anywhere.
        let zero = 3_600_000_000_000;
        ages.arrived(zero);
        std::thread::sleep(Duration::from_millis(30));
        let age = ages.of(zero).unwrap_or_default();
        assert!(age >= Duration::from_millis(30), "{age:?}");
        let by_offset = monotonic_nanos() - (zero + ages.clock_offset_nanos().unwrap_or_default());
        // Between the two, however long the machine takes.
        let later = ages.of(zero).unwrap_or_default();
        let [age_nanos, later_nanos] = [age, later].map(|age| age.as_nanos() as i64);
        assert!((age_nanos - 1_000_000_000..later_nanos + 1_000_000_000).contains(&by_offset), "{by_offset} {age:?}");
        // This one took a second longer on its way than the first.
        ages.arrived(zero - 1_000_000_000);
        let late = ages.of(zero - 1_000_000_000).unwrap_or_default();
        assert!(late >= Duration::from_millis(1030), "{late:?}");
        assert_eq!(ages.of(i64::MAX), Some(Duration::ZERO), "a set of the future");
        assert!(ages.of(i64::MIN).is_some());
    }
}

//! Recent latencies of the frames of a camera.

use std::collections::VecDeque;

/// Frames whose arrival is remembered, and from which it is known.
const ARRIVALS: usize = 32;
const KNOWN_FROM: usize = 8;

/// Recent latencies of a camera's frames, nanoseconds: arrival by any clock minus capture time.
#[derive(Debug, Default)]
pub(crate) struct Arrivals(VecDeque<i64>);

impl Arrivals {
    /// Adds a frame's latency, nanoseconds.
    pub fn add(&mut self, latency_nanos: i64) {
        self.0.push_back(latency_nanos);
        if self.0.len() > ARRIVALS {
            self.0.pop_front();
        }
    }

    /// Returns the longest recent latency; `None` where frames arrive less regularly than they are stamped, or too few have come.
    pub fn longest(&self, period: u64) -> Option<i64> {
        let (least, most) = (self.0.iter().min()?, self.0.iter().max()?);
        (self.0.len() >= KNOWN_FROM && most.abs_diff(*least) < period).then_some(*most)
    }
}

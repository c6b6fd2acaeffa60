//! Rates, gaps and latencies of received messages.

use std::{collections::VecDeque, time::Instant};

use crate::header::Header;

/// Number of messages over which rates and latencies are computed.
const WINDOW: usize = 256;

/// Latencies of the last 256 messages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LatencyReport {
    /// Median, milliseconds.
    pub p50_millis: f64,
    /// 99th percentile, milliseconds.
    pub p99_millis: f64,
    /// Longest, milliseconds.
    pub max_millis: f64,
    /// Whether all came from this host; otherwise latencies include the offset between the hosts' clocks.
    pub is_exact: bool,
}

/// Statistics of one topic since the start.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TopicReport {
    /// Messages received.
    pub received: u64,
    /// Payload bytes.
    pub bytes: u64,
    /// Messages that were published but never arrived, by gaps of the sequence.
    pub missed: u64,
    /// Messages replaced by a newer one before they were read.
    pub replaced: u64,
    /// Messages dropped before they were read, because too many bytes waited over all topics.
    pub dropped: u64,
    /// Number of restarts of the sequence: the publisher restarted, or set the topic up again.
    pub restarts: u64,
    /// Messages per second, over the last 256.
    pub per_second: f64,
    /// Latency, once a message has arrived.
    pub latency: Option<LatencyReport>,
}

/// Collector of a [`TopicReport`].
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub totals: TopicReport,
    last: Option<(u64, u64)>,
    window: VecDeque<(Instant, i64, bool)>,
}

impl Tally {
    pub(crate) fn add(&mut self, header: &Header, bytes: usize, now: Instant, latency_nanos: i64, exact: bool) {
        self.totals.received += 1;
        self.totals.bytes += bytes as u64;
        match self.last {
            Some((publisher, sequence)) if publisher == header.publisher && header.sequence > sequence => {
                self.totals.missed = self.totals.missed.saturating_add(header.sequence - sequence - 1);
            }
            // Another publisher, or a sequence that does not grow: TCP preserves the order, so it restarted.
            Some(_) => {
                self.totals.restarts += 1;
                self.window.clear();
            }
            None => {}
        }
        self.last = Some((header.publisher, header.sequence));
        if self.window.len() == WINDOW {
            self.window.pop_front();
        }
        self.window.push_back((now, latency_nanos, exact));
    }

    pub(crate) fn report(&self) -> TopicReport {
        let mut report = self.totals.clone();
        if let (Some((first, ..)), Some((last, ..))) = (self.window.front(), self.window.back()) {
            let seconds = last.duration_since(*first).as_secs_f64();
            if seconds > 0.0 {
                report.per_second = (self.window.len() - 1) as f64 / seconds;
            }
        }
        let mut sorted: Vec<i64> = self.window.iter().map(|(_, nanos, _)| *nanos).collect();
        sorted.sort_unstable();
        let at = |share: f64| {
            let index = ((sorted.len().max(1) - 1) as f64 * share).round() as usize;
            sorted.get(index).map(|nanos| *nanos as f64 / 1e6)
        };
        if let (Some(p50_millis), Some(p99_millis), Some(max_millis)) = (at(0.5), at(0.99), at(1.0)) {
            let is_exact = self.window.iter().all(|(.., exact)| *exact);
            report.latency = Some(LatencyReport { p50_millis, p99_millis, max_millis, is_exact });
        }
        report
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::header::empty_header;

    #[test]
    fn gaps_restarts_rates_and_latencies_of_a_hand_made_stream() {
        let mut tally = Tally::default();
        let start = Instant::now();
        // Sequence 5, 6, 9 of publisher 1, then 0 of publisher 2: two missed, one restart.
        for (i, (publisher, sequence)) in [(1, 5), (1, 6), (1, 9)].into_iter().enumerate() {
            let header = Header { publisher, sequence, ..empty_header() };
            let now = start + Duration::from_millis(100 * i as u64);
            tally.add(&header, 10, now, 1_000_000 * (i as i64 + 1), true);
        }
        let report = tally.report();
        assert_eq!((report.received, report.missed, report.restarts, report.bytes), (3, 2, 0, 30));
        assert!((report.per_second - 10.0).abs() < 1e-9);
        let latency = report.latency.unwrap();
        assert!((latency.p50_millis - 2.0).abs() < 1e-9 && (latency.max_millis - 3.0).abs() < 1e-9 && latency.is_exact);

        tally.add(&Header { publisher: 2, sequence: 0, ..empty_header() }, 10, start, -5, false);
        let report = tally.report();
        assert_eq!((report.missed, report.restarts), (2, 1));
        assert!(!report.latency.unwrap().is_exact);
        assert_eq!(Tally::default().report(), TopicReport::default());
    }

    #[test]
    fn a_hostile_sequence_does_not_overflow() {
        let mut tally = Tally::default();
        for sequence in [0, u64::MAX, 0, u64::MAX] {
            tally.add(&Header { sequence, ..empty_header() }, 1, Instant::now(), i64::MIN, true);
        }
        assert_eq!(tally.report().missed, u64::MAX);
    }
}

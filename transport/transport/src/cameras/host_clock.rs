//! Offset and drift between the clocks of two computers, estimated from round trips.
//!
//! A query leaves at `t1` and its answer arrives at `t4` (local clock) with the remote clock's `t` in between. Half of the round trip bounds
//! the error of `t - (t1 + t4) / 2`, so quick exchanges are the most accurate: in every block of [`BLOCK`] exchanges only the quickest
//! counts (the minimum filter of NTP, RFC 5905, section 10), and a line fitted to those gives offset and drift.

use std::{collections::VecDeque, fmt, sync::Arc};

use flyrig_solve::{ClockLine, LineOptions, LineSample, fit_line};

/// Number of exchanges of which only the quickest counts.
const BLOCK: usize = 8;
/// Number of quickest exchanges that the line is fitted to, about two minutes.
const BLOCKS: usize = 64;
/// Prior of the drift between two computers, parts per million: few or slow exchanges estimate a larger drift from noise.
const USUAL_DRIFT_PPM: f64 = 100.0;
/// Number of exchanges before the first estimate.
const FIRST_ANSWER: usize = 3;
/// Largest drift between two computers, parts per million.
const MOST_DRIFT_PPM: f64 = 500.0;
/// Distance of an exchange from the line beyond its own error bound from which it is an outlier, nanoseconds; and the number of
/// consecutive agreeing outliers that make a step of the clock.
const SLACK: f64 = 2e6;
const CONFIRMATIONS: usize = 4;

/// Clock that stamps this computer's frames: `CLOCK_MONOTONIC`, nanoseconds.
#[derive(Clone)]
pub struct HostClock(Arc<dyn Fn() -> i64 + Send + Sync>);

impl HostClock {
    /// Wraps a function that reads the clock; it is called from several threads.
    #[must_use]
    pub fn new(now_nanos: impl Fn() -> i64 + Send + Sync + 'static) -> Self {
        Self(Arc::new(now_nanos))
    }

    /// Returns the current time, nanoseconds.
    #[must_use]
    pub fn now_nanos(&self) -> i64 {
        (self.0)()
    }
}

impl fmt::Debug for HostClock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("HostClock")
    }
}

/// Estimate of another computer's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockEstimate {
    /// Remote minus local clock at present, nanoseconds.
    pub offset_nanos: i64,
    /// Rate of the remote clock relative to the local one, parts per million; positive when it runs faster.
    pub drift_ppm: f64,
    /// Shortest recent round trip, nanoseconds; half of it bounds the error of the offset.
    pub round_trip_nanos: i64,
    /// Number of steps of the remote clock so far.
    pub steps: u64,
}

#[derive(Debug, Clone, Copy)]
struct Exchange {
    /// Midpoint of send and receive time, local clock.
    local: i64,
    /// Remote clock minus `local`.
    offset: i64,
    round_trip: i64,
}

/// Estimator of one clock.
#[derive(Debug, Default)]
pub(crate) struct ClockFit {
    block: Vec<Exchange>,
    best: VecDeque<Exchange>,
    outliers: Vec<Exchange>,
    /// Remote minus local clock over local time.
    line: Option<ClockLine>,
    round_trip: i64,
    steps: u64,
}

impl ClockFit {
    /// Ingests an exchange: local send time, remote time, local receive time.
    pub fn add(&mut self, asked: i64, answer: i64, answered: i64) {
        let round_trip = answered.saturating_sub(asked);
        if round_trip < 0 {
            return;
        }
        let local = asked.saturating_add(round_trip / 2);
        let Some(offset) = answer.checked_sub(local) else { return };
        let exchange = Exchange { local, offset, round_trip };
        if let Some(line) = &self.line {
            let off = offset.saturating_sub(line.offset_at(local)) as f64;
            if off.abs() > round_trip as f64 / 2.0 + SLACK {
                // Only outliers that agree with each other indicate a step.
                self.outliers.retain(|other| {
                    let apart = other.offset.saturating_sub(offset).unsigned_abs() as f64;
                    apart <= (other.round_trip.saturating_add(round_trip)) as f64 / 2.0 + SLACK
                });
                self.outliers.push(exchange);
                if self.outliers.len() < CONFIRMATIONS {
                    return;
                }
                // The clock was set, or its computer slept: earlier exchanges no longer apply.
                self.best.clear();
                self.block = std::mem::take(&mut self.outliers);
                self.steps += 1;
                self.line = None;
            } else {
                self.outliers.clear();
                self.block.push(exchange);
            }
        } else {
            self.block.push(exchange);
        }
        if self.block.len() >= BLOCK {
            self.best.extend(self.block.drain(..).min_by_key(|exchange| exchange.round_trip));
            if self.best.len() > BLOCKS {
                self.best.pop_front();
            }
        }
        if self.best.len() * BLOCK + self.block.len() >= FIRST_ANSWER {
            self.fit();
        }
    }

    fn fit(&mut self) {
        let current = self.block.iter().min_by_key(|exchange| exchange.round_trip);
        let all = || self.best.iter().chain(current);
        let Some(quickest) = all().min_by_key(|exchange| exchange.round_trip).copied() else { return };
        self.round_trip = quickest.round_trip;
        // The fit is centred on the quickest exchange; each is known to half of its round trip, the drift to its prior.
        let known = |exchange: &Exchange| exchange.round_trip.max(1000) as f64 / 2.0;
        let sample = |exchange: &Exchange| LineSample {
            time_nanos: exchange.local,
            offset_nanos: exchange.offset,
            weight: (known(&quickest) / known(exchange)).powi(2),
        };
        let samples: Vec<LineSample> = all().map(sample).collect();
        let options = LineOptions {
            drift_prior_secs: known(&quickest) * 1e-9 / (USUAL_DRIFT_PPM * 1e-6),
            max_drift: MOST_DRIFT_PPM * 1e-6,
            ..LineOptions::default()
        };
        let flat = ClockLine { anchor_nanos: quickest.local, offset_nanos: quickest.offset, drift: 0.0 };
        let fit = fit_line(&samples, flat.anchor_nanos, flat.offset_nanos, &options);
        self.line = Some(fit.map_or(flat, |fit| fit.line));
    }

    /// Returns the estimate at a local time; `None` before a few exchanges.
    pub fn estimate(&self, local_nanos: i64) -> Option<ClockEstimate> {
        let line = self.line?;
        Some(ClockEstimate {
            offset_nanos: line.offset_at(local_nanos),
            drift_ppm: line.drift * 1e6,
            round_trip_nanos: self.round_trip,
            steps: self.steps,
        })
    }

    /// Converts a remote time to the local clock.
    pub fn to_local(&self, remote_nanos: i64) -> Option<i64> {
        let line = self.line?;
        // The line takes local time; one more iteration would change the result by the drift squared.
        let local = remote_nanos.saturating_sub(line.offset_nanos);
        Some(remote_nanos.saturating_sub(line.offset_at(local)))
    }

    /// Returns whether queries should follow each other quickly.
    pub fn is_young(&self) -> bool {
        self.best.len() < 2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Generator of the same numbers on every machine, 0 to 1.
    struct Random(u64);

    impl Random {
        fn unit(&mut self) -> f64 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    struct Truth {
        offset: i64,
        drift: f64,
    }

    impl Truth {
        fn remote(&self, local: i64) -> i64 {
            local + self.offset + (self.drift * local as f64) as i64
        }
    }

    /// Adds an exchange over a wire of 200 us each way; every third one waits up to 20 ms more behind images, in one direction only.
    fn exchange(fit: &mut ClockFit, truth: &Truth, local: i64, random: &mut Random) {
        let mut way = || 200_000 + (random.unit() * 30_000.0) as i64;
        let (mut there, mut back) = (way(), way());
        if random.unit() < 0.33 {
            let late = (random.unit() * 20e6) as i64;
            if random.unit() < 0.8 { there += late } else { back += late }
        }
        fit.add(local, truth.remote(local + there), local + there + back);
    }

    #[test]
    fn offset_and_drift_come_out_of_a_crowded_wire() {
        for (offset, ppm) in [(0, 0.0), (7_200_000_000_123, 80.0), (-3_600_000_000_000, -100.0)] {
            let truth = Truth { offset, drift: ppm * 1e-6 };
            let (mut fit, mut random) = (ClockFit::default(), Random(5));
            let mut worst = 0;
            for n in 0..600i64 {
                let local = 1_000_000_000_000 + n * 250_000_000;
                exchange(&mut fit, &truth, local, &mut random);
                if let Some(found) = fit.to_local(truth.remote(local)) {
                    let bound = if n > 60 { 60_000 } else { 2_000_000 };
                    let error = (found - local).abs();
                    assert!(error < bound, "exchange {n}: {error} ns");
                    worst = worst.max(if n > 60 { error } else { 0 });
                }
            }
            let estimate = fit.estimate(1_150_000_000_000).unwrap();
            assert!((estimate.drift_ppm - ppm).abs() < 0.5, "{estimate:?}");
            let true_offset = truth.remote(1_150_000_000_000) - 1_150_000_000_000;
            assert!((estimate.offset_nanos - true_offset).abs() < 60_000, "{estimate:?}");
            assert!((400_000..460_000).contains(&estimate.round_trip_nanos), "{estimate:?}");
            println!("offset {offset} ns, {ppm} ppm: within {} us, drift {:.2} ppm", worst / 1000, estimate.drift_ppm);
        }
    }

    #[test]
    fn a_clock_that_steps_is_followed_and_a_late_answer_is_not() {
        let (mut fit, mut random) = (ClockFit::default(), Random(9));
        let mut truth = Truth { offset: 5_000_000, drift: 20e-6 };
        for n in 0..100i64 {
            exchange(&mut fit, &truth, n * 250_000_000, &mut random);
        }
        // One liar between honest ones.
        fit.add(25_000_000_000, -1 << 60, 25_000_400_000);
        let before = fit.estimate(25_000_000_000).unwrap();
        assert!((before.offset_nanos - 5_500_000).abs() < 60_000 && before.steps == 0, "{before:?}");
        truth.offset = -90_000_000_000;
        for n in 100..120i64 {
            exchange(&mut fit, &truth, n * 250_000_000, &mut random);
        }
        let after = fit.estimate(30_000_000_000).unwrap();
        assert!((after.offset_nanos + 90_000_000_000 - 600_000).abs() < 120_000 && after.steps == 1, "{after:?}");
    }

    #[test]
    fn absurd_answers_do_no_harm() {
        let mut fit = ClockFit::default();
        for (asked, answer, answered) in
            [(i64::MAX, 0, i64::MIN), (i64::MIN, i64::MAX, i64::MAX), (0, i64::MIN, 0), (5, i64::MAX, 5), (9, 1, 3)]
        {
            for _ in 0..20 {
                fit.add(asked, answer, answered);
                let _ = (fit.to_local(i64::MAX), fit.to_local(i64::MIN), fit.estimate(i64::MIN), fit.is_young());
            }
        }
    }
}

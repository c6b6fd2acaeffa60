//! Clock alignment of triggered cameras: maps each camera's own clock to the master's by subtracting offset and drift.

use std::collections::VecDeque;

use flyrig_solve::{ClockLine, LineGate, LineOptions, LineSample, fit_line};
use flyrig_types::{CameraId, Frame};
use serde::{Deserialize, Serialize};

/// Relation between the timestamps of different cameras.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClockKind {
    /// One clock stamps all frames (cameras of one computer, recordings). Nothing is corrected, since a frame between
    /// two others was really taken there.
    #[default]
    Shared,
    /// A trigger exposes all cameras simultaneously, and each timestamps with a clock of its own. Offset and drift of
    /// every clock against the master's are estimated and subtracted.
    Triggered,
}

/// Largest plausible distance of a timestamp from the master's newest frame, nanoseconds.
const PLAUSIBLE: i64 = 500_000_000;
/// Consecutive timestamps that must agree on another offset before it is accepted.
const CONFIRMATIONS: usize = 3;
/// Frames from which the first offset is estimated.
const ACQUISITION: usize = 15;
/// Minimum interval between timestamp pairs of the fit, nanoseconds; the fit spans [`PAIRS`] of them.
const PAIR_EVERY: i64 = 100_000_000;
const PAIRS: usize = 300;
/// Pairs from which the drift is estimated: with fewer, jitter dominates drift.
const FIRST_FIT: usize = 50;
/// Intervals whose median is a camera's period.
const INTERVALS: usize = 15;
/// Largest plausible drift of a camera's clock, parts per million; a steeper fit comes from wrong pairs.
const MOST_DRIFT_PPM: f64 = 500.0;
/// Recent instants of the master that are kept.
const INSTANTS: usize = 64;
/// Rounds of all cameras without a frame of one camera after which that camera is no longer taken into account.
const SILENT_ROUNDS: u64 = 2;

/// State of a camera's clock against the master's.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ClockState {
    /// Current correction, added to the camera's timestamp, nanoseconds.
    pub offset_nanos: i64,
    /// Drift of the master's clock against this one, parts per million; positive if the master's runs faster.
    pub drift_ppm: f64,
    /// Root mean square of the fit's residuals, nanoseconds.
    pub residual_nanos: f64,
    /// Steps of the clock that were compensated.
    pub steps: u64,
    /// Frames with an implausible timestamp, which was replaced by the prediction from the sequence number.
    pub replaced: u64,
}

/// Aligner of all cameras' capture times to the master's clock, for [`ClockKind::Triggered`].
///
/// Each camera has an offset and a drift, fitted by least squares without outliers to the pairs of its timestamps and
/// the master's of the last half minute. A timestamp that deviates from that fit and from the trigger's beat is
/// replaced by the prediction from the frame's sequence number; when three of them agree, the clock has stepped, and
/// the offset follows. (A step by whole periods of less than half a second is indistinguishable from missing frames.)
/// The trigger's beat leaves the offset ambiguous by whole periods: clocks that differ by more than half a period at
/// the start are matched by the order in which frames arrive, which the cameras' latencies can make wrong by a frame.
///
/// ```
/// use flyrig_sync::ClockAligner;
/// use flyrig_types::{CameraId, Frame, Image, PixelFormat};
///
/// let cameras: [CameraId; 2] = ["master".into(), "other".into()];
/// let mut aligner = ClockAligner::new(&cameras, None);
/// for n in 0..300 {
///     let truth = n * 33_333_333;
///     // The other camera's clock is 5 ms ahead and 40 ppm fast.
///     let stamps = [truth, truth + 5_000_000 + truth / 25_000];
///     for (camera, capture_nanos) in cameras.iter().zip(stamps) {
///         let image = Image::new(1, 1, PixelFormat::Gray8, vec![0])?;
///         let (camera, sequence) = (camera.clone(), n as u64);
///         let frame = Frame { camera, sequence, capture_nanos, exposure_nanos: None, image, mask: None };
///         let aligned = aligner.align(frame);
///         if n > 150 {
///             assert!((aligned.capture_nanos - truth).abs() < 100_000, "within 0.1 ms");
///         }
///     }
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct ClockAligner {
    cameras: Vec<(CameraId, Clock)>,
    master: usize,
    /// Corrected times of the master's last frames.
    instants: VecDeque<i64>,
    /// Number of frames of all cameras.
    arrivals: u64,
}

#[derive(Debug, Default)]
struct Clock {
    state: ClockState,
    /// Line fit of master minus timestamp.
    line: ClockLine,
    /// Timestamp and corrected time of the master.
    pairs: VecDeque<(i64, i64)>,
    /// First differences to the master's newest frame.
    acquisition: Vec<i64>,
    is_locked: bool,
    /// Deviations of recent implausible timestamps.
    suspects: Vec<i64>,
    /// Timestamp, sequence number and corrected time of the last frame.
    last: Option<(i64, u64, i64)>,
    intervals: VecDeque<i64>,
    /// Timestamps that wait for a frame of the master at or after them.
    unpaired: VecDeque<i64>,
    /// Number of frames of all cameras at this one's last frame.
    heard: u64,
}

impl Clock {
    fn corrected(&self, stamp: i64) -> i64 {
        stamp.wrapping_add(self.line.offset_nanos).saturating_add(self.line.drifted_nanos(stamp))
    }

    fn period(&self) -> Option<i64> {
        let mut sorted: Vec<i64> = self.intervals.iter().copied().collect();
        sorted.sort_unstable();
        sorted.get(sorted.len() / 2).copied()
    }

    /// Predicts the time of a frame from its sequence number and the camera's own period.
    fn expected(&self, sequence: u64) -> Option<i64> {
        let (_, before, time) = self.last?;
        let steps = i64::try_from(sequence.checked_sub(before)?).ok().filter(|steps| (1..1000).contains(steps))?;
        Some(time.saturating_add(self.period()?.saturating_mul(steps)))
    }

    fn note(&mut self, stamp: i64, sequence: u64, corrected: i64) {
        if let Some((before, number, _)) = self.last
            && let Some(steps) = sequence.checked_sub(number).and_then(|steps| i64::try_from(steps).ok())
            && steps > 0
        {
            let interval = stamp.wrapping_sub(before) / steps;
            if (100_000..10_000_000_000).contains(&interval) {
                self.intervals.push_back(interval);
                if self.intervals.len() > INTERVALS {
                    self.intervals.pop_front();
                }
            }
        }
        self.last = Some((stamp, sequence, corrected));
    }

    fn step(&mut self, by: i64) {
        self.line.offset_nanos = self.line.offset_nanos.wrapping_add(by);
        // The pairs keep their worth: their stamps are as if they were of the stepped clock.
        for (stamp, _) in &mut self.pairs {
            *stamp = stamp.wrapping_sub(by);
        }
        self.line.anchor_nanos = self.line.anchor_nanos.wrapping_sub(by);
        self.suspects.clear();
        self.unpaired.clear();
    }

    /// Fits the line to the pairs, a second time without outliers.
    fn fit(&mut self) {
        const OPTIONS: LineOptions = LineOptions {
            least_drift_samples: FIRST_FIT,
            drift_prior_secs: 0.0,
            max_drift: f64::INFINITY,
            gate: Some(LineGate { rounds: 2, sigmas: 4.0, least_nanos: 100_000.0 }),
        };
        let Some(&(anchor, _)) = self.pairs.back() else { return };
        let sample = |&(stamp, master): &(i64, i64)| LineSample {
            time_nanos: stamp,
            offset_nanos: master.wrapping_sub(stamp),
            weight: 1.0,
        };
        let samples: Vec<LineSample> = self.pairs.iter().map(sample).collect();
        let fit = fit_line(&samples, anchor, self.line.offset_nanos, &OPTIONS);
        if let Some(fit) = fit.filter(|fit| fit.line.drift.abs() <= MOST_DRIFT_PPM * 1e-6) {
            self.line = fit.line;
            self.state.residual_nanos = fit.residual_nanos;
        }
    }
}

/// Returns `value` shifted by whole periods to the one nearest to zero.
fn phase(value: i64, period: i64) -> i64 {
    let rest = value.rem_euclid(period);
    if rest > period / 2 { rest - period } else { rest }
}

impl ClockAligner {
    /// Creates an aligner for the cameras of a rig; `master` names one of them, otherwise the first leads.
    #[must_use]
    pub fn new(cameras: &[CameraId], master: Option<&CameraId>) -> Self {
        let slot = master.and_then(|master| cameras.iter().position(|id| id == master));
        Self {
            cameras: cameras.iter().map(|id| (id.clone(), Clock::default())).collect(),
            master: slot.unwrap_or(0),
            instants: VecDeque::with_capacity(INSTANTS),
            arrivals: 0,
        }
    }

    /// Returns the frame with its capture time on the master's clock.
    #[must_use]
    pub fn align(&mut self, frame: Frame) -> Frame {
        let Some(slot) = self.cameras.iter().position(|(id, _)| *id == frame.camera) else { return frame };
        let capture_nanos = self.time(slot, frame.capture_nanos, frame.sequence);
        Frame { capture_nanos, ..frame }
    }

    /// Returns the state of every camera's clock, in rig order.
    pub fn clocks(&self) -> impl Iterator<Item = (&CameraId, ClockState)> {
        self.cameras.iter().map(|(id, clock)| {
            let drift_ppm = clock.line.drift * 1e6;
            let now =
                clock.last.map_or(clock.line.offset_nanos, |(stamp, ..)| clock.corrected(stamp).wrapping_sub(stamp));
            (id, ClockState { offset_nanos: now, drift_ppm, ..clock.state })
        })
    }

    fn time(&mut self, slot: usize, stamp: i64, sequence: u64) -> i64 {
        self.arrivals += 1;
        let period = self.beat(slot);
        let is_master = slot == self.master;
        // The newest instant known without this camera. A silent master delays no other camera.
        let of_master = self.instants.back().copied().filter(|_| !is_master && !self.is_silent(self.master));
        let now = of_master.or_else(|| self.others_now(slot));
        let (arrivals, instants) = (self.arrivals, &self.instants);
        let Some((id, clock)) = self.cameras.get_mut(slot) else { return stamp };
        clock.heard = arrivals;
        let is_told = if is_master { clock.last.is_some() } else { clock.is_locked || of_master.is_some() };
        let (Some(now), true) = (now, is_told) else {
            // Nothing to compare with yet.
            let time = clock.corrected(stamp);
            clock.note(stamp, sequence, time);
            if is_master {
                self.instant(time);
            }
            return time;
        };
        if !is_master && !clock.is_locked {
            acquire(clock, stamp, now, period, instants);
        }
        let mut time = clock.corrected(stamp);
        let near = |time: i64| {
            time.saturating_sub(now).saturating_abs() <= PLAUSIBLE.max(period.unwrap_or(0).saturating_mul(6))
        };
        let in_beat = |time: i64| {
            let gate = |period: i64| (period / 8).max(3_000_000);
            // Without jitter of the trigger the beat goes on from the newest instant.
            is_master || period.is_none_or(|period| phase(time.saturating_sub(now), period).abs() <= gate(period))
        };
        if clock.is_locked || is_master {
            if near(time) && in_beat(time) {
                clock.suspects.clear();
            } else {
                let told = clock.expected(sequence).filter(|told| near(*told)).unwrap_or(now);
                let off = told.saturating_sub(time);
                let agree = |before: &i64| before.abs_diff(off) <= period.unwrap_or(20_000_000).unsigned_abs() / 4;
                if !clock.suspects.last().is_none_or(agree) {
                    clock.suspects.clear();
                }
                clock.suspects.push(off);
                clock.state.replaced += 1;
                if clock.suspects.len() >= CONFIRMATIONS {
                    clock.state.steps += 1;
                    clock.step(off);
                    // The 1st, 2nd, 4th ...: a clock that steps all night must not fill the disk.
                    if clock.state.steps.is_power_of_two() {
                        let (ms, count) = (-(off as f64) * 1e-6, clock.state.steps);
                        tracing::warn!(camera = %id, count, "the clock stepped by {ms:.1} ms, which is compensated");
                    }
                }
                time = told;
            }
        }
        clock.note(stamp, sequence, time);
        if is_master {
            self.instant(time);
        } else if clock.suspects.is_empty() {
            clock.unpaired.push_back(stamp);
            self.pair(slot);
        }
        time
    }

    /// Returns the trigger's period, as far as a camera and the master show it.
    fn beat(&self, slot: usize) -> Option<i64> {
        let period = |slot: usize| self.cameras.get(slot).and_then(|(_, clock)| clock.period());
        match (period(slot), period(self.master)) {
            (Some(own), Some(master)) => Some(own.min(master)),
            (own, master) => own.or(master),
        }
    }

    /// Returns whether the other cameras continued without this one.
    fn is_silent(&self, slot: usize) -> bool {
        let heard = self.cameras.get(slot).map_or(0, |(_, clock)| clock.heard);
        self.arrivals.saturating_sub(heard) > SILENT_ROUNDS * self.cameras.len() as u64
    }

    /// Returns the median of the newest times of the active cameras except this one and the master: one of them may be
    /// wrong.
    fn others_now(&self, own: usize) -> Option<i64> {
        let others = self.cameras.iter().enumerate();
        let others = others.filter(|(slot, _)| *slot != self.master && *slot != own && !self.is_silent(*slot));
        let mut times: Vec<i64> =
            others.filter_map(|(_, (_, clock))| clock.is_locked.then_some(clock.last?.2)).collect();
        times.sort_unstable();
        times.get(times.len() / 2).copied()
    }

    /// Records an instant of the master.
    fn instant(&mut self, time: i64) {
        self.instants.push_back(time);
        if self.instants.len() > INSTANTS {
            self.instants.pop_front();
        }
        for slot in 0..self.cameras.len() {
            if slot != self.master {
                self.pair(slot);
            }
        }
    }

    /// Pairs the timestamps before the master's newest instant with the nearest instants.
    fn pair(&mut self, slot: usize) {
        let Some(period) = self.beat(slot) else { return };
        let Some(&newest) = self.instants.back() else { return };
        let Some((_, clock)) = self.cameras.get_mut(slot) else { return };
        let mut fresh = false;
        while let Some(&stamp) = clock.unpaired.front() {
            let time = clock.corrected(stamp);
            if time.saturating_sub(newest) > period / 4 && clock.unpaired.len() < INSTANTS {
                break;
            }
            clock.unpaired.pop_front();
            let nearest = self.instants.iter().min_by_key(|instant| instant.abs_diff(time)).copied();
            let Some(instant) = nearest.filter(|instant| instant.abs_diff(time) <= period.unsigned_abs() / 4) else {
                continue;
            };
            if clock
                .pairs
                .back()
                .is_none_or(|(before, _)| stamp.wrapping_sub(*before).unsigned_abs() >= PAIR_EVERY.unsigned_abs())
            {
                clock.pairs.push_back((stamp, instant));
                if clock.pairs.len() > PAIRS {
                    clock.pairs.pop_front();
                }
                fresh = true;
            }
        }
        if fresh && clock.is_locked {
            clock.fit();
        }
    }
}

/// Estimates the first offset: whole periods from the order of arrival where the clocks have nothing in common, the
/// rest from the beat.
fn acquire(clock: &mut Clock, stamp: i64, now: i64, period: Option<i64>, instants: &VecDeque<i64>) {
    clock.acquisition.push(now.wrapping_sub(stamp));
    if clock.acquisition.len() == 1 && now.wrapping_sub(stamp).saturating_abs() > PLAUSIBLE {
        clock.line.offset_nanos = now.wrapping_sub(stamp);
    }
    let (true, Some(period)) = (clock.acquisition.len() >= ACQUISITION, period) else { return };
    let median = |values: &mut Vec<i64>| {
        values.sort_unstable();
        values.get(values.len() / 2).copied().unwrap_or(0)
    };
    let rough = median(&mut clock.acquisition);
    if rough.saturating_abs() > PLAUSIBLE {
        clock.line.offset_nanos = rough;
    }
    let time = stamp.wrapping_add(clock.line.offset_nanos);
    let mut phases: Vec<i64> = instants.iter().map(|instant| phase(instant.wrapping_sub(time), period)).collect();
    clock.line.offset_nanos = clock.line.offset_nanos.wrapping_add(median(&mut phases));
    clock.line.anchor_nanos = stamp;
    clock.acquisition.clear();
    clock.unpaired.clear();
    clock.is_locked = true;
}

//! Constant time offsets between cameras from the motion in their images alone, for uncalibrated cameras with
//! unreliable timestamps.

use flyrig_solve::DenseNormal;
use flyrig_types::CameraId;

/// Sampling interval of the signals, nanoseconds.
const STEP: i64 = 4_000_000;
/// Period above which changes are attributed to light and background instead of motion, nanoseconds.
const TREND: i64 = 1_000_000_000;
/// Image bands whose changes are measured: fine enough for a hand, coarse enough against noise.
const BANDS: usize = 64;
/// Vertical zones whose changes are correlated separately, so that motion of the hands is not confused with that of the
/// feet, which would bias the offset towards whatever a camera sees best.
const ZONES: usize = 16;
/// Largest vertical shift between the views of two cameras, zones.
const MOST_OFFSET: usize = 4;
/// Samples that two signals must share, besides the tested offsets: in less than four seconds, different movements are
/// too easily alike.
const LEAST_COMMON: usize = 1000;
/// Correlation below which a pair of cameras is uninformative.
const LEAST_CORRELATION: f64 = 0.3;
/// Largest disagreement between pairs at which a camera's offset is accepted, nanoseconds: slow movements look alike
/// over many frames, and slightly different from every side.
const MOST_DISAGREEMENT: f64 = 2e6;
/// Correlation required of a pair that no third camera can contradict.
const LONE_CORRELATION: f64 = 0.75;

/// Vertical motion in the images of one camera over time.
#[derive(Debug, Clone)]
pub struct MotionSignal {
    camera: CameraId,
    last: Option<(i64, Vec<f32>)>,
    /// Midpoint between two images, nanoseconds, and the change per second of each zone.
    samples: Vec<(i64, [f64; ZONES])>,
}

impl MotionSignal {
    /// Creates an empty signal of a camera.
    #[must_use]
    pub fn new(camera: CameraId) -> Self {
        Self { camera, last: None, samples: Vec::new() }
    }

    /// Adds an image of `width * height` pixels of 3 bytes. Ignores empty images, images whose length differs from the
    /// size, and images out of order.
    pub fn add(&mut self, capture_nanos: i64, rgb: &[u8], width: usize, height: usize) {
        if width == 0 || height == 0 || rgb.len() != width * height * 3 {
            return;
        }
        let bands = bands(rgb, width, height);
        if let Some((before, old)) = &self.last {
            let dt = capture_nanos.saturating_sub(*before);
            if dt <= 0 {
                return;
            }
            if old.len() == bands.len() {
                let mut changed = [0.0; ZONES];
                for (band, (a, b)) in old.iter().zip(&bands).enumerate() {
                    changed[band * ZONES / bands.len()] += f64::from((a - b).abs()) / (dt as f64 * 1e-9);
                }
                self.samples.push((before.saturating_add(dt / 2), changed));
            }
        }
        self.last = Some((capture_nanos, bands));
    }

    /// Number of image pairs compared so far.
    #[must_use]
    pub fn comparisons(&self) -> usize {
        self.samples.len()
    }

    /// Samples every zone each [`STEP`] from `start` on, high-pass filtered at [`TREND`].
    fn sampled(&self, start: i64, count: usize) -> Vec<Vec<f64>> {
        (0..ZONES).map(|zone| self.sampled_zone(zone, start, count)).collect()
    }

    fn sampled_zone(&self, zone: usize, start: i64, count: usize) -> Vec<f64> {
        let mut at = 0;
        let raw: Vec<f64> = (0..count as i64)
            .map(|i| {
                let time = start.saturating_add(i * STEP);
                while at + 2 < self.samples.len() && self.samples[at + 1].0 < time {
                    at += 1;
                }
                let ((t0, v0), (t1, v1)) = (&self.samples[at], &self.samples[at + 1]);
                let (v0, v1) = (v0[zone], v1[zone]);
                let share = (time.saturating_sub(*t0) as f64 / (t1.saturating_sub(*t0).max(1)) as f64).clamp(0.0, 1.0);
                v0 + (v1 - v0) * share
            })
            .collect();
        let half = (TREND / STEP / 2) as usize;
        let mut sums = vec![0.0; count + 1];
        for (i, value) in raw.iter().enumerate() {
            sums[i + 1] = sums[i] + value;
        }
        let mean = |i: usize| {
            let (from, to) = (i.saturating_sub(half), (i + half + 1).min(count));
            (sums[to] - sums[from]) / (to - from) as f64
        };
        raw.iter().enumerate().map(|(i, value)| value - mean(i)).collect()
    }

    fn span(&self) -> Option<(i64, i64)> {
        Some((self.samples.first()?.0, self.samples.last()?.0)).filter(|_| self.samples.len() > 1)
    }
}

/// Returns the mean of the green channel in each of [`BANDS`] bands from top to bottom. Horizontal motion stays within
/// its band: it looks different from every side, while vertical motion is the same for all upright cameras.
fn bands(rgb: &[u8], width: usize, height: usize) -> Vec<f32> {
    let count = BANDS.min(height);
    let mut sums = vec![(0u64, 0u64); count];
    for (y, row) in rgb.chunks_exact(width * 3).enumerate() {
        let (sum, pixels) = &mut sums[y * count / height];
        *sum += row.iter().skip(1).step_by(3).map(|&green| u64::from(green)).sum::<u64>();
        *pixels += width as u64;
    }
    sums.into_iter().map(|(sum, pixels)| (sum as f64 / pixels.max(1) as f64) as f32).collect()
}

/// Estimated time offset of a camera from the first one.
#[derive(Debug, Clone, PartialEq)]
pub struct LagEstimate {
    /// Name of the camera.
    pub camera: CameraId,
    /// Offset to subtract from its timestamps, nanoseconds; `None` when its motion matches no other camera's, when the
    /// pairs of cameras disagree, or when only a weak pair supports it. The first camera's is 0.
    pub lag_nanos: Option<i64>,
    /// Best correlation of its motion with another camera's, in 0..=1.
    pub correlation: f64,
    /// Root mean square disagreement between its pairs, nanoseconds.
    pub disagreement_nanos: f64,
}

/// Estimates the time offsets of all cameras from the first one, each at most `most_nanos`. All cameras see the same
/// motion from different sides: the offset of a pair is where the changes correlate best, and the offsets of all
/// cameras follow from the pairs by weighted least squares.
#[must_use]
pub fn estimate_lags(signals: &[MotionSignal], most_nanos: i64) -> Vec<LagEstimate> {
    let count = signals.len();
    let mut pairs = Vec::new();
    for i in 0..count {
        for j in i + 1..count {
            if let Some((lag, correlation)) = pair_lag(&signals[i], &signals[j], most_nanos.clamp(STEP, 10_000_000_000))
            {
                pairs.push((i, j, lag, correlation));
            }
        }
    }
    accepted_offsets(count, &pairs)
        .into_iter()
        .zip(signals)
        .enumerate()
        .map(|(slot, ((lag, disagreement_nanos), signal))| LagEstimate {
            camera: signal.camera.clone(),
            lag_nanos: lag.map(|lag| lag.round() as i64),
            correlation: (pairs.iter().filter(|(i, j, ..)| *i == slot || *j == slot)).map(|p| p.3).fold(0.0, f64::max),
            disagreement_nanos,
        })
        .collect()
}

/// Time offset estimated from a pair of cameras.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PairLag {
    /// Slots of the cameras.
    pub first: usize,
    pub second: usize,
    /// Time offset of the second camera from the first, nanoseconds.
    pub lag: f64,
    /// Weight in the least squares fit.
    pub weight: f64,
}

/// Estimate of one camera from its pairs.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Balance {
    /// Time offset from the first camera, nanoseconds; `None` where no pair reaches it.
    pub lag: Option<f64>,
    /// Variance of the offset if the weights are inverse variances.
    pub variance: f64,
    /// Root mean square disagreement between its pairs, nanoseconds.
    pub disagreement: f64,
}

/// Solves for the offsets on which the pairs agree best: weighted least squares with the first camera at 0.
pub(crate) fn balanced(count: usize, pairs: &[PairLag]) -> Vec<Balance> {
    let mut reached = vec![false; count];
    if let Some(first) = reached.first_mut() {
        *first = true;
    }
    for _ in 0..count {
        for pair in pairs {
            let either = reached[pair.first] || reached[pair.second];
            (reached[pair.first], reached[pair.second]) = (either, either);
        }
    }
    let unknown: Vec<usize> = (1..count).filter(|slot| reached[*slot]).collect();
    let row = |slot: usize| unknown.iter().position(|known| *known == slot);
    let mut normal = DenseNormal::zeros(unknown.len());
    for pair in pairs {
        let ends = [(row(pair.first), -1.0), (row(pair.second), 1.0)];
        for (i, x) in ends.iter().filter_map(|(i, x)| Some(((*i)?, x))) {
            normal.gradient[i] -= pair.weight * x * pair.lag;
            for (j, y) in ends.iter().filter_map(|(j, y)| Some(((*j)?, y))) {
                normal.matrix[(i, j)] += pair.weight * x * y;
            }
        }
    }
    let solution = normal.minimum();
    let mut out = vec![Balance::default(); count];
    if let Some(first) = out.first_mut() {
        first.lag = Some(0.0);
    }
    if let Some((lags, covariance)) = solution {
        for (i, slot) in unknown.into_iter().enumerate() {
            out[slot].lag = Some(lags[i]).filter(|lag| lag.is_finite());
            out[slot].variance = covariance[(i, i)];
        }
    }
    for slot in 0..count {
        let of_slot = pairs.iter().filter(|pair| pair.first == slot || pair.second == slot);
        let squares: Vec<f64> = of_slot
            .filter_map(|pair| Some((out[pair.second].lag? - out[pair.first].lag? - pair.lag).powi(2)))
            .collect();
        out[slot].disagreement = (squares.iter().fold(0.0, |sum, x| sum + x) / squares.len().max(1) as f64).sqrt();
    }
    out
}

/// Returns each camera's accepted offset from the first one and the disagreement of its pairs. A pair is two cameras,
/// the offset of the second, and the correlation there.
fn accepted_offsets(count: usize, pairs: &[(usize, usize, f64, f64)]) -> Vec<(Option<f64>, f64)> {
    let linked = |a: usize, b: usize| {
        pairs.iter().any(|pair| (pair.0, pair.1) == (a.min(b), a.max(b)) && pair.3 >= LEAST_CORRELATION)
    };
    // Only pairs that close a loop can contradict each other.
    let checked = |i: usize, j: usize| (0..count).any(|k| k != i && k != j && linked(i, k) && linked(j, k));
    let known: Vec<PairLag> = pairs
        .iter()
        .filter(|pair| pair.3 >= LONE_CORRELATION || (pair.3 >= LEAST_CORRELATION && checked(pair.0, pair.1)))
        .map(|&(first, second, lag, correlation)| PairLag { first, second, lag, weight: correlation.powi(4) })
        .collect();
    let lags = balanced(count, &known);
    // All lags are counted from the first camera: what it disagrees on is in each of them.
    let of_first = lags.first().map_or(0.0, |first| first.disagreement);
    let sure = |slot: usize, disagreement: f64| slot == 0 || disagreement.max(of_first) <= MOST_DISAGREEMENT;
    lags.into_iter()
        .enumerate()
        .map(|(slot, Balance { lag, disagreement, .. })| (lag.filter(|_| sure(slot, disagreement)), disagreement))
        .collect()
}

/// Estimates the time offset of `b` from `a`, nanoseconds, and the correlation there. Cameras that see the person
/// higher or lower in their images are compared at the vertical shift of best agreement.
fn pair_lag(a: &MotionSignal, b: &MotionSignal, most: i64) -> Option<(f64, f64)> {
    let ((a0, a1), (b0, b1)) = (a.span()?, b.span()?);
    let (start, end) = (a0.max(b0), a1.min(b1));
    let count = usize::try_from(end.saturating_sub(start) / STEP).ok()?.min(200_000);
    let shifts = usize::try_from(most / STEP).ok()?;
    if count < LEAST_COMMON + 2 * shifts {
        return None;
    }
    let (a, b) = (a.sampled(start, count), b.sampled(start, count));
    let score = |offset: usize, shift: usize| {
        let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
        let from = offset.saturating_sub(MOST_OFFSET);
        let below = MOST_OFFSET.saturating_sub(offset);
        for (a, b) in a.iter().skip(from).zip(b.iter().skip(below)) {
            for (x, y) in a[shifts..count - shifts].iter().zip(&b[shift..]) {
                ab += x * y;
                aa += x * x;
                bb += y * y;
            }
        }
        if aa > 0.0 && bb > 0.0 { ab / (aa * bb).sqrt() } else { 0.0 }
    };
    // A coarse look finds the offset.
    let highest =
        |offset: usize| (0..=2 * shifts).step_by(4).map(|shift| score(offset, shift)).fold(f64::MIN, f64::max);
    let offset = (0..=2 * MOST_OFFSET).map(|offset| (offset, highest(offset))).max_by(|x, y| x.1.total_cmp(&y.1))?.0;
    let scores: Vec<f64> = (0..=2 * shifts).map(|shift| score(offset, shift)).collect();
    let best = (0..scores.len()).max_by(|x, y| scores[*x].total_cmp(&scores[*y]))?;
    // A peak at the edge is a slope that goes on beyond.
    let (&before, &after) = (scores.get(best.checked_sub(1)?)?, scores.get(best + 1)?);
    let curve = before - 2.0 * scores[best] + after;
    let fine = if curve < 0.0 { (0.5 * (before - after) / curve).clamp(-0.5, 0.5) } else { 0.0 };
    Some(((best as f64 + fine - shifts as f64) * STEP as f64, scores[best].clamp(0.0, 1.0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flyrig_model::SplitMix64;

    const PERIOD: i64 = 33_333_333;

    /// Simulates the positions of two hands: sums of slow swings.
    fn hands(seed: u64) -> impl Fn(f64) -> [f64; 4] {
        let mut random = SplitMix64(seed);
        let swings: Vec<[f64; 3]> =
            (0..24).map(|_| [0.3 + 1.5 * random.unit(), 6.3 * random.unit(), 3.0 + 3.0 * random.unit()]).collect();
        move |t| {
            std::array::from_fn(|hand| {
                swings.iter().skip(hand * 6).take(6).map(|[f, p, size]| size * (6.3 * f * t + p).sin()).sum()
            })
        }
    }

    /// Returns the accepted offsets, rounded.
    fn lags(count: usize, pairs: &[(usize, usize, f64, f64)]) -> Vec<Option<f64>> {
        accepted_offsets(count, pairs).into_iter().map(|(lag, _)| lag.map(f64::round)).collect()
    }

    #[test]
    fn offsets_are_reported_only_where_other_pairs_support_them() {
        let known = |ms: f64| Some(ms * 1e6);
        // A loop of weak pairs that agree, and one that does not.
        let loop_of = |third: f64| [(0, 1, 5e6, 0.5), (1, 2, 7e6, 0.5), (0, 2, third, 0.5)];
        assert_eq!(lags(3, &loop_of(12e6)), [known(0.0), known(5.0), known(12.0)]);
        assert_eq!(lags(3, &loop_of(40e6)), [known(0.0), None, None]);
        // The first camera disagrees with two that agree with each other: all are counted from it.
        let beside = [(0, 1, 5e6, 0.8), (0, 2, 14e6, 0.8), (1, 2, 0.0, 0.99), (1, 3, 0.0, 0.99), (2, 3, 0.0, 0.99)];
        assert_eq!(lags(4, &beside), [known(0.0), None, None, None]);
        // A chain of weak pairs: nothing could contradict them.
        assert_eq!(lags(3, &[(0, 1, 5e6, 0.5), (1, 2, 7e6, 0.5)]), [known(0.0), None, None]);
        // Strong pairs need no support.
        assert_eq!(lags(3, &[(0, 1, 5e6, 0.9), (1, 2, 7e6, 0.8)]), [known(0.0), known(5.0), known(12.0)]);
        // A strong pair that hangs on a weak one.
        assert_eq!(lags(3, &[(0, 1, 5e6, 0.5), (1, 2, 7e6, 0.9)]), [known(0.0), None, None]);
        assert_eq!((lags(1, &[]), lags(0, &[])), (vec![known(0.0)], vec![]));
    }

    /// Simulates the images of a camera: two blobs where it sees the hands from its side, and noise.
    fn signal(seed: u64, camera: usize, lag: i64, seconds: i64) -> MotionSignal {
        let (hands, mut random) = (hands(seed), SplitMix64(seed * 100 + camera as u64));
        let mut signal = MotionSignal::new(format!("cam{camera}").into());
        let (side, angle) = (96usize, camera as f64 * 0.8);
        let phase = (random.unit() * PERIOD as f64) as i64;
        for n in 0..seconds * 30 {
            let truth = n * PERIOD + phase;
            let [x0, y0, x1, y1] = hands(truth as f64 * 1e-9);
            let see = |x: f64, y: f64| [48.0 + x * angle.cos() + y * angle.sin(), 48.0 + y * 0.9];
            let blobs = [see(x0, y0), see(x1, y1)];
            let rgb: Vec<u8> = (0..side * side)
                .flat_map(|i| {
                    let (x, y) = ((i % side) as f64, (i / side) as f64);
                    let light: f64 = blobs
                        .iter()
                        .map(|[bx, by]| 150.0 * (-((x - bx).powi(2) + (y - by).powi(2)) / 40.0).exp())
                        .sum();
                    [(60.0 + light + 6.0 * random.unit()).min(255.0) as u8; 3]
                })
                .collect();
            signal.add(truth + lag, &rgb, side, side);
        }
        signal
    }

    #[test]
    fn random_lags_are_found_within_a_few_milliseconds() {
        let mut random = SplitMix64(9);
        let mut worst = 0.0f64;
        for seed in 1..4 {
            let lags: Vec<i64> =
                (0..4).map(|i| if i == 0 { 0 } else { ((random.unit() - 0.5) * 240e6) as i64 }).collect();
            let signals: Vec<MotionSignal> =
                lags.iter().enumerate().map(|(camera, lag)| signal(seed, camera, *lag, 12)).collect();
            for (estimate, lag) in estimate_lags(&signals, 300_000_000).iter().zip(&lags) {
                let off = (estimate.lag_nanos.unwrap() - lag) as f64 * 1e-6;
                println!("seed {seed} {}: {:.1} ms, off by {off:.2} ms", estimate.camera, *lag as f64 * 1e-6);
                worst = worst.max(off.abs());
            }
        }
        assert!(worst <= 2.0, "{worst} ms");
    }

    #[test]
    fn a_camera_without_the_motion_gets_no_offset() {
        let mut signals: Vec<MotionSignal> = (0..2).map(|camera| signal(5, camera, 0, 12)).collect();
        let mut still = MotionSignal::new("wall".into());
        for n in 0..360 {
            still.add(n * PERIOD, &[90; 48 * 48 * 3], 48, 48);
        }
        signals.push(still);
        let estimates = estimate_lags(&signals, 300_000_000);
        assert!(estimates[1].lag_nanos.is_some());
        assert_eq!((estimates[2].lag_nanos, estimates[2].correlation), (None, 0.0));
    }

    #[test]
    fn too_little_and_senseless_input_is_borne() {
        assert!(estimate_lags(&[], 1).is_empty());
        let mut odd = MotionSignal::new("odd".into());
        odd.add(0, &[1, 2, 3], 0, 5);
        odd.add(0, &[1, 2, 3], 1, 1);
        odd.add(i64::MAX, &[1, 2, 9], 1, 1);
        odd.add(i64::MIN, &[1, 2, 3], 1, 1);
        odd.add(i64::MAX, &[0; 12], 2, 2);
        assert_eq!(odd.comparisons(), 1);
        let estimates = estimate_lags(&[odd.clone(), odd.clone(), MotionSignal::new("none".into())], i64::MAX);
        assert_eq!(estimates[2].lag_nanos, None);
        assert_eq!(estimates[0].lag_nanos, Some(0));
        let short: Vec<MotionSignal> = (0..2).map(|camera| signal(6, camera, 0, 3)).collect();
        assert_eq!(estimate_lags(&short, 100_000_000)[1].lag_nanos, None, "three seconds tell nothing");
    }
}

//! Constant lags between calibrated cameras out of points that all of them follow, for takes of a second or two.
//!
//! A point that moves is seen by all cameras where its rays meet; a camera whose stamps are late sees it where it was. The
//! lag of a camera is the one with which it sees the points where the other cameras put them.

use flyrig_types::{Camera, CameraId};
use glam::{DMat3, DVec2, DVec3};

use crate::LagEstimate;

/// Lags are tried every so many nanoseconds, then refined.
const STEP: i64 = 4_000_000;
/// Two sightings of a point farther apart than this have nothing known between them, nanoseconds.
const LONGEST_GAP: i64 = 120_000_000;
/// Distance of two rays, radians, from which a point is more likely to be another one than late: robust scale.
const SCALE: f64 = 0.008;
/// Rounds over all cameras by themselves, and steps of all together.
const ROUNDS: usize = 6;
const STEPS: usize = 20;
/// Largest step, the step that is none, and the difference for derivatives, nanoseconds.
const MOST_STEP: f64 = 20e6;
const STILL: f64 = 1e4;
const NUDGE: f64 = 2e6;
/// Comparisons below which a lag is not believed.
const LEAST: usize = 150;
/// How much better than the mean lag the best one must explain the points, 0 to 1.
const LEAST_CONTRAST: f64 = 0.04;

/// Points of one camera's pictures over time; the same index is the same point in every camera.
#[derive(Debug, Clone)]
pub struct PointTrack {
    camera: Camera,
    /// Time, and by point the direction in the world, of length 1.
    samples: Vec<(i64, Vec<Option<DVec3>>)>,
}

impl PointTrack {
    /// Of a camera, still empty.
    #[must_use]
    pub fn new(camera: &Camera) -> Self {
        Self { camera: camera.clone(), samples: Vec::new() }
    }

    /// Adds the pixels of a picture's points. Pictures out of order and pixels that no ray belongs to are left out.
    pub fn add(&mut self, capture_nanos: i64, pixels: &[Option<DVec2>]) {
        if self.samples.last().is_some_and(|(before, _)| *before >= capture_nanos) {
            return;
        }
        let direction = |pixel: &Option<DVec2>| {
            self.camera.ray(*pixel.as_ref().filter(|pixel| pixel.is_finite())?)?.try_normalize()
        };
        self.samples.push((capture_nanos, pixels.iter().map(direction).collect()));
    }

    /// Direction of a point at a time between two sightings.
    fn at(&self, nanos: i64, point: usize) -> Option<DVec3> {
        let after = self.samples.partition_point(|(time, _)| *time < nanos);
        let (t1, later) = self.samples.get(after)?;
        if *t1 == nanos {
            return *later.get(point)?;
        }
        let (t0, earlier) = self.samples.get(after.checked_sub(1)?)?;
        let gap = t1.saturating_sub(*t0);
        if gap > LONGEST_GAP {
            return None;
        }
        let (a, b) = ((*earlier.get(point)?)?, (*later.get(point)?)?);
        a.lerp(b, nanos.saturating_sub(*t0) as f64 / gap as f64).try_normalize()
    }
}

/// Lags of all cameras against the first one, each at most `most_nanos`; at least three cameras. The correlation of an
/// estimate is how much better it explains the points than the mean of all lags, 0 to 1; its disagreement is how far the
/// lags of half of the points lie from those of the other half.
#[must_use]
pub fn estimate_point_lags(tracks: &[PointTrack], most_nanos: i64) -> Vec<LagEstimate> {
    let most = most_nanos.clamp(STEP, 1_000_000_000);
    let all = Problem { tracks, most, chosen: |_| true }.solve();
    let halves = [0, 1].map(|half| Problem { tracks, most, chosen: move |point: usize| point / 2 % 2 == half }.solve());
    (0..tracks.len())
        .map(|slot| {
            let (lag, contrast) = all.get(slot).copied().unwrap_or_default();
            let apart =
                halves.iter().filter_map(|half| half.get(slot)).map(|(other, _)| (other - lag).powi(2)).sum::<f64>();
            let is_known = slot == 0 || contrast >= LEAST_CONTRAST;
            LagEstimate {
                camera: CameraId::clone(&tracks[slot].camera.id),
                lag_nanos: (is_known && tracks.len() > 2).then_some(lag.round() as i64),
                correlation: contrast,
                disagreement_nanos: (apart / 2.0).sqrt(),
            }
        })
        .collect()
}

struct Problem<'a, F> {
    tracks: &'a [PointTrack],
    most: i64,
    /// Which points count.
    chosen: F,
}

impl<F: Fn(usize) -> bool> Problem<'_, F> {
    /// Lag and contrast by camera: a few rounds of each camera where the others put it, then all together.
    fn solve(&self) -> Vec<(f64, f64)> {
        let count = self.tracks.len();
        let mut lags = vec![0.0; count];
        if count < 3 {
            return vec![(0.0, 0.0); count];
        }
        for _ in 0..ROUNDS {
            // The first one too: where all others agree, one alone cannot follow it.
            for slot in 0..count {
                if let Some((better, _)) = self.best(slot, &lags) {
                    lags[slot] = better;
                }
            }
            let first = lags[0];
            lags.iter_mut().for_each(|lag| *lag -= first);
        }
        for _ in 0..STEPS {
            let Some(step) = self.step(&lags) else { break };
            for (lag, step) in lags[1..].iter_mut().zip(&step) {
                *lag = (*lag + step.clamp(-MOST_STEP, MOST_STEP)).clamp(-(self.most as f64), self.most as f64);
            }
            if step.iter().all(|step| step.abs() < STILL) {
                break;
            }
        }
        let contrast = |slot| self.best(slot, &lags).map_or(0.0, |(_, contrast)| contrast);
        (0..count).map(|slot| (lags[slot], contrast(slot))).collect()
    }

    /// A Gauss-Newton step of all lags but the first: rays that shall meet, weighted by how nearly they do (Geman-McClure).
    fn step(&self, lags: &[f64]) -> Option<Vec<f64>> {
        let unknown = lags.len() - 1;
        let mut normal = vec![vec![0.0; unknown + 1]; unknown];
        let clock = &self.tracks[0];
        for (stamp, points) in &clock.samples {
            for point in (0..points.len()).filter(|point| (self.chosen)(*point)) {
                let Some(base) = self.misses(lags, *stamp, point) else { continue };
                let by_lag: Vec<Option<Vec<Option<DVec3>>>> = (1..lags.len())
                    .map(|slot| {
                        let mut moved = lags.to_vec();
                        moved[slot] += NUDGE;
                        self.misses(&moved, *stamp, point)
                    })
                    .collect();
                for (ray, miss) in base.iter().enumerate() {
                    let Some(miss) = miss else { continue };
                    let weight = (SCALE * SCALE / (miss.length_squared() + SCALE * SCALE)).powi(2);
                    let slope: Vec<DVec3> = by_lag
                        .iter()
                        .map(|moved| {
                            let moved = moved.as_ref().and_then(|moved| moved[ray]);
                            moved.map_or(DVec3::ZERO, |moved| (moved - *miss) / NUDGE)
                        })
                        .collect();
                    for (row, a) in normal.iter_mut().zip(&slope) {
                        for (entry, b) in row.iter_mut().zip(&slope) {
                            *entry += weight * a.dot(*b);
                        }
                        row[unknown] -= weight * a.dot(*miss);
                    }
                }
            }
        }
        for (i, row) in normal.iter_mut().enumerate() {
            row[i] *= 1.0 + 1e-6;
        }
        solve_linear(normal)
    }

    /// By camera how far the place where all rays of a point meet lies beside its ray, radians.
    fn misses(&self, lags: &[f64], now: i64, point: usize) -> Option<Vec<Option<DVec3>>> {
        let place = self.place(usize::MAX, lags, now, point)?;
        let miss = |(track, lag): (&PointTrack, &f64)| {
            let seen = track.at(now.saturating_add(*lag as i64), point)?;
            Some(seen - (place - track.camera.position()).try_normalize()?)
        };
        Some(self.tracks.iter().zip(lags).map(miss).collect())
    }

    /// The lag with which a camera sees the points where the others put them, and how much better it is than the mean of all
    /// lags.
    fn best(&self, slot: usize, lags: &[f64]) -> Option<(f64, f64)> {
        let tries = usize::try_from(2 * self.most / STEP).ok()? + 1;
        let (mut costs, mut counts) = (vec![0.0; tries], vec![0usize; tries]);
        let own = &self.tracks[slot];
        // The instants of the first camera, or of the second where the first is asked for.
        let clock = usize::from(slot == 0);
        let position = own.camera.position();
        for (stamp, points) in &self.tracks[clock].samples {
            let now = stamp.saturating_sub(lags[clock] as i64);
            for point in (0..points.len()).filter(|point| (self.chosen)(*point)) {
                let Some(place) = self.place(slot, lags, now, point) else { continue };
                let Some(expected) = (place - position).try_normalize() else { continue };
                for (i, (cost, count)) in costs.iter_mut().zip(&mut counts).enumerate() {
                    let lag = i as i64 * STEP - self.most;
                    if let Some(seen) = own.at(now.saturating_add(lag), point) {
                        let off = (seen - expected).length_squared();
                        *cost += off / (off + SCALE * SCALE);
                        *count += 1;
                    }
                }
            }
        }
        // Only lags with which nearly as much can be compared as with the best of them.
        let enough = counts.iter().max()? * 3 / 4;
        let mean = |i: usize| {
            let count = *counts.get(i).filter(|count| **count >= LEAST.max(enough))?;
            Some(costs[i] / count as f64)
        };
        let (best, lowest) = (0..tries).filter_map(|i| Some((i, mean(i)?))).min_by(|a, b| a.1.total_cmp(&b.1))?;
        let usable: Vec<f64> = (0..tries).filter_map(mean).collect();
        let average = usable.iter().sum::<f64>() / usable.len() as f64;
        let contrast = if average > 0.0 { ((average - lowest) / average).clamp(0.0, 1.0) } else { 0.0 };
        // A lowest value at the edge is a slope that goes on beyond.
        let (before, after) = (mean(best.checked_sub(1)?)?, mean(best + 1)?);
        let curve = before - 2.0 * lowest + after;
        let fine = if curve > 0.0 { (0.5 * (before - after) / curve).clamp(-0.5, 0.5) } else { 0.0 };
        Some(((best as f64 + fine) * STEP as f64 - self.most as f64, contrast))
    }

    /// Where the other cameras put a point: nearest to all of their rays, least squares.
    fn place(&self, without: usize, lags: &[f64], now: i64, point: usize) -> Option<DVec3> {
        let (mut matrix, mut right, mut rays) = (DMat3::ZERO, DVec3::ZERO, 0);
        for (slot, track) in self.tracks.iter().enumerate().filter(|(slot, _)| *slot != without) {
            let Some(ray) = track.at(now.saturating_add(lags[slot] as i64), point) else { continue };
            let across = DMat3::IDENTITY - DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
            matrix += across;
            right += across * track.camera.position();
            rays += 1;
        }
        // Rays that are nearly parallel meet anywhere.
        (rays >= 2 && matrix.determinant() > 1e-3).then(|| matrix.inverse() * right).filter(|place| place.is_finite())
    }
}

/// Gauss elimination of rows with their right side behind; none when they do not tell.
fn solve_linear(mut rows: Vec<Vec<f64>>) -> Option<Vec<f64>> {
    let n = rows.len();
    for i in 0..n {
        let pivot = (i..n).max_by(|a, b| rows[*a][i].abs().total_cmp(&rows[*b][i].abs()))?;
        rows.swap(i, pivot);
        let top = rows[i].clone();
        if !(top[i].abs() > 0.0 && top[i].is_finite()) {
            return None;
        }
        for (_, row) in rows.iter_mut().enumerate().filter(|(j, _)| *j != i) {
            let factor = row[i] / top[i];
            row.iter_mut().zip(&top).for_each(|(entry, top)| *entry -= factor * top);
        }
    }
    let solution: Vec<f64> = rows.iter().enumerate().map(|(i, row)| row[n] / row[i]).collect();
    solution.iter().all(|value| value.is_finite()).then_some(solution)
}

#[cfg(test)]
#[path = "point_lags_tests.rs"]
mod tests;

//! Refinement of landmarks by heatmaps.
//!
//! BlazePose regresses landmarks and outputs a heatmap for each. MediaPipe moves every landmark to the mean of the heatmap's
//! weights around it (its calculator `RefineLandmarksFromHeatmap`, with the pose solution's window of 7 cells and least
//! peak of 0.5); [`Heatmaps::peak`] does the same. The second moments of the same weights give the width of the peak, which
//! grows with the error of the landmark.

use glam::DVec2;

use crate::landmarks::keypoints::Sharpness;

/// Side of a heatmap, cells.
pub(crate) const HEATMAP_SIDE: usize = 64;
/// Cells of the window around a landmark in each direction.
const REACH: usize = 3;
/// Highest probability in the window below which a heatmap says nothing of the landmark.
const LEAST_PEAK: f64 = 0.5;

/// Peak of a heatmap.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Peak {
    /// Mean place, cells.
    pub at: [f64; 2],
    /// Second moments about it: xx, xy, yy, square cells.
    pub moments: [f64; 3],
}

impl Peak {
    /// Returns spread and principal axis.
    pub fn sharpness(&self) -> Sharpness {
        let [xx, xy, yy] = self.moments;
        let mean = 0.5 * (xx + yy);
        let half = f64::hypot(0.5 * (xx - yy), xy);
        let along = DVec2::from_angle(0.5 * (2.0 * xy).atan2(xx - yy));
        let aspect = ((mean + half) / (mean - half).max(1e-6)).max(1.0).sqrt();
        Sharpness::Peak { spread_cells: mean.max(0.0).sqrt(), along, aspect }
    }
}

/// Heatmaps of all landmarks, logits: row by row, channels last.
pub(crate) struct Heatmaps<'a> {
    logits: &'a [f32],
    channels: usize,
}

impl<'a> Heatmaps<'a> {
    /// Wraps the output of a network; `None` where it is not of [`HEATMAP_SIDE`]² cells of `channels` numbers.
    pub fn new(logits: &'a [f32], channels: usize) -> Option<Self> {
        (logits.len() == HEATMAP_SIDE * HEATMAP_SIDE * channels).then_some(Self { logits, channels })
    }

    /// Returns the peak of a landmark's heatmap in the window around `near`, both in cells with 0 at the border of the
    /// first. A cell counts with its lower index and not with its centre, as in the original, on which the network was
    /// trained. `None` where `near` is out of the map or the window has no peak.
    pub fn peak(&self, channel: usize, near: [f64; 2]) -> Option<Peak> {
        let inside = |at: f64| (0.0..HEATMAP_SIDE as f64).contains(&at);
        if channel >= self.channels || !near.into_iter().all(inside) {
            return None;
        }
        let window = |at: f64| (at as usize).saturating_sub(REACH)..(at as usize + REACH + 1).min(HEATMAP_SIDE);
        let (mut sum, mut highest, mut moment, mut squares) = (0.0, 0.0f64, [0.0; 2], [0.0; 3]);
        for row in window(near[1]) {
            for column in window(near[0]) {
                let logit = f64::from(self.logits[(row * HEATMAP_SIDE + column) * self.channels + channel]);
                let weight = 1.0 / (1.0 + (-logit).exp());
                sum += weight;
                highest = highest.max(weight);
                moment[0] += weight * column as f64;
                moment[1] += weight * row as f64;
                let (x, y) = (column as f64, row as f64);
                squares = [squares[0] + weight * x * x, squares[1] + weight * x * y, squares[2] + weight * y * y];
            }
        }
        (highest >= LEAST_PEAK && sum.is_finite()).then(|| {
            let at @ [x, y] = moment.map(|moment| moment / sum);
            let [xx, xy, yy] = squares.map(|square| square / sum);
            Peak { at, moments: [xx - x * x, xy - x * y, yy - y * y] }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHANNELS: usize = 3;

    /// Returns heatmaps whose channel 1 has a round peak at a place, cells, and a width; the others stay low.
    fn blob([x, y]: [f64; 2], width: f64) -> Vec<f32> {
        let logit = |at: usize| {
            let (cell, channel) = (at / CHANNELS, at % CHANNELS);
            let (column, row) = ((cell % HEATMAP_SIDE) as f64, (cell / HEATMAP_SIDE) as f64);
            let far = ((column - x).powi(2) + (row - y).powi(2)) / (width * width);
            let weight = 0.99 * (-0.5 * far).exp() + 1e-6;
            if channel == 1 { (weight / (1.0 - weight)).ln() as f32 } else { -9.0 }
        };
        (0..HEATMAP_SIDE * HEATMAP_SIDE * CHANNELS).map(logit).collect()
    }

    #[test]
    fn the_mean_of_a_peak_is_found_from_a_landmark_beside_it() {
        for at in [[20.3, 41.8], [5.0, 5.0], [60.2, 3.4]] {
            let logits = blob(at, 0.8);
            let maps = Heatmaps::new(&logits, CHANNELS).unwrap();
            for [dx, dy] in [[0.2, 0.3], [-0.9, 0.9]] {
                let found = maps.peak(1, [at[0] + dx, at[1] + dy]).unwrap().at;
                assert!((0..2).all(|k| (found[k] - at[k]).abs() < 0.05), "{at:?} {found:?}");
            }
        }
    }

    #[test]
    fn a_window_at_the_border_is_cut_off_as_a_plain_sum_over_the_map_has_it() {
        let logits = blob([1.0, 62.5], 1.5);
        let found = Heatmaps::new(&logits, CHANNELS).unwrap().peak(1, [0.5, 63.9]).unwrap().at;
        let (mut sum, mut moment) = (0.0, [0.0; 2]);
        for (row, column) in (0..HEATMAP_SIDE).flat_map(|row| (0..HEATMAP_SIDE).map(move |column| (row, column))) {
            if column <= 3 && row >= 60 {
                let logit = f64::from(logits[(row * HEATMAP_SIDE + column) * CHANNELS + 1]);
                let weight = logit.exp() / (1.0 + logit.exp());
                sum += weight;
                moment = [moment[0] + weight * column as f64, moment[1] + weight * row as f64];
            }
        }
        assert!((0..2).all(|k| (found[k] - moment[k] / sum).abs() < 1e-9), "{found:?}");
    }

    #[test]
    fn moments_tell_the_width_and_direction_of_a_peak() {
        let sharp = |width| {
            let logits = blob([30.0, 30.0], width);
            Heatmaps::new(&logits, CHANNELS).unwrap().peak(1, [30.0, 30.0]).unwrap().sharpness()
        };
        let Sharpness::Peak { spread_cells: narrow, aspect, .. } = sharp(0.7) else { panic!("a peak") };
        let Sharpness::Peak { spread_cells: wide, .. } = sharp(1.2) else { panic!("a peak") };
        assert!((narrow - 0.7).abs() < 0.05 && wide > 1.1 && (aspect - 1.0).abs() < 1e-6, "{narrow} {wide} {aspect}");
        // Standard deviations 2 and 1, the wide axis 30 degrees below x.
        let (sin, cos) = (30f64.to_radians()).sin_cos();
        let moments = [4.0 * cos * cos + sin * sin, 3.0 * sin * cos, 4.0 * sin * sin + cos * cos];
        let Sharpness::Peak { spread_cells, along, aspect } = (Peak { at: [0.0; 2], moments }).sharpness() else {
            panic!("a peak")
        };
        assert!((spread_cells - 2.5f64.sqrt()).abs() < 1e-9 && (aspect - 2.0).abs() < 1e-6);
        assert!(along.perp_dot(DVec2::new(cos, sin)).abs() < 1e-9, "{along}");
        let Sharpness::Peak { aspect, .. } = (Peak { at: [0.0; 2], moments: [0.0; 3] }).sharpness() else {
            panic!("a peak")
        };
        assert!(aspect.is_finite());
    }

    #[test]
    fn maps_without_a_peak_and_poison_say_nothing() {
        let logits = blob([20.0, 20.0], 1.0);
        let maps = Heatmaps::new(&logits, CHANNELS).unwrap();
        for (channel, near) in [
            (0, [20.0, 20.0]),
            (CHANNELS, [20.0, 20.0]),
            (1, [40.0, 20.0]),
            (1, [-0.1, 20.0]),
            (1, [20.0, 64.0]),
            (1, [f64::NAN, 20.0]),
            (1, [20.0, f64::INFINITY]),
        ] {
            assert_eq!(maps.peak(channel, near), None, "{channel} {near:?}");
        }
        let mut poisoned = logits.clone();
        poisoned[(20 * HEATMAP_SIDE + 20) * CHANNELS + 1] = f32::NAN;
        assert_eq!(Heatmaps::new(&poisoned, CHANNELS).unwrap().peak(1, [20.0, 20.0]), None);
        assert!(Heatmaps::new(&logits[1..], CHANNELS).is_none() && Heatmaps::new(&[], CHANNELS).is_none());
    }
}

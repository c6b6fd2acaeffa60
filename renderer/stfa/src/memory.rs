//! Visibility-aware temporal fusion of whole feature vectors (FlyHuman, Eq. 10 to 12), by the rules of direct appearance.

use flyrig_renderer::AppearanceSettings;
use rayon::prelude::*;

/// Features of every Gaussian accumulated so far.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FeatureMemory {
    width: usize,
    /// w_acc of each Gaussian.
    weights: Vec<f32>,
    /// f_acc, `width` numbers per Gaussian.
    features: Vec<f32>,
}

impl FeatureMemory {
    /// Assembles a memory from w_acc of each Gaussian and f_acc, `width` numbers per Gaussian. Returns `None` for
    /// mismatched lengths, non-finite numbers, and negative weights.
    #[must_use]
    pub fn from_parts(width: usize, weights: Vec<f32>, features: Vec<f32>) -> Option<Self> {
        let fits = weights.len().checked_mul(width) == Some(features.len());
        let sound = weights.iter().all(|w| w.is_finite() && *w >= 0.0) && features.iter().all(|f| f.is_finite());
        (fits && sound).then_some(Self { width, weights, features })
    }

    /// Returns w_acc of each Gaussian.
    #[must_use]
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// Returns f_acc, [`Self::width`] numbers per Gaussian.
    #[must_use]
    pub fn features(&self) -> &[f32] {
        &self.features
    }

    /// Returns the numbers per Gaussian.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Clears the memory.
    pub fn clear(&mut self) {
        self.weights.clear();
        self.features.clear();
    }

    /// Resizes to `count` Gaussians of `width` numbers each; clears the memory where the size changes.
    pub fn fit(&mut self, gaussians: usize, width: usize) {
        if self.width != width || self.weights.len() != gaussians {
            self.width = width;
            self.weights = vec![0.0; gaussians];
            self.features = vec![0.0; gaussians * width];
        }
    }

    /// Adds the current rows of the Gaussians from `first` on to the memory, and blends the memory into them. `visible`
    /// is w_vis per Gaussian, `seen` the share of its colour that was seen and exp(-k d) of the best view. A row with a
    /// non-finite number or without weight leaves the memory unchanged; rows beyond the size of [`Self::fit`] are
    /// unchanged.
    pub fn fuse(
        &mut self,
        first: usize,
        rows: &mut [f32],
        visible: &[f32],
        seen: &[[f32; 2]],
        settings: &AppearanceSettings,
    ) {
        let width = self.width;
        let max = settings.memory_weight_max;
        rows.par_chunks_exact_mut(width.max(1))
            .zip(self.features.par_chunks_exact_mut(width.max(1)).skip(first))
            .zip(self.weights.par_iter_mut().skip(first))
            .zip(visible.par_iter().zip(seen))
            .for_each(|(((row, past), past_weight), (&visible, &[share, nearness]))| {
                if visible > 0.0 && visible.is_finite() && row.iter().all(|v| v.is_finite()) {
                    // Eq. 10.
                    let total = *past_weight + visible;
                    for (past, now) in past.iter_mut().zip(row.iter()) {
                        *past = (*past_weight * *past + visible * now) / total;
                    }
                    *past_weight = total.min(max);
                }
                // Eq. 11, 12.
                let trust = (*past_weight / max * (1.0 - share * nearness)).clamp(0.0, 1.0);
                if trust > 0.0 {
                    for (now, past) in row.iter_mut().zip(past.iter()) {
                        *now = if now.is_finite() { *now + trust * (past - *now) } else { *past };
                    }
                }
            });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fusion_follows_the_equations() {
        let settings = AppearanceSettings::default();
        let mut memory = FeatureMemory::default();
        memory.fit(1, 2);
        let (mut acc, mut weight) = ([0.0f64; 2], 0.0f64);
        for frame in 0..40 {
            let t = f64::from(frame);
            let now = [(0.3 * t).sin(), 2.0 + (0.7 * t).cos()];
            let visible = f64::from((frame * 7) % 5) / 4.0;
            let (share, nearness) = (0.6 + 0.4 * visible, 0.5);
            let mut row = now.map(|v| v as f32);
            memory.fuse(0, &mut row, &[visible as f32], &[[share as f32, nearness as f32]], &settings);
            if visible > 0.0 {
                for (acc, now) in acc.iter_mut().zip(now) {
                    *acc = (weight * *acc + visible * now) / (weight + visible);
                }
                weight = (weight + visible).min(8.0);
            }
            let w = weight / 8.0 * (1.0 - share * nearness);
            for c in 0..2 {
                let expected = w * acc[c] + (1.0 - w) * now[c];
                assert!((f64::from(row[c]) - expected).abs() < 1e-5, "frame {frame}");
            }
        }
    }

    #[test]
    fn a_memory_is_put_together_again_unless_its_parts_are_unsound() {
        let mut memory = FeatureMemory::default();
        memory.fit(2, 3);
        memory.fuse(0, &mut [1.0, 2.0, 3.0], &[0.5], &[[1.0, 1.0]], &AppearanceSettings::default());
        let (weights, features) = (memory.weights().to_vec(), memory.features().to_vec());
        assert_eq!(FeatureMemory::from_parts(3, weights.clone(), features.clone()), Some(memory));
        let unsound = |weights: &[f32], features: &[f32]| {
            FeatureMemory::from_parts(3, weights.to_vec(), features.to_vec()).is_none()
        };
        assert!(unsound(&weights, &features[1..]) && unsound(&weights[1..], &features));
        assert!(unsound(&[f32::NAN, 0.0], &features) && unsound(&[-1.0, 0.0], &features));
        assert!(unsound(&weights, &[f32::INFINITY; 6]));
        assert!(FeatureMemory::from_parts(usize::MAX, vec![0.0; 2], Vec::new()).is_none());
    }

    #[test]
    fn poison_and_blindness_leave_the_memory() {
        let settings = AppearanceSettings::default();
        let mut memory = FeatureMemory::default();
        memory.fit(1, 2);
        memory.fuse(0, &mut [1.0, 2.0], &[0.5], &[[1.0, 1.0]], &settings);
        let before = memory.clone();
        let mut poisoned = [f32::NAN, 5.0];
        memory.fuse(0, &mut poisoned, &[1.0], &[[0.0, 0.0]], &settings);
        memory.fuse(0, &mut [7.0, 8.0], &[0.0], &[[0.0, 0.0]], &settings);
        memory.fuse(0, &mut [7.0, 8.0], &[f32::NAN], &[[0.0, 0.0]], &settings);
        assert_eq!(memory, before);
        assert!(poisoned.iter().all(|v| v.is_finite()), "the past stands in: {poisoned:?}");
        memory.clear();
        memory.fit(1, 2);
        let mut fresh = [3.0, 4.0];
        memory.fuse(0, &mut fresh, &[0.0], &[[0.0, 0.0]], &settings);
        assert!((fresh[0] - 3.0f32).abs() < 1e-6 && (fresh[1] - 4.0f32).abs() < 1e-6);
    }
}

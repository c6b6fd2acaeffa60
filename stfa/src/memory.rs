//! Visibility-aware temporal fusion of whole feature vectors (FlyHuman, Eq. 10 to 12), by the rules of direct appearance.

use flyrig_renderer::AppearanceSettings;
use rayon::prelude::*;

/// What was seen of every Gaussian so far.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FeatureMemory {
    width: usize,
    /// w_acc of each Gaussian.
    weights: Vec<f32>,
    /// f_acc, `width` numbers a Gaussian.
    features: Vec<f32>,
}

impl FeatureMemory {
    /// Forgets everything.
    pub fn clear(&mut self) {
        self.weights.clear();
        self.features.clear();
    }

    /// Takes in the rows of this instant, `width` numbers a Gaussian, and blends the past into them. `visible` is w_vis a
    /// Gaussian, `seen` the share of it that was seen and exp(-k d) of the best view. A row with a number that is not
    /// finite, or without weight, leaves the memory as it was.
    pub fn fuse(
        &mut self,
        rows: &mut [f32],
        width: usize,
        visible: &[f32],
        seen: &[[f32; 2]],
        settings: &AppearanceSettings,
    ) {
        if self.width != width || self.weights.len() != visible.len() || self.features.len() != rows.len() {
            self.width = width;
            self.weights = vec![0.0; visible.len()];
            self.features = vec![0.0; rows.len()];
        }
        let max = settings.memory_weight_max;
        rows.par_chunks_exact_mut(width.max(1))
            .zip(self.features.par_chunks_exact_mut(width.max(1)))
            .zip(&mut self.weights)
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
        let (mut acc, mut weight) = ([0.0f64; 2], 0.0f64);
        for frame in 0..40 {
            let t = f64::from(frame);
            let now = [(0.3 * t).sin(), 2.0 + (0.7 * t).cos()];
            let visible = f64::from((frame * 7) % 5) / 4.0;
            let (share, nearness) = (0.6 + 0.4 * visible, 0.5);
            let mut row = now.map(|v| v as f32);
            memory.fuse(&mut row, 2, &[visible as f32], &[[share as f32, nearness as f32]], &settings);
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
    fn poison_and_blindness_leave_the_memory() {
        let settings = AppearanceSettings::default();
        let mut memory = FeatureMemory::default();
        memory.fuse(&mut [1.0, 2.0], 2, &[0.5], &[[1.0, 1.0]], &settings);
        let before = memory.clone();
        let mut poisoned = [f32::NAN, 5.0];
        memory.fuse(&mut poisoned, 2, &[1.0], &[[0.0, 0.0]], &settings);
        memory.fuse(&mut [7.0, 8.0], 2, &[0.0], &[[0.0, 0.0]], &settings);
        memory.fuse(&mut [7.0, 8.0], 2, &[f32::NAN], &[[0.0, 0.0]], &settings);
        assert_eq!(memory, before);
        assert!(poisoned.iter().all(|v| v.is_finite()), "the past stands in: {poisoned:?}");
        memory.clear();
        let mut fresh = [3.0, 4.0];
        memory.fuse(&mut fresh, 2, &[0.0], &[[0.0, 0.0]], &settings);
        assert!((fresh[0] - 3.0f32).abs() < 1e-6 && (fresh[1] - 4.0f32).abs() < 1e-6);
    }
}

//! Corrections of the skin weights, learned with the Gaussians (LoGAvatar Eq. 15).
//!
//! The paper adds a number to each weight. Here a Gaussian's weights are multiplied by `exp(number)` and normalised to
//! the sum 1, so that they stay above zero, and bones that do not move the Gaussian in the template do not move it
//! afterwards. The corrected weights are written to the avatar after every step: a file holds nothing else.

use flyrig_body::SkinWeights;
use rayon::prelude::*;

use flyrig_fit::Element;
use flyrig_fit::Neighbors;
use flyrig_learn::ColumnAdam;

/// Rates at the start and at the end.
const RATE: [f32; 2] = [2e-2, 2e-3];
/// Numbers at which the pull to the template equals the usual derivative of the images, and difference to the
/// neighbours with the same pull.
const TEMPLATE: f32 = 1.0;
const AROUND: f32 = 0.1;
/// Bound on the logarithm of a factor: factors lie between `exp(-4)` and `exp(4)`.
const MOST: f32 = 4.0;

/// Learned corrections of skin weights.
#[derive(Debug)]
pub(crate) struct SkinFit {
    template: Vec<SkinWeights>,
    /// Logarithms of the factors, per Gaussian and entry of its list of weights.
    pub factors: Vec<Element>,
    pub adam: ColumnAdam<4>,
}

impl SkinFit {
    /// Starts without corrections.
    pub fn new(template: &[SkinWeights]) -> Self {
        let factors = vec![[0.0; 4]; template.len()];
        Self { template: template.to_vec(), adam: ColumnAdam::new(factors.len()), factors }
    }

    /// Descends by one step, the `count`th from 1, along dL/d factors; `progress` in 0..=1 is the completed share of
    /// all steps.
    pub fn descend(&mut self, slopes: &mut [Element], neighbors: &Neighbors, count: u64, progress: f32) {
        let usual = self.adam.usual().map(f32::sqrt);
        slopes.par_iter_mut().enumerate().with_min_len(1024).for_each(|(i, slope)| {
            for k in 0..4 {
                // Bones that move this Gaussian, one of several.
                if slope[k].abs() > 0.0 {
                    let own = self.factors[i][k];
                    let difference = own - self.around(neighbors, i, k);
                    slope[k] += usual[k] * (own / TEMPLATE + difference / AROUND);
                }
            }
        });
        let rate = RATE[0] * (RATE[1] / RATE[0]).powf(progress.clamp(0.0, 1.0));
        self.adam.descend(count, [rate; 4], &mut self.factors, slopes);
        self.factors.iter_mut().flatten().for_each(|factor| *factor = factor.clamp(-MOST, MOST));
    }

    /// Returns the mean factor of the same bone among the neighbours that it moves, the Gaussian's own where it moves none.
    fn around(&self, neighbors: &Neighbors, i: usize, slot: usize) -> f32 {
        let joint = self.template[i].joints[slot];
        let (mut sum, mut count) = (0.0, 0.0f32);
        for &j in neighbors.of(i) {
            let Some(skin) = self.template.get(j as usize) else { continue };
            let moves = |k: &usize| skin.joints[*k] == joint && skin.weights[*k] > 0.0;
            if let Some(k) = (0..4).find(moves) {
                sum += self.factors[j as usize][k];
                count += 1.0;
            }
        }
        if count > 0.0 { sum / count } else { self.factors[i][slot] }
    }

    /// Writes the corrected weights: non-negative, with the sum 1 where a bone moves the Gaussian.
    pub fn bake(&self, skin: &mut [SkinWeights]) {
        for ((skin, template), factors) in skin.iter_mut().zip(&self.template).zip(&self.factors) {
            let weights: Element = std::array::from_fn(|k| template.weights[k].max(0.0) * factors[k].exp());
            let sum: f32 = weights.iter().sum();
            // Without a bone, and where the template is broken, all stays.
            if sum > 0.0 && sum.is_finite() {
                skin.weights = weights.map(|weight| weight / sum);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::avatar::tests::small;

    fn sums_to_one(skin: &[SkinWeights]) -> bool {
        skin.iter().all(|skin| {
            skin.weights.iter().all(|weight| (0.0..=1.0).contains(weight))
                && (skin.weights.iter().sum::<f32>() - 1.0).abs() < 1e-5
        })
    }

    #[test]
    fn weights_stay_weights_and_follow_the_derivatives() {
        let avatar = small(2000, 7);
        let neighbors = Neighbors::new(&avatar.places);
        let mut skin = avatar.skin.clone();
        let mut fit = SkinFit::new(&avatar.skin);
        fit.bake(&mut skin);
        let same = |a: &SkinWeights, b: &SkinWeights| {
            a.joints == b.joints && a.weights.iter().zip(b.weights).all(|(a, b)| (a - b).abs() < 1e-5)
        };
        assert!(skin.iter().zip(&avatar.skin).all(|(a, b)| same(a, b)));
        let is_blended = |skin: &SkinWeights| skin.weights[0] > 0.0 && skin.weights[1] > 0.0;
        for count in 1..=100 {
            // All first bones are to move less. One number is broken.
            let slope = |skin: &SkinWeights| if is_blended(skin) { [1.0, -1.0, 0.0, 0.0] } else { [0.0; 4] };
            let mut slopes: Vec<Element> = avatar.skin.iter().map(slope).collect();
            slopes[9] = [f32::NAN; 4];
            fit.descend(&mut slopes, &neighbors, count, 0.0);
            fit.bake(&mut skin);
        }
        assert!(sums_to_one(&skin));
        let less = |(now, before): (&SkinWeights, &SkinWeights)| now.weights[0] < before.weights[0] - 1e-4;
        let blended = avatar.skin.iter().enumerate().filter(|(i, skin)| *i != 9 && is_blended(skin)).count();
        let moved = skin.iter().zip(&avatar.skin).enumerate().filter(|(i, pair)| *i != 9 && less(*pair)).count();
        assert!(blended > 100 && moved * 10 > blended * 9, "{moved} of {blended}");
        // Bones that did not move a Gaussian do not.
        let appears = |(now, before): (&SkinWeights, &SkinWeights)| {
            now.weights.iter().zip(before.weights).any(|(now, before)| before <= 0.0 && *now > 0.0)
        };
        assert!(!skin.iter().zip(&avatar.skin).any(appears));
    }

    #[test]
    fn without_images_the_template_comes_back_and_broken_weights_stay() {
        let avatar = small(400, 7);
        let mut template = avatar.skin.clone();
        template[3].weights = [0.0; 4];
        template[4].weights = [f32::INFINITY, 1.0, 0.0, 0.0];
        let mut fit = SkinFit::new(&template);
        fit.factors.fill([1.0, -1.0, 0.5, 0.0]);
        let mut skin = template.clone();
        fit.bake(&mut skin);
        assert_eq!((skin[3], skin[4]), (template[3], template[4]));
        let neighbors = Neighbors::new(&avatar.places);
        // As strong as images were.
        let [_, second] = fit.adam.lists_mut();
        second.fill([1e-6; 4]);
        for count in 1..=400 {
            let mut slopes = vec![[1e-9; 4]; 400];
            fit.descend(&mut slopes, &neighbors, count, 0.0);
        }
        let most = fit.factors.iter().flatten().fold(0.0f32, |most, value| most.max(value.abs()));
        assert!(most < 0.5, "{most}");
        let mut none = SkinFit::new(&[]);
        none.descend(&mut [], &Neighbors::new(&[]), 1, f32::NAN);
        none.bake(&mut []);
    }
}

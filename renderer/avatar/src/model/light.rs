//! Light of the take's room: the brightness of a surface as a function of its normal. Colours of Gaussians exclude it,
//! so that a person who turns does not get the mean of lit and unlit sides.
//!
//! The polynomial is that of [`flyrig_model::light`]. A second-degree polynomial in the world normal models distant lamps on
//! matte surfaces (Ramamoorthi and Hanrahan 2001); shadows cast by other parts of the body are not modelled.

use flyrig_learn::{AdamStep, Moments};
use flyrig_model::light::{self, SHADE, TERMS, Terms};
use glam::Vec3;

use flyrig_fit::Element;

/// Rates at the start and at the end.
const RATE: [f32; 2] = [1e-2, 1e-3];
const BETAS: [f32; 2] = [0.9, 0.99];
/// Gaussians per task.
const CHUNK: usize = 4096;

/// Light as a function of the normal.
#[derive(Debug, Clone, PartialEq)]
pub struct Light {
    /// Coefficients of the polynomial.
    pub terms: Terms,
}

impl Default for Light {
    /// Creates uniform light.
    fn default() -> Self {
        Self { terms: light::UNIFORM }
    }
}

impl Light {
    /// Returns the factors of red, green and blue for a surface with this world normal. A non-finite normal counts as
    /// zero.
    #[must_use]
    pub fn shade(&self, normal: Vec3) -> [f32; 3] {
        light::shade(&self.terms, normal.to_array())
    }

    /// Returns dL/d terms, and converts `slopes` in place from dL/d lit colours to dL/d unlit ones. `unlit` are the
    /// unlit colours, `stride` rows per Gaussian; `normals` has one normal per Gaussian.
    pub(crate) fn backward(
        &self,
        normals: impl Fn(usize) -> Vec3 + Sync,
        unlit: &[Element],
        slopes: &mut [Element],
        stride: usize,
    ) -> Terms {
        use rayon::prelude::*;
        let chunk = |(chunk, (slopes, unlit)): (usize, (&mut [Element], &[Element]))| {
            let mut sums = [[0.0f64; 3]; TERMS];
            for (i, (slopes, unlit)) in slopes.chunks_mut(stride).zip(unlit.chunks(stride)).enumerate() {
                let normal = normals(chunk * CHUNK + i);
                let basis = light::basis(normal.to_array());
                let free = light::sum(&self.terms, basis);
                let shade = light::bounded(free);
                for k in 0..3 {
                    let by_shade: f32 = slopes.iter().zip(unlit).map(|(slope, color)| slope[k] * color[k]).sum();
                    // At its bounds it does not move.
                    if by_shade.is_finite() && SHADE.contains(&free[k]) {
                        sums.iter_mut().zip(basis).for_each(|(sum, value)| sum[k] += f64::from(by_shade * value));
                    }
                    slopes.iter_mut().for_each(|slope| slope[k] *= shade[k]);
                }
            }
            sums
        };
        let rows = slopes.par_chunks_mut(CHUNK * stride).zip(unlit.par_chunks(CHUNK * stride)).enumerate();
        // Summed in order: the same input gives the same bytes.
        let parts: Vec<_> = rows.map(chunk).collect();
        std::array::from_fn(|term| std::array::from_fn(|k| parts.iter().map(|part| part[term][k]).sum::<f64>() as f32))
    }
}

/// Learning state of a light.
#[derive(Debug, Clone)]
pub(crate) struct LightFit {
    pub moments: Moments,
}

impl LightFit {
    pub fn new() -> Self {
        Self { moments: [vec![0.0; 3 * TERMS], vec![0.0; 3 * TERMS]] }
    }

    /// Descends by one step, the `count`th from 1, along dL/d terms. The constant term is fixed, since colours have the
    /// same freedom.
    pub fn descend(&mut self, light: &mut Light, slopes: &Terms, count: u64, progress: f32) {
        let rate = RATE[0] * (RATE[1] / RATE[0]).powf(progress.clamp(0.0, 1.0));
        let step = AdamStep { betas: BETAS, count, rate, decay: 0.0, scale: 1.0, share: 0.0 };
        let mut values = light.terms.as_flattened().to_vec();
        let mut slopes = slopes.as_flattened().to_vec();
        slopes[..3].fill(0.0);
        step.descend(&mut values, &mut self.moments, &slopes);
        light.terms.as_flattened_mut().copy_from_slice(&values);
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let mut random = StdRng::seed_from_u64(3);
        let mut draw = || random.random_range(-1.0f32..1.0);
        let (count, stride) = (CHUNK + 40, 4);
        let mut light = Light::default();
        light.terms.iter_mut().skip(1).flatten().for_each(|value| *value = 0.2 * draw());
        light.terms[3] = [3.0; 3]; // some are out of bounds
        let normals: Vec<Vec3> = (0..count).map(|_| Vec3::new(draw(), draw(), draw()).normalize()).collect();
        let unlit: Vec<Element> = (0..count * stride).map(|_| [draw(), draw(), draw(), 0.0]).collect();
        let weights: Vec<Element> = (0..count * stride).map(|_| [draw(), draw(), draw(), 7.0]).collect();
        let loss = |light: &Light, unlit: &[Element]| -> f64 {
            let rows = unlit.chunks(stride).zip(weights.chunks(stride)).zip(&normals);
            rows.map(|((colors, weights), normal)| {
                let shade = light.shade(*normal);
                let pairs = colors.iter().zip(weights);
                pairs
                    .flat_map(|(c, w)| (0..3).map(move |k| f64::from(c[k]) * f64::from(w[k]) * f64::from(shade[k])))
                    .sum::<f64>()
            })
            .sum()
        };
        let mut slopes = weights.clone();
        let found = light.backward(|i| normals[i], &unlit, &mut slopes, stride);
        for (at, found) in found.as_flattened().iter().enumerate() {
            let moved = |by: f32| {
                let mut moved = light.clone();
                moved.terms.as_flattened_mut()[at] += by;
                loss(&moved, &unlit)
            };
            let expected = (moved(1e-3) - moved(-1e-3)) / 2e-3;
            let error = (expected - f64::from(*found)).abs();
            assert!(error < 0.05 + 2e-2 * expected.abs(), "{at}: {expected} {found}");
        }
        for i in (0..count * stride).step_by(311) {
            let shade = light.shade(normals[i / stride]);
            for k in 0..3 {
                assert!((slopes[i][k] - weights[i][k] * shade[k]).abs() < 1e-5);
            }
            assert!((slopes[i][3] - 7.0).abs() <= 0.0);
        }
    }

    #[test]
    fn poison_is_left_out_and_the_mean_has_no_direction() {
        let light = Light { terms: [[f32::MAX; 3]; TERMS] };
        assert!(light.shade(Vec3::NAN).iter().all(|shade| SHADE.contains(shade)));
        assert!(Light::default().shade(Vec3::X).iter().all(|shade| (shade - 1.0).abs() <= 0.0));
        let mut slopes = vec![[f32::NAN; 4], [1.0; 4]];
        let found = Light::default().backward(|_| Vec3::Y, &[[0.5; 4]; 2], &mut slopes, 1);
        assert!(found.as_flattened().iter().all(|slope| slope.is_finite()) && (found[2][0] - 0.5).abs() < 1e-6);
    }

    #[test]
    fn a_lamp_is_found() {
        let mut random = StdRng::seed_from_u64(5);
        let mut draw = || random.random_range(-1.0f32..1.0);
        let normals: Vec<Vec3> = (0..500).map(|_| Vec3::new(draw(), draw(), draw()).normalize()).collect();
        let (mut light, mut fit) = (Light::default(), LightFit::new());
        for count in 1..=600 {
            let seen = |normal: &Vec3| 1.0 + 0.5 * normal.y;
            let mut slopes: Vec<Element> = normals
                .iter()
                .map(|normal| light.shade(*normal).map(|shade| 0.4 * (0.4 * shade - 0.4 * seen(normal))))
                .map(|[r, g, b]| [r, g, b, 0.0])
                .collect();
            let found = light.backward(|i| normals[i], &vec![[0.4; 4]; 500], &mut slopes, 1);
            fit.descend(&mut light, &found, count, count as f32 / 600.0);
        }
        assert!((light.terms[2][1] - 0.5).abs() < 0.02 && light.terms[1][1].abs() < 0.02, "{:?}", light.terms);
        assert!(light.terms[0].iter().all(|term| (term - 1.0).abs() <= 0.0));
    }
}

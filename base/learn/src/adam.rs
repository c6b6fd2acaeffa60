//! Adam (Kingma and Ba 2015) with decoupled weight decay (Loshchilov and Hutter 2019).

use rayon::prelude::*;

/// Exponential means of a parameter's derivatives and of their squares.
pub type Moments = [Vec<f32>; 2];

/// Elements per task of a thread.
const CHUNK: usize = 1 << 14;

/// Settings of one step.
///
/// ```
/// use flyrig_learn::AdamStep;
///
/// // Minimises (x - 3)².
/// let (mut x, mut moments) = (vec![0.0f32], [vec![0.0], vec![0.0]]);
/// for count in 1..=500 {
///     let step = AdamStep { betas: [0.9, 0.99], count, rate: 0.05, decay: 0.0, scale: 1.0, share: 0.0 };
///     let gradient = [2.0 * (x[0] - 3.0)];
///     step.descend(&mut x, &mut moments, &gradient);
/// }
/// assert!((x[0] - 3.0).abs() < 0.05);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamStep {
    /// Decay rates of the two exponential means.
    pub betas: [f32; 2],
    /// Number of this step, from 1.
    pub count: u64,
    /// Learning rate.
    pub rate: f32,
    /// Fraction by which values decay in this step.
    pub decay: f32,
    /// Factor of all derivatives.
    pub scale: f32,
    /// Multiple of the root mean square of the parameter's derivatives that is added to the denominator. With 0, values whose derivatives
    /// are a hundredth of the usual ones move as far as others, driven by noise.
    pub share: f32,
}

impl AdamStep {
    /// Updates values and moments by one step along the gradient.
    pub fn descend(&self, values: &mut [f32], [mean, square]: &mut Moments, gradient: &[f32]) {
        let Self { betas, rate, decay, scale, .. } = *self;
        let count = i32::try_from(self.count).unwrap_or(i32::MAX);
        let unbias = betas.map(|beta| 1.0 - beta.powi(count));
        let floor = if self.share > 0.0 { self.share * (usual(square) / unbias[1]).sqrt() + 1e-8 } else { 1e-8 };
        values
            .par_chunks_mut(CHUNK)
            .zip(gradient.par_chunks(CHUNK))
            .zip(mean.par_chunks_mut(CHUNK).zip(square.par_chunks_mut(CHUNK)))
            .for_each(|((values, gradient), (mean, square))| {
                for (((value, mean), square), gradient) in values.iter_mut().zip(mean).zip(square).zip(gradient) {
                    let gradient = gradient * scale;
                    *mean = betas[0] * *mean + (1.0 - betas[0]) * gradient;
                    *square = betas[1] * *square + (1.0 - betas[1]) * gradient * gradient;
                    *value -= decay * *value + rate * (*mean / unbias[0]) / ((*square / unbias[1]).sqrt() + floor);
                }
            });
    }
}

/// Returns the mean square over the values that ever had a derivative.
fn usual(square: &[f32]) -> f32 {
    let (sum, count) =
        square.iter().filter(|v| **v > 0.0).fold((0.0f64, 0u32), |(sum, n), v| (sum + f64::from(*v), n + 1));
    (sum / f64::from(count.max(1))) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: AdamStep = AdamStep { betas: [0.9, 0.99], count: 1, rate: 0.01, decay: 0.0, scale: 1.0, share: 0.0 };

    /// The formula as it is published, in f64.
    #[test]
    fn steps_are_those_of_the_formula() {
        let (mut m, mut v, mut x) = (0.0f64, 0.0f64, 2.0f64);
        let (mut values, mut moments) = (vec![2.0f32], [vec![0.0], vec![0.0]]);
        for (i, slope) in [0.5f64, -0.2, 0.1, 0.7, -1.5].into_iter().enumerate() {
            let t = i as i32 + 1;
            m = 0.9 * m + 0.1 * slope;
            v = 0.99 * v + 0.01 * slope * slope;
            x -= 0.01 * (m / (1.0 - 0.9f64.powi(t))) / ((v / (1.0 - 0.99f64.powi(t))).sqrt() + 1e-8);
            AdamStep { count: t as u64, ..STEP }.descend(&mut values, &mut moments, &[slope as f32]);
        }
        assert!((f64::from(values[0]) - x).abs() < 1e-5, "{values:?} {x}");
    }

    #[test]
    fn numbers_with_small_derivatives_move_little_where_that_is_asked_for() {
        let (mut values, mut moments) = (vec![0.0f32; 2], [vec![0.0; 2], vec![0.0; 2]]);
        for count in 1..=20 {
            AdamStep { count, share: 0.3, ..STEP }.descend(&mut values, &mut moments, &[1.0, 0.01]);
        }
        assert!(values[0] < -0.1 && values[1] > -0.02 && values[1] < 0.0, "{values:?}");
    }
}

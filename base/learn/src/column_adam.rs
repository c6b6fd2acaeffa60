//! Adam (Kingma and Ba 2015) for rows of numbers whose columns have rates of their own.
//!
//! Adam's steps do not depend on the size of derivatives, so that a hardly visible Gaussian would move as far as any
//! other, driven by noise. Here the constant in the denominator is a share of the derivatives' usual size in the column,
//! so that such a Gaussian moves little.

use rayon::prelude::*;

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-15;
/// Share of the root mean square of a column's derivatives that is added in the denominator.
const SHARE_OF_USUAL: f32 = 0.3;
/// Rows per task.
const CHUNK: usize = 4096;

/// Adam's moments of a list of rows.
#[derive(Debug, Clone, Default)]
pub struct ColumnAdam<const N: usize> {
    first: Vec<[f32; N]>,
    second: Vec<[f32; N]>,
}

impl<const N: usize> ColumnAdam<N> {
    /// Starts at zero, for this many rows.
    #[must_use]
    pub fn new(rows: usize) -> Self {
        Self { first: vec![[0.0; N]; rows], second: vec![[0.0; N]; rows] }
    }

    /// Returns both moments, the first one first.
    pub fn lists_mut(&mut self) -> [&mut [[f32; N]]; 2] {
        [&mut self.first, &mut self.second]
    }

    /// Returns the mean square of the derivatives per column, over the rows that ever had one.
    #[must_use]
    pub fn usual(&self) -> [f32; N] {
        let (mut sum, mut count) = ([0.0f64; N], [0u32; N]);
        for row in &self.second {
            for k in 0..N {
                sum[k] += f64::from(row[k]);
                count[k] += u32::from(row[k] > 0.0);
            }
        }
        std::array::from_fn(|k| (sum[k] / f64::from(count[k].max(1))) as f32)
    }

    /// Descends by one step; `step` counts from 1, `rates` are those of the columns. Non-finite derivatives count as
    /// zero.
    pub fn descend(&mut self, step: u64, rates: [f32; N], values: &mut [[f32; N]], derivatives: &[[f32; N]]) {
        let step = step.min(1 << 20) as i32;
        let (correct_1, correct_2) = (1.0 - BETA_1.powi(step), 1.0 - BETA_2.powi(step));
        let rates = rates.map(|rate| rate / correct_1);
        let usual = self.usual();
        let floor: [f32; N] = std::array::from_fn(|k| SHARE_OF_USUAL * (usual[k] / correct_2).sqrt() + EPSILON);
        values
            .par_chunks_mut(CHUNK)
            .zip(derivatives.par_chunks(CHUNK))
            .zip(self.first.par_chunks_mut(CHUNK).zip(self.second.par_chunks_mut(CHUNK)))
            .for_each(|((values, derivatives), (first, second))| {
                for (((value, slope), first), second) in values.iter_mut().zip(derivatives).zip(first).zip(second) {
                    for k in 0..N {
                        let slope = if slope[k].is_finite() { slope[k] } else { 0.0 };
                        first[k] = BETA_1 * first[k] + (1.0 - BETA_1) * slope;
                        second[k] = BETA_2 * second[k] + (1.0 - BETA_2) * slope * slope;
                        value[k] -= rates[k] * first[k] / ((second[k] / correct_2).sqrt() + floor[k]);
                    }
                }
            });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bowl_is_descended_and_poison_is_left_out() {
        let mut values = vec![[3.0, -2.0, 0.5, 1.0]; 10_000];
        let mut adam = ColumnAdam::new(values.len());
        for step in 1..=3000 {
            let mut slopes: Vec<[f32; 4]> = values.iter().map(|row| row.map(|v| 2.0 * (v - 1.0))).collect();
            slopes[7] = [f32::NAN, f32::INFINITY, 0.0, 0.0];
            adam.descend(step, [1e-2; 4], &mut values, &slopes);
        }
        assert!(values.iter().flatten().all(|value| value.is_finite()));
        assert!((values[0][0] - 1.0).abs() < 1e-2 && (values[9999][1] - 1.0).abs() < 1e-2, "{:?}", values[0]);
        assert!((values[7][0] - 3.0).abs() < 1e-6);
    }

    /// Compares with the published formula in f64, except for the denominator.
    #[test]
    fn steps_are_those_of_the_formula() {
        let slopes = [0.5f64, -0.2, 0.1, 0.7, -1.5];
        let (mut m, mut v, mut x) = (0.0f64, 0.0f64, 2.0f64);
        let mut values = vec![[2.0f32; 4]];
        let mut adam = ColumnAdam::new(1);
        for (i, slope) in slopes.iter().enumerate() {
            let t = i as i32 + 1;
            m = 0.9 * m + 0.1 * slope;
            v = 0.999 * v + 0.001 * slope * slope;
            let before = (v - 0.001 * slope * slope) / 0.999;
            let floor = 0.3 * (before / (1.0 - 0.999f64.powi(t))).sqrt() + 1e-15;
            x -= 0.01 * (m / (1.0 - 0.9f64.powi(t))) / ((v / (1.0 - 0.999f64.powi(t))).sqrt() + floor);
            adam.descend(t as u64, [0.01; 4], &mut values, &[[*slope as f32; 4]]);
        }
        assert!((f64::from(values[0][2]) - x).abs() < 1e-5, "{values:?} {x}");
    }
}

//! Multiresolution hash encoding of positions: features of the eight corners of the cell around a position,
//! interpolated trilinearly, at several resolutions. Indices and weights are cached, since positions seldom change.

use glam::Vec3;
use rayon::prelude::*;

/// Number of resolutions.
pub(super) const LEVELS: usize = 8;
/// Features per resolution.
pub(super) const FEATURES: usize = 2;
/// Features per position: the 16 of the paper.
pub(super) const WIDTH: usize = LEVELS * FEATURES;
/// Rows per resolution's table.
pub(super) const ROWS: usize = 1 << 14;
/// Cells along the longest side of the body at the coarsest resolution, and growth factor per level: the finest cells
/// are 7 mm wide on an adult.
const COARSEST: f32 = 16.0;
const GROWTH: f32 = 1.5;

/// Encoded box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Box3 {
    lowest: Vec3,
    side_m: f32,
}

impl Box3 {
    /// Encloses the finite positions; one metre without any.
    pub fn around(places: &[Vec3]) -> Self {
        let finite = || places.iter().copied().filter(|place| place.is_finite());
        let lowest = finite().reduce(Vec3::min).unwrap_or(Vec3::ZERO);
        let highest = finite().reduce(Vec3::max).unwrap_or(Vec3::ONE);
        Self { lowest, side_m: (highest - lowest).max_element().max(1e-3) }
    }
}

/// Returns the row of a corner in a resolution's table: a dense index where all corners fit, a hash otherwise.
pub(super) fn row(level: usize, [x, y, z]: [u32; 3]) -> usize {
    let side = cells(level) as u32 + 2;
    if u64::from(side).pow(3) <= ROWS as u64 {
        return ((z * side + y) * side + x) as usize % ROWS;
    }
    let mixed = x.wrapping_mul(0x9e37_79b1) ^ y.wrapping_mul(0x85eb_ca77).rotate_left(11) ^ z.wrapping_mul(0xc2b2_ae3d);
    // The upper bits are mixed best.
    (mixed.wrapping_mul(0x27d4_eb2f) >> 18) as usize % ROWS
}

pub(super) fn cells(level: usize) -> f32 {
    COARSEST * GROWTH.powi(level as i32)
}

/// Corners of one position at one resolution: rows of the table and their weights.
type Corners = [(u32, f32); 8];

/// Encoding of a list of positions.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct HashEncoding {
    /// Corners, [`LEVELS`] per position.
    pub corners: Vec<Corners>,
}

impl HashEncoding {
    /// Encodes positions; those outside of the box are clamped to its sides.
    pub fn new(places: &[Vec3], around: Box3) -> Self {
        let of = |at: usize| {
            let (place, level) = (places[at / LEVELS], at % LEVELS);
            let unit = ((place - around.lowest) / around.side_m).to_array();
            // A NaN becomes 0.
            let along = unit.map(|value| if value > 0.0 { value.min(1.0) * cells(level) } else { 0.0 });
            let low = along.map(|value| value.floor() as u32);
            let part: [f32; 3] = std::array::from_fn(|k| along[k] - low[k] as f32);
            std::array::from_fn(|corner| {
                let upper: [u32; 3] = std::array::from_fn(|k| (corner as u32 >> k) & 1);
                let share = (0..3).map(|k| if upper[k] == 1 { part[k] } else { 1.0 - part[k] }).product();
                (row(level, std::array::from_fn(|k| low[k] + upper[k])) as u32, share)
            })
        };
        Self { corners: (0..places.len() * LEVELS).into_par_iter().with_min_len(1024).map(of).collect() }
    }

    /// Computes the features of all positions, [`WIDTH`] each, from the concatenated tables of all resolutions.
    pub fn encode(&self, tables: &[f32]) -> Vec<f32> {
        let mut features = vec![0.0; self.corners.len() * FEATURES];
        features.par_chunks_mut(FEATURES).zip(&self.corners).enumerate().with_min_len(1024).for_each(
            |(at, (out, corners))| {
                for (row, share) in corners {
                    let first = ((at % LEVELS) * ROWS + *row as usize) * FEATURES;
                    let Some(entry) = tables.get(first..first + FEATURES) else { continue };
                    out.iter_mut().zip(entry).for_each(|(out, value)| *out += share * value);
                }
            },
        );
        features
    }

    /// Returns the derivatives with respect to the tables from those with respect to the features. Each resolution is
    /// summed in the order of positions.
    pub fn backward(&self, slopes: &[f32]) -> Vec<f32> {
        let mut tables = vec![0.0; LEVELS * ROWS * FEATURES];
        tables.par_chunks_mut(ROWS * FEATURES).enumerate().for_each(|(level, table)| {
            let places = self.corners.iter().zip(slopes.chunks_exact(FEATURES)).skip(level).step_by(LEVELS);
            for (corners, slope) in places {
                for (row, share) in corners {
                    let first = *row as usize * FEATURES;
                    table[first..first + FEATURES].iter_mut().zip(slope).for_each(|(sum, slope)| *sum += share * slope);
                }
            }
        });
        tables
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    /// Computes features by the definition, in f64.
    fn reference(place: Vec3, around: Box3, tables: &[f64]) -> Vec<f64> {
        let mut features = Vec::new();
        for level in 0..LEVELS {
            let at: Vec<f64> = ((place - around.lowest) / around.side_m)
                .to_array()
                .iter()
                .map(|v| f64::from(v.clamp(0.0, 1.0)) * f64::from(cells(level)))
                .collect();
            for feature in 0..FEATURES {
                let mut sum = 0.0;
                for x in 0..2 {
                    for y in 0..2 {
                        for z in 0..2 {
                            let corner = [at[0].floor() as u32 + x, at[1].floor() as u32 + y, at[2].floor() as u32 + z];
                            let share: f64 = (0..3).map(|k| 1.0 - (at[k] - f64::from(corner[k])).abs()).product();
                            sum += share * tables[(level * ROWS + row(level, corner)) * FEATURES + feature];
                        }
                    }
                }
                features.push(sum);
            }
        }
        features
    }

    #[test]
    fn features_are_trilinear_and_derivatives_their_transpose() {
        let mut random = StdRng::seed_from_u64(2);
        let places: Vec<Vec3> = (0..40)
            .map(|_| Vec3::new(random.random(), 1.8 * random.random::<f32>(), 0.3 * random.random::<f32>()))
            .collect();
        let around = Box3::around(&places);
        let encoding = HashEncoding::new(&places, around);
        let mut tables: Vec<f64> = (0..LEVELS * ROWS * FEATURES).map(|_| random.random_range(-1.0..1.0)).collect();
        let narrow = |tables: &[f64]| -> Vec<f32> { tables.iter().map(|value| *value as f32).collect() };
        let found = encoding.encode(&narrow(&tables));
        let all = |tables: &[f64]| -> Vec<f64> {
            places.iter().flat_map(|place| reference(*place, around, tables)).collect()
        };
        for (found, expected) in found.iter().zip(all(&tables)) {
            assert!((f64::from(*found) - expected).abs() < 2e-4, "{found} {expected}");
        }
        let weights: Vec<f32> = (0..found.len()).map(|i| (i as f32 * 0.7).sin()).collect();
        let slopes = encoding.backward(&weights);
        let loss = |tables: &[f64]| -> f64 { all(tables).iter().zip(&weights).map(|(a, b)| a * f64::from(*b)).sum() };
        let touched: Vec<usize> = (0..slopes.len()).filter(|i| slopes[*i].abs() > 0.0).collect();
        for &i in touched.iter().step_by(touched.len() / 60) {
            let before = tables[i];
            tables[i] = before + 1e-3;
            let more = loss(&tables);
            tables[i] = before - 1e-3;
            let expected = (more - loss(&tables)) / 2e-3;
            tables[i] = before;
            assert!(
                (expected - f64::from(slopes[i])).abs() < 1e-3 * (expected.abs() + 0.1),
                "{i}: {expected} {}",
                slopes[i]
            );
        }
    }

    #[test]
    fn rows_are_within_the_table_and_odd_places_are_drawn_to_the_box() {
        let mut used = vec![0u32; ROWS];
        for x in 0..300 {
            for y in 0..300 {
                used[row(LEVELS - 1, [x, y, 17])] += 1;
            }
        }
        // Well mixed: 5.5 corners a row in the mean.
        assert!(*used.iter().max().unwrap() < 40, "{:?}", used.iter().max());
        let around = Box3::around(&[Vec3::ZERO, Vec3::ONE]);
        let odd = [Vec3::NAN, Vec3::splat(-9.0), Vec3::splat(f32::INFINITY)];
        let encoding = HashEncoding::new(&odd, around);
        assert_eq!(encoding.corners[..LEVELS], encoding.corners[LEVELS..2 * LEVELS]);
        assert!(encoding.encode(&vec![1.0; LEVELS * ROWS * FEATURES]).iter().all(|value| (value - 1.0).abs() < 1e-5));
        assert!(HashEncoding::new(&[], Box3::around(&[])).encode(&[]).is_empty());
    }
}

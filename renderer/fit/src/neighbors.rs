//! Pull between neighbours: attributes of poorly seen Gaussians follow those beside them (LoGAvatar Eq. 18 penalises
//! the standard deviation among neighbours).

use glam::Vec3;
use rayon::prelude::*;

use crate::model::Element;

/// Number of neighbours per Gaussian.
const NEAREST: usize = 6;

/// Nearest Gaussians of each Gaussian.
#[derive(Debug, Clone)]
pub struct Neighbors(Vec<[u32; NEAREST]>);

impl Neighbors {
    /// Finds neighbours by canonical positions. With fewer Gaussians than neighbours, a Gaussian is its own neighbour.
    #[must_use]
    pub fn new(places: &[Vec3]) -> Self {
        // Sorted by height, those within the distance of the worst so far are near in the order.
        let mut order: Vec<u32> = (0..places.len() as u32).collect();
        order.sort_by(|a, b| places[*a as usize].y.total_cmp(&places[*b as usize].y));
        let mut nearest: Vec<(u32, [u32; NEAREST])> = (0..order.len())
            .into_par_iter()
            .with_min_len(64)
            .map(|at| (order[at], nearest(places, &order, at)))
            .collect();
        nearest.sort_unstable_by_key(|(gaussian, _)| *gaussian);
        Self(nearest.into_iter().map(|(_, nearest)| nearest).collect())
    }

    /// Returns the nearest others of a Gaussian, nearest first.
    #[must_use]
    pub fn of(&self, i: usize) -> &[u32] {
        self.0.get(i).map_or(&[], |nearest| nearest.as_slice())
    }

    /// Adds the derivatives of a pull to the mean of the neighbours: `weights` times the difference, per column. A
    /// Gaussian has `stride` rows, of which the first is pulled.
    pub fn pull(&self, values: &[Element], slopes: &mut [Element], stride: usize, weights: Element) {
        if weights.iter().all(|weight| *weight == 0.0) {
            return;
        }
        slopes.par_chunks_mut(stride).zip(&self.0).enumerate().with_min_len(1024).for_each(|(i, (slope, nearest))| {
            let (Some(slope), Some(own)) = (slope.first_mut(), values.get(i * stride)) else { return };
            let mut around = Element::default();
            for &j in nearest {
                let row = values.get(j as usize * stride).unwrap_or(own);
                around.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
            }
            for k in 0..4 {
                slope[k] += weights[k] * (own[k] - around[k] / NEAREST as f32);
            }
        });
    }
}

fn nearest(places: &[Vec3], order: &[u32], at: usize) -> [u32; NEAREST] {
    let own = places[order[at] as usize];
    let mut found = [(f32::INFINITY, order[at]); NEAREST];
    let mut look = |other: u32| -> bool {
        let place = places[other as usize];
        let worst = found[NEAREST - 1].0;
        if (place.y - own.y).powi(2) > worst {
            return false;
        }
        let distance = place.distance_squared(own);
        if distance < worst {
            found[NEAREST - 1] = (distance, other);
            found.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        true
    };
    for &other in &order[at + 1..] {
        if !look(other) {
            break;
        }
    }
    for &other in order[..at].iter().rev() {
        if !look(other) {
            break;
        }
    }
    found.map(|(_, other)| other)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn neighbors_are_the_nearest() {
        let mut random = StdRng::seed_from_u64(8);
        let places: Vec<Vec3> =
            (0..500).map(|_| Vec3::new(random.random(), random.random(), random.random())).collect();
        let Neighbors(found) = Neighbors::new(&places);
        for i in 0..places.len() {
            let mut others: Vec<usize> = (0..places.len()).filter(|j| *j != i).collect();
            others.sort_by(|a, b| places[*a].distance(places[i]).total_cmp(&places[*b].distance(places[i])));
            assert_eq!(found[i].map(|j| j as usize), others[..NEAREST], "{i}");
        }
        assert_eq!(Neighbors::new(&places[..1]).0, [[0; NEAREST]]);
        assert!(Neighbors::new(&[]).0.is_empty());
    }

    #[test]
    fn a_gaussian_is_pulled_to_the_mean_of_its_neighbors() {
        let places: Vec<Vec3> = (0..20).map(|i| Vec3::new(0.0, i as f32, 0.0)).collect();
        let neighbors = Neighbors::new(&places);
        let mut values = vec![[1.0; 4]; 40];
        values[2 * 9] = [7.0, 1.0, 1.0, 1.0];
        let mut slopes = vec![[0.0; 4]; 40];
        neighbors.pull(&values, &mut slopes, 2, [0.5, 1.0, 1.0, 0.0]);
        assert!(
            (slopes[18][0] - 3.0).abs() < 1e-5
                && slopes[18][1].abs() < 1e-6
                && slopes[19].iter().all(|slope| slope.abs() <= 0.0)
        );
        assert!((slopes[16][0] + 0.5).abs() < 1e-5, "{:?}", slopes[16]);
    }
}

//! Gaussians in groups: anchors spread over the surface, and the Gaussians around each (LoGAvatar Eq. 11 and 13).

use glam::Vec3;
use rayon::prelude::*;

/// Index of an empty slot in a group.
pub(super) const NOBODY: u32 = u32::MAX;

/// Selects `count` positions by farthest-point sampling: each is as far as possible from those before it. Starts at the
/// first position.
pub(super) fn farthest(places: &[Vec3], count: usize) -> Vec<u32> {
    let mut order = Vec::with_capacity(count.min(places.len()));
    let mut away = vec![f32::INFINITY; places.len()];
    let mut next = 0;
    while order.len() < count.min(places.len()) {
        order.push(next as u32);
        let at = places[next];
        away[next] = -1.0;
        // The farthest; of equal ones the first, for any number of threads.
        let best = away
            .par_iter_mut()
            .zip(places)
            .enumerate()
            .with_min_len(8192)
            .map(|(i, (away, place))| {
                *away = away.min(place.distance_squared(at));
                (*away, i)
            })
            .reduce(|| (-2.0, usize::MAX), |a, b| if b.0 > a.0 || (b.0 >= a.0 && b.1 < a.1) { b } else { a });
        next = if best.1 < places.len() { best.1 } else { 0 };
    }
    order
}

/// Gaussians of one stage, grouped by the inputs of its networks.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Groups {
    /// Slots per group: the size of the largest one.
    pub slots: usize,
    /// Concatenated groups of Gaussians, [`NOBODY`] in empty slots.
    pub members: Vec<u32>,
}

impl Groups {
    /// Assigns each of `gaussians` to the nearest of `inputs`, both indices of `places`.
    pub fn new(places: &[Vec3], inputs: &[u32], gaussians: &[u32]) -> Self {
        let nearest = |gaussian: &u32| {
            let own = places[*gaussian as usize];
            let distances = inputs.iter().map(|input| places[*input as usize].distance_squared(own)).enumerate();
            distances.fold((0, f32::INFINITY), |best, (i, d)| if d < best.1 { (i, d) } else { best }).0
        };
        let owners: Vec<usize> = gaussians.par_iter().with_min_len(64).map(nearest).collect();
        let mut groups = vec![Vec::new(); inputs.len()];
        owners.into_iter().zip(gaussians).for_each(|(owner, gaussian)| {
            if let Some(group) = groups.get_mut(owner) {
                group.push(*gaussian);
            }
        });
        let slots = groups.iter().map(Vec::len).max().unwrap_or(0).max(1);
        groups.iter_mut().for_each(|group| group.resize(slots, NOBODY));
        Self { slots, members: groups.concat() }
    }

    /// Returns the slots that hold a Gaussian, with its index.
    pub fn cells(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        self.members.iter().enumerate().filter(|(_, g)| **g != NOBODY).map(|(cell, g)| (cell, *g as usize))
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn anchors_are_far_apart_and_every_gaussian_has_one_place() {
        let mut random = StdRng::seed_from_u64(8);
        let places: Vec<Vec3> = (0..400).map(|_| Vec3::new(random.random(), random.random(), 0.0)).collect();
        let anchors = farthest(&places, 25);
        for (k, next) in anchors.iter().enumerate().skip(1) {
            let away = |i: usize| {
                anchors[..k].iter().map(|a| places[*a as usize].distance(places[i])).fold(f32::INFINITY, f32::min)
            };
            let best = (0..places.len()).map(away).fold(0.0, f32::max);
            assert!(away(*next as usize) >= best - 1e-6);
        }
        let all: Vec<u32> = (0..400).collect();
        let groups = Groups::new(&places, &anchors, &all);
        let mut members: Vec<usize> = groups.cells().map(|(_, g)| g).collect();
        members.sort_unstable();
        assert!(members.iter().copied().eq(0..400) && groups.members.len() == 25 * groups.slots);
        // All in one, and none at all.
        assert_eq!(farthest(&[Vec3::ONE; 5], 3), [0, 1, 2]);
        assert_eq!(Groups::new(&places, &anchors[..1], &all).slots, 400);
        assert!(farthest(&[], 3).is_empty() && Groups::new(&[], &[], &[]).members.is_empty());
    }
}

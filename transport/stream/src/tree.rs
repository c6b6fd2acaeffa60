//! Haar transform on a balanced binary tree over a list of items.
//!
//! The tree follows from the number of items alone: a node of n items has a child of the first n - n/2 and one of the last n/2, down to the
//! level whose nodes have one or two items. All nodes of a level have the same weight, whatever their items cover.

use alloc::{vec, vec::Vec};
use core::ops::Range;

/// Level whose nodes are the segments, where the tree is that deep.
const SEGMENT_LEVEL: u32 = 5;

/// Number of channels of an item.
pub(crate) const CHANNELS: usize = 3;

/// Balanced tree.
///
/// Coefficients lie in a list: first the mean of each segment, then from `1 << level` on the differences of a level's nodes
/// between their first and their second half.
#[derive(Debug, Clone)]
pub(crate) struct HaarTree {
    items: usize,
    /// Level whose nodes have one or two items.
    deepest: u32,
    segment_level: u32,
    /// First item of each node of the deepest level, then the number of items.
    starts: Vec<u32>,
}

impl HaarTree {
    /// Creates the tree of a number of items, at least one.
    pub fn new(items: usize) -> Self {
        let items = items.max(1);
        let deepest = items.ilog2();
        let mut starts = vec![0, items as u32];
        for _ in 0..deepest {
            let halves = starts.windows(2).flat_map(|pair| [pair[0], pair[1] - (pair[1] - pair[0]) / 2]);
            let mut next: Vec<u32> = halves.collect();
            next.push(items as u32);
            starts = next;
        }
        Self { items, deepest, segment_level: deepest.min(SEGMENT_LEVEL), starts }
    }

    pub fn items(&self) -> usize {
        self.items
    }

    /// Returns the number of coefficients, unused ones included.
    pub fn coefficients(&self) -> usize {
        2 << self.deepest
    }

    pub fn segments(&self) -> usize {
        1 << self.segment_level
    }

    /// Returns the levels that have differences.
    pub fn levels(&self) -> Range<u32> {
        self.segment_level..self.deepest + 1
    }

    /// Returns the places of a segment's coefficients in a level.
    pub fn places(&self, level: u32, segment: usize) -> Range<usize> {
        let width = 1 << (level - self.segment_level);
        let first = (1 << level) + segment * width;
        first..first + width
    }

    /// Returns whether a node of the deepest level has two items; `place` is that of its coefficient.
    pub fn is_pair(&self, place: usize) -> bool {
        let node = place - (1 << self.deepest);
        self.starts[node + 1] - self.starts[node] == 2
    }

    pub fn deepest(&self) -> u32 {
        self.deepest
    }

    /// Returns the quantisation steps with which items have the error of a step of `step` in an orthonormal transform: the square of the
    /// step of a coefficient that moves n items is n times smaller.
    pub fn steps(&self, step: f32) -> Steps {
        let items = |level: u32| self.items as f32 / (1u32 << level) as f32;
        let of_level = |level: u32| 2.0 * step / libm::sqrtf(items(level).max(2.0));
        let mean = step / libm::sqrtf(items(self.segment_level));
        Steps { mean, first: self.segment_level, differences: self.levels().map(of_level).collect() }
    }

    /// Computes the coefficients of the items; coefficients without an item are 0. Calls `item` once per item, in order; `means` is scratch.
    pub fn forward(
        &self,
        mut item: impl FnMut(usize) -> [f32; CHANNELS],
        coefficients: &mut [[f32; CHANNELS]],
        means: &mut Vec<[f32; CHANNELS]>,
    ) {
        let first = 1usize << self.deepest;
        means.resize(first, [0.0; CHANNELS]);
        let nodes = coefficients[first..].iter_mut().zip(means.iter_mut()).zip(self.starts.windows(2));
        for ((coefficient, mean), pair) in nodes {
            let a = item(pair[0] as usize);
            if pair[1] - pair[0] == 2 {
                let b = item(pair[0] as usize + 1);
                (*coefficient, *mean) = split(a, b);
            } else {
                (*coefficient, *mean) = ([0.0; CHANNELS], a);
            }
        }
        for level in (self.segment_level..self.deepest).rev() {
            let first = 1usize << level;
            for (node, coefficient) in coefficients[first..2 * first].iter_mut().enumerate() {
                (*coefficient, means[node]) = split(means[2 * node], means[2 * node + 1]);
            }
        }
        coefficients[..self.segments()].copy_from_slice(&means[..self.segments()]);
    }

    /// Calls `set` with each item, in order. `mean` returns the mean of a segment, `difference` that of a place with the step of its level;
    /// `means` is scratch.
    pub fn inverse(
        &self,
        steps: &Steps,
        mean: impl Fn(usize) -> [f32; CHANNELS],
        difference: impl Fn(usize, f32) -> [f32; CHANNELS],
        means: &mut Vec<[f32; CHANNELS]>,
        mut set: impl FnMut(usize, [f32; CHANNELS]),
    ) {
        means.resize(1 << self.deepest, [0.0; CHANNELS]);
        for (segment, slot) in means.iter_mut().take(self.segments()).enumerate() {
            *slot = mean(segment);
        }
        for level in self.segment_level..self.deepest {
            let (first, step) = (1usize << level, steps.of_level(level));
            for node in (0..first).rev() {
                let [a, b] = halves(means[node], difference(first + node, step));
                means[2 * node] = a;
                means[2 * node + 1] = b;
            }
        }
        let (first, step) = (1usize << self.deepest, steps.of_level(self.deepest));
        for ((node, pair), mean) in self.starts.windows(2).enumerate().zip(means.iter()) {
            if pair[1] - pair[0] == 2 {
                let [a, b] = halves(*mean, difference(first + node, step));
                set(pair[0] as usize, a);
                set(pair[0] as usize + 1, b);
            } else {
                set(pair[0] as usize, *mean);
            }
        }
    }
}

/// Quantisation steps of a tree's coefficients.
#[derive(Debug, Clone, Default)]
pub(crate) struct Steps {
    /// Step of the segments' means.
    pub mean: f32,
    /// Level of the first of `differences`.
    first: u32,
    differences: Vec<f32>,
}

impl Steps {
    /// Returns the step of a level's differences.
    pub fn of_level(&self, level: u32) -> f32 {
        self.differences.get(level.wrapping_sub(self.first) as usize).copied().unwrap_or(0.0)
    }
}

/// Returns difference and mean of two halves.
fn split(a: [f32; CHANNELS], b: [f32; CHANNELS]) -> ([f32; CHANNELS], [f32; CHANNELS]) {
    (core::array::from_fn(|c| a[c] - b[c]), core::array::from_fn(|c| 0.5 * (a[c] + b[c])))
}

/// Returns two halves by their mean and difference.
fn halves(mean: [f32; CHANNELS], difference: [f32; CHANNELS]) -> [[f32; CHANNELS]; 2] {
    [core::array::from_fn(|c| mean[c] + 0.5 * difference[c]), core::array::from_fn(|c| mean[c] - 0.5 * difference[c])]
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn the_inverse_undoes_the_transform_for_any_number_of_items() {
        let mut random = StdRng::seed_from_u64(3);
        for count in (1..80).chain([1000, 1023, 1024, 1025, 4097]) {
            let tree = HaarTree::new(count);
            let items: Vec<[f32; 3]> = (0..count).map(|_| [0; 3].map(|_| random.random_range(-9.0..9.0))).collect();
            let mut coefficients = vec![[0.0; 3]; tree.coefficients()];
            let mut scratch = Vec::new();
            tree.forward(|i| items[i], &mut coefficients, &mut scratch);
            let mut back = vec![[f32::NAN; 3]; count];
            let (mean, difference) = (|i: usize| coefficients[i], |i: usize, _: f32| coefficients[i]);
            tree.inverse(&Steps::default(), mean, difference, &mut scratch, |i, item| back[i] = item);
            for (a, b) in items.iter().flatten().zip(back.iter().flatten()) {
                assert!((a - b).abs() < 1e-4, "{count}");
            }
            // Every coefficient belongs to one segment.
            let mut owners = vec![0; tree.coefficients()];
            for segment in 0..tree.segments() {
                owners[segment] += 1;
                for place in tree.levels().flat_map(|level| tree.places(level, segment)) {
                    owners[place] += 1;
                }
            }
            assert!(owners.iter().all(|count| *count == 1), "{count}: {owners:?}");
        }
    }

    #[test]
    fn steps_give_each_level_its_share_of_the_error() {
        // Uniform noise of one step in each coefficient: items must err by the same step's noise.
        let mut random = StdRng::seed_from_u64(4);
        let tree = HaarTree::new(6000);
        let steps = tree.steps(3.0);
        let noise: Vec<f32> = (0..tree.coefficients()).map(|_| random.random_range(-0.5..0.5)).collect();
        let (mut sum, mut count) = (0.0, 0);
        let mut scratch = Vec::new();
        tree.inverse(
            &steps,
            |segment| [steps.mean * noise[segment], 0.0, 0.0],
            |place, step| [step * noise[place], 0.0, 0.0],
            &mut scratch,
            |_, item| {
                sum += f64::from(item[0]).powi(2);
                count += 1;
            },
        );
        let expected = 3.0 / 12f64.sqrt();
        let rms = (sum / f64::from(count)).sqrt();
        assert!((rms / expected - 1.0).abs() < 0.1, "{rms} {expected}");
    }
}

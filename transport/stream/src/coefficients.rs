//! Coding of quantised coefficients: three levels of the tree at a time, a block of zeros in one decision.

use core::ops::Range;

use crate::{
    integers::MagnitudeModel,
    range_coder::{BitCoder, Probability},
    tree::{CHANNELS, HaarTree},
};

/// Channels of a coefficient, in quantisation steps.
pub(crate) type Levels = [i32; CHANNELS];

/// Number of levels in a group.
pub(crate) const GROUP: u32 = 3;

/// Largest number of nodes of a block, and the level of each below the first.
const BLOCK: usize = (1 << GROUP) - 1;
const LEVEL: [usize; BLOCK] = [0, 1, 1, 2, 2, 2, 2];

/// Probabilities of one message, which adapt along it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct CoefficientModel {
    /// Probability that a block is all zero, by whether the two blocks before it are.
    block: [Probability; 4],
    /// Probability that a channel of a block is all zero, by the channels before it.
    channel: [[Probability; 4]; CHANNELS],
    /// Probability that a coefficient is zero, by channel, level in the group and neighbours.
    nonzero: [[[Probability; 4]; GROUP as usize]; CHANNELS],
    magnitude: [[MagnitudeModel; GROUP as usize]; CHANNELS],
    mean_nonzero: [Probability; CHANNELS],
    mean: [MagnitudeModel; CHANNELS],
}

impl CoefficientModel {
    /// Codes the mean of a segment.
    pub fn code_mean(&mut self, coder: &mut impl BitCoder, value: &mut Levels) {
        for ((value, nonzero), mean) in value.iter_mut().zip(&mut self.mean_nonzero).zip(&mut self.mean) {
            let is_nonzero = coder.bit(nonzero, *value != 0);
            *value = if is_nonzero { mean.code(coder, *value) } else { 0 };
        }
    }

    /// Codes the coefficients of up to [`GROUP`] levels of a segment. `values` is the list of all coefficients; those without an item must
    /// be 0.
    pub fn code_group<C: BitCoder>(
        &mut self,
        coder: &mut C,
        tree: &HaarTree,
        levels: Range<u32>,
        segment: usize,
        values: &mut [Levels],
    ) {
        let mut history = 0;
        let depth = levels.end - levels.start;
        for root in tree.places(levels.start, segment) {
            // A node, its two halves and their halves lie side by side in each level.
            let is_any = C::WRITES
                && (0..depth).any(|below| {
                    let nodes = &values[root << below..(root + 1) << below];
                    nodes.as_flattened().iter().fold(0, |bits, value| bits | value) != 0
                });
            let is_any = coder.bit(&mut self.block[history], is_any);
            if is_any {
                self.code_block(coder, tree, (&levels, root), values);
            } else if !C::WRITES {
                (0..depth).for_each(|below| values[root << below..(root + 1) << below].fill([0; CHANNELS]));
            }
            history = (history << 1 | usize::from(is_any)) & 3;
        }
    }

    /// Codes a node and those below it, at least one of which is not zero.
    fn code_block<C: BitCoder>(
        &mut self,
        coder: &mut C,
        tree: &HaarTree,
        (levels, root): (&Range<u32>, usize),
        values: &mut [Levels],
    ) {
        let count = (1 << (levels.end - levels.start)) - 1;
        let place = |i: usize| (root << LEVEL[i]) + (i + 1 - (1 << LEVEL[i]));
        // Nodes of one item have no difference.
        let mut has_value = [true; BLOCK];
        let mut block = [[0; CHANNELS]; BLOCK];
        for i in 0..count {
            has_value[i] = levels.start + (LEVEL[i] as u32) < tree.deepest() || tree.is_pair(place(i));
            if C::WRITES {
                block[i] = values[place(i)];
            }
        }
        let mut active = [false; BLOCK];
        let mut active_channels = 0;
        let models = self.channel.iter_mut().zip(&mut self.nonzero).zip(&mut self.magnitude);
        for (c, ((channel, nonzero), magnitude)) in models.enumerate() {
            let is_any = C::WRITES && block.iter().any(|value| value[c] != 0);
            if !coder.bit(&mut channel[active_channels], is_any) {
                continue;
            }
            active_channels += 1;
            let mut is_nonzero = [false; BLOCK];
            for i in (0..count).filter(|i| has_value[*i]) {
                let above = i > 0 && is_nonzero[(i - 1) / 2];
                let before = i > 0 && is_nonzero[i - 1];
                let context = usize::from(above) + usize::from(before) + usize::from(active[i]);
                let value = &mut block[i][c];
                is_nonzero[i] = coder.bit(&mut nonzero[LEVEL[i]][context], *value != 0);
                if is_nonzero[i] {
                    *value = magnitude[LEVEL[i]].code(coder, *value);
                }
                active[i] |= is_nonzero[i];
            }
        }
        if !C::WRITES {
            for (i, value) in block.iter().enumerate().take(count) {
                values[place(i)] = *value;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use alloc::{vec, vec::Vec};

    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::range_coder::{RangeDecoder, RangeEncoder};

    #[test]
    fn coefficients_come_back_for_any_number_of_items() {
        let mut random = StdRng::seed_from_u64(5);
        for count in [1, 2, 3, 31, 32, 33, 63, 100, 511, 700, 3000] {
            for share in [0.0, 0.02, 0.3, 1.0] {
                let tree = HaarTree::new(count);
                let mut values: Vec<Levels> = (0..tree.coefficients())
                    .map(|_| {
                        [0; 3].map(|_| if random.random::<f64>() < share { random.random_range(-40..40) } else { 0 })
                    })
                    .collect();
                for (place, value) in values.iter_mut().enumerate().skip(1 << tree.deepest()) {
                    if !tree.is_pair(place) {
                        *value = [0; 3];
                    }
                }
                let code = |coder: &mut dyn FnMut(&mut CoefficientModel, usize, &mut [Levels])| {
                    let mut model = CoefficientModel::default();
                    let mut coded = values.clone();
                    for segment in 0..tree.segments() {
                        coder(&mut model, segment, &mut coded);
                    }
                };
                let groups = || tree.levels().step_by(GROUP as usize).map(|a| a..(a + GROUP).min(tree.levels().end));
                let mut encoder = RangeEncoder::new(Vec::new());
                code(&mut |model, segment, values| {
                    model.code_mean(&mut encoder, &mut values[segment]);
                    groups().for_each(|levels| model.code_group(&mut encoder, &tree, levels, segment, values));
                });
                let bytes = encoder.finish();
                let mut decoder = RangeDecoder::new(&bytes);
                let mut found = vec![[7; 3]; tree.coefficients()];
                code(&mut |model, segment, _| {
                    model.code_mean(&mut decoder, &mut found[segment]);
                    groups().for_each(|levels| model.code_group(&mut decoder, &tree, levels, segment, &mut found));
                });
                assert!(found == values, "{count} {share}");
            }
        }
    }
}

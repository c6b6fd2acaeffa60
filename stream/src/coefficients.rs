//! Coding of quantised coefficients: three levels of the tree at a time, with blocks of zeros in one decision.

use core::ops::Range;

use crate::{
    integers::MagnitudeModel,
    range_coder::{BitCoder, Probability},
    tree::{CHANNELS, HaarTree},
};

/// A coefficient's channels, in steps.
pub(crate) type Levels = [i32; CHANNELS];

/// Levels in a group.
pub(crate) const GROUP: u32 = 3;

/// Probabilities of one message, which adapt from its beginning to its end.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct CoefficientModel {
    /// Whether a block is not all zero, by the same of the two blocks before it.
    block: [Probability; 4],
    /// Whether a channel of a block is not all zero, by the channels before it.
    channel: [[Probability; 4]; CHANNELS],
    /// Whether a coefficient is not zero, by channel, level in the group and neighbours.
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

    /// Codes the coefficients of some levels of a segment, at most [`GROUP`]. `values` is the list of all coefficients;
    /// those that have no item stay as they are.
    pub fn code_group(
        &mut self,
        coder: &mut impl BitCoder,
        tree: &HaarTree,
        levels: Range<u32>,
        segment: usize,
        values: &mut [Levels],
    ) {
        let mut history = 0;
        for root in tree.places(levels.start, segment) {
            history = (history << 1 | usize::from(self.code_block(coder, tree, (&levels, root), history, values))) & 3;
        }
    }

    /// Codes a node and those below it; returns whether any is not zero.
    fn code_block(
        &mut self,
        coder: &mut impl BitCoder,
        tree: &HaarTree,
        (levels, root): (&Range<u32>, usize),
        history: usize,
        values: &mut [Levels],
    ) -> bool {
        // A heap: the node, its two halves, their halves. Nodes of one item have no difference.
        let depth = levels.end - levels.start;
        let mut places = [(0, false); (1 << GROUP) - 1];
        let places = &mut places[..(1 << depth) - 1];
        for (i, slot) in places.iter_mut().enumerate() {
            let below = (i + 1).ilog2();
            let place = (root << below) + (i + 1 - (1 << below));
            *slot = (place, levels.start + below < tree.deepest() || tree.is_pair(place));
        }
        let is_any = places.iter().any(|(place, has_value)| *has_value && values[*place] != [0; CHANNELS]);
        if !coder.bit(&mut self.block[history], is_any) {
            for (place, _) in places.iter() {
                values[*place] = [0; CHANNELS];
            }
            return false;
        }
        let mut active = [0; (1 << GROUP) - 1];
        let mut active_channels = 0;
        let models = self.channel.iter_mut().zip(&mut self.nonzero).zip(&mut self.magnitude);
        for (c, ((channel, nonzero), magnitude)) in models.enumerate() {
            let is_any = places.iter().any(|(place, has_value)| *has_value && values[*place][c] != 0);
            if !coder.bit(&mut channel[active_channels], is_any) {
                for (place, _) in places.iter() {
                    values[*place][c] = 0;
                }
                continue;
            }
            active_channels += 1;
            let mut is_nonzero = [false; (1 << GROUP) - 1];
            for (i, (place, has_value)) in places.iter().enumerate() {
                let value = &mut values[*place][c];
                if !has_value {
                    *value = 0;
                    continue;
                }
                let above = i > 0 && is_nonzero[(i - 1) / 2];
                let before = i > 0 && is_nonzero[i - 1];
                let context = usize::from(above) + usize::from(before) + usize::from(active[i] > 0);
                let level = (i + 1).ilog2() as usize;
                is_nonzero[i] = coder.bit(&mut nonzero[level][context], *value != 0);
                *value = if is_nonzero[i] { magnitude[level].code(coder, *value) } else { 0 };
                active[i] += u8::from(is_nonzero[i]);
            }
        }
        true
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

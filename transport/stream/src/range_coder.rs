//! Adaptive binary arithmetic coding.
//!
//! A range coder with carry propagation (Martin 1979) of binary decisions, whose probabilities adapt at two rates at once.

use alloc::vec::Vec;

/// Probability of `false`, learnt from the decisions so far.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Probability {
    /// Mean over about 16 decisions.
    fast: u16,
    /// Mean over about 128 decisions.
    slow: u16,
}

impl Default for Probability {
    fn default() -> Self {
        Self { fast: 1 << 15, slow: 1 << 15 }
    }
}

const FAST: u16 = 4;
const SLOW: u16 = 7;
/// Bits of a probability in the coders.
const BITS: u32 = 15;

impl Probability {
    /// Returns the probability of `false`, in 1..2^15: the rounding of the shifts keeps both means off the ends.
    fn of_false(self) -> u32 {
        (u32::from(self.fast) + u32::from(self.slow)) >> 2
    }

    fn adapt(&mut self, bit: bool) {
        if bit {
            self.fast -= self.fast >> FAST;
            self.slow -= self.slow >> SLOW;
        } else {
            self.fast += (u16::MAX - self.fast) >> FAST;
            self.slow += (u16::MAX - self.slow) >> SLOW;
        }
    }
}

/// Coder of decisions in one direction. Generic code describes a format once for writing and reading.
pub(crate) trait BitCoder {
    /// Whether the coder writes: values are then known already.
    const WRITES: bool;

    /// Codes a decision: writes `bit` and returns it, or ignores it and returns the written one.
    #[inline]
    fn bit(&mut self, probability: &mut Probability, bit: bool) -> bool {
        let bit = self.divide(probability.of_false(), bit);
        probability.adapt(bit);
        bit
    }

    /// Narrows the range to one side of a decision, by the probability of `false` in 1..2^15; returns the decision.
    fn divide(&mut self, of_false: u32, bit: bool) -> bool;

    /// Codes the lowest `count` (at most 24) bits of a number without a model.
    fn raw(&mut self, count: u32, bits: u32) -> u32;
}

/// Range below which the coders scale up.
const LEAST_RANGE: u32 = 1 << 24;

/// Writing coder.
#[derive(Debug, Clone)]
pub(crate) struct RangeEncoder {
    low: u64,
    range: u32,
    /// Byte that a carry may still change, and number of bytes of 255 that follow it.
    cache: u8,
    waiting: usize,
    bytes: Vec<u8>,
    /// Index of the first coded byte.
    start: usize,
}

/// Position of an encoder.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mark {
    low: u64,
    range: u32,
    cache: u8,
    waiting: usize,
    len: usize,
}

impl RangeEncoder {
    /// Creates a coder that appends to `bytes`.
    pub fn new(bytes: Vec<u8>) -> Self {
        Self { low: 0, range: u32::MAX, cache: 0, waiting: 0, start: bytes.len(), bytes }
    }

    /// Returns an upper bound of the bytes that [`Self::finish`] would return now.
    pub fn len(&self) -> usize {
        self.bytes.len() + self.waiting + 6
    }

    /// Returns the present position.
    pub fn mark(&self) -> Mark {
        let Self { low, range, cache, waiting, ref bytes, .. } = *self;
        Mark { low, range, cache, waiting, len: bytes.len() }
    }

    /// Discards everything since the mark. A later carry cannot have changed a byte before it: those up to `len` were final.
    pub fn rewind(&mut self, mark: Mark) {
        let Mark { low, range, cache, waiting, len } = mark;
        self.bytes.truncate(len);
        (self.low, self.range, self.cache, self.waiting) = (low, range, cache, waiting);
    }

    /// Returns all bytes.
    pub fn finish(mut self) -> Vec<u8> {
        for _ in 0..5 {
            self.shift();
        }
        // The decoder reads zeros behind the end.
        while self.bytes.len() > self.start && self.bytes.last() == Some(&0) {
            self.bytes.pop();
        }
        self.bytes
    }

    fn shift(&mut self) {
        if self.low < 0xff00_0000 || self.low > u64::from(u32::MAX) {
            let carry = (self.low >> 32) as u8;
            self.bytes.push(self.cache.wrapping_add(carry));
            for _ in 0..core::mem::take(&mut self.waiting) {
                self.bytes.push(0xff_u8.wrapping_add(carry));
            }
            self.cache = (self.low >> 24) as u8;
        } else {
            self.waiting += 1;
        }
        self.low = (self.low & 0x00ff_ffff) << 8;
    }

    fn normalise(&mut self) {
        while self.range < LEAST_RANGE {
            self.range <<= 8;
            self.shift();
        }
    }
}

impl BitCoder for RangeEncoder {
    const WRITES: bool = true;

    #[inline]
    fn divide(&mut self, of_false: u32, bit: bool) -> bool {
        let bound = (self.range >> BITS) * of_false;
        if bit {
            self.low += u64::from(bound);
        }
        self.range = if bit { self.range - bound } else { bound };
        self.normalise();
        bit
    }

    fn raw(&mut self, count: u32, bits: u32) -> u32 {
        for at in (0..count).rev() {
            self.range >>= 1;
            if bits >> at & 1 == 1 {
                self.low += u64::from(self.range);
            }
            self.normalise();
        }
        bits
    }
}

/// Reading coder; behind the end of the bytes it reads zeros.
#[derive(Debug, Clone)]
pub(crate) struct RangeDecoder<'a> {
    range: u32,
    code: u32,
    bytes: &'a [u8],
}

impl<'a> RangeDecoder<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        let mut decoder = Self { range: u32::MAX, code: 0, bytes };
        for _ in 0..5 {
            decoder.code = decoder.code << 8 | decoder.next();
        }
        decoder
    }

    fn next(&mut self) -> u32 {
        let Some((first, rest)) = self.bytes.split_first() else { return 0 };
        self.bytes = rest;
        u32::from(*first)
    }

    fn normalise(&mut self) {
        while self.range < LEAST_RANGE {
            self.range <<= 8;
            self.code = self.code << 8 | self.next();
        }
    }
}

impl BitCoder for RangeDecoder<'_> {
    const WRITES: bool = false;

    #[inline]
    fn divide(&mut self, of_false: u32, _: bool) -> bool {
        let bound = (self.range >> BITS) * of_false;
        let bit = self.code >= bound;
        if bit {
            self.code -= bound;
        }
        self.range = if bit { self.range - bound } else { bound };
        self.normalise();
        bit
    }

    fn raw(&mut self, count: u32, _: u32) -> u32 {
        let mut bits = 0;
        for _ in 0..count {
            self.range >>= 1;
            let bit = self.code >= self.range;
            if bit {
                self.code -= self.range;
            }
            bits = bits << 1 | u32::from(bit);
            self.normalise();
        }
        bits
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn decisions_come_back_and_cost_their_entropy() {
        let mut random = StdRng::seed_from_u64(1);
        for share in [0.0, 0.001, 0.1, 0.5, 0.999, 1.0] {
            let bits: Vec<bool> = (0..50_000).map(|_| random.random::<f64>() < share).collect();
            let mut encoder = RangeEncoder::new(Vec::new());
            let mut probability = Probability::default();
            for (i, bit) in bits.iter().enumerate() {
                encoder.bit(&mut probability, *bit);
                if i % 100 == 0 {
                    encoder.raw(13, i as u32 & 0x1fff);
                }
            }
            let bytes = encoder.finish();
            let entropy = if share > 0.0 && share < 1.0 {
                -(share * f64::log2(share) + (1.0 - share) * f64::log2(1.0 - share))
            } else {
                0.0
            };
            let expected = (50_000.0 * entropy + 500.0 * 13.0) / 8.0;
            assert!((bytes.len() as f64) < 1.03 * expected + 120.0, "{share}: {} {expected}", bytes.len());
            let mut decoder = RangeDecoder::new(&bytes);
            let mut probability = Probability::default();
            for (i, bit) in bits.iter().enumerate() {
                assert_eq!(decoder.bit(&mut probability, false), *bit, "{share}: {i}");
                if i % 100 == 0 {
                    assert_eq!(decoder.raw(13, 0), i as u32 & 0x1fff);
                }
            }
        }
    }

    #[test]
    fn probabilities_stay_off_the_ends() {
        for bit in [false, true] {
            let mut probability = Probability::default();
            for _ in 0..10_000 {
                probability.adapt(bit);
                assert!((1..1 << BITS).contains(&probability.of_false()));
            }
        }
    }

    #[test]
    fn what_is_rewound_leaves_no_trace() {
        let mut random = StdRng::seed_from_u64(2);
        for _ in 0..200 {
            let (mut plain, mut rewound) = (RangeEncoder::new(Vec::new()), RangeEncoder::new(Vec::new()));
            let (mut p, mut q) = (Probability::default(), Probability::default());
            for _ in 0..30 {
                for _ in 0..random.random_range(0..40) {
                    let bit = random.random::<f64>() < 0.95;
                    plain.bit(&mut p, bit);
                    rewound.bit(&mut q, bit);
                }
                let (mark, kept) = (rewound.mark(), q);
                for _ in 0..random.random_range(0..40) {
                    rewound.bit(&mut q, random.random());
                }
                rewound.rewind(mark);
                q = kept;
            }
            assert_eq!(plain.finish(), rewound.finish());
        }
    }
}

//! Mutation of inputs.

use flyrig_model::SplitMix64;

/// Boundary values, inserted as bytes.
const NUMBERS: [i64; 16] = [
    0,
    1,
    -1,
    2,
    127,
    128,
    255,
    256,
    32_767,
    65_535,
    65_536,
    2_147_483_647,
    4_294_967_295,
    -2_147_483_648,
    i64::MAX,
    i64::MIN,
];
/// Boundary values, inserted as text.
const WORDS: [&str; 10] =
    ["nan", "-inf", "1e308", "1e-320", "-0.0", "\"", "\\", "\u{feff}", "99999999999999999999", "\0"];

/// Mutator of inputs; the same seed gives the same mutations.
pub struct Mutator {
    random: SplitMix64,
    /// Keywords of the target's format.
    words: &'static [&'static str],
}

impl Mutator {
    pub fn new(seed: u64, words: &'static [&'static str]) -> Self {
        Self { random: SplitMix64(seed.wrapping_mul(2).wrapping_add(1)), words }
    }

    fn below(&mut self, end: usize) -> usize {
        self.random.index(end)
    }

    /// Returns a random range of at most `most` bytes.
    fn stretch(&mut self, length: usize, most: usize) -> std::ops::Range<usize> {
        let from = self.below(length);
        let upto = (from + 1 + self.below(most)).min(length);
        from..upto.max(from)
    }

    /// Returns one of the inputs with one to eight mutations.
    pub fn child(&mut self, inputs: &[Vec<u8>], longest: usize) -> Vec<u8> {
        let mut child = inputs.get(self.below(inputs.len())).cloned().unwrap_or_default();
        let most = 1 << self.below(4);
        for _ in 0..1 + self.below(most) {
            self.change(&mut child, inputs);
        }
        child.truncate(longest);
        child
    }

    fn change(&mut self, bytes: &mut Vec<u8>, inputs: &[Vec<u8>]) {
        let at = self.below(bytes.len() + 1);
        match self.below(11) {
            0 if at < bytes.len() => bytes[at] ^= 1 << self.below(8),
            1 if at < bytes.len() => bytes[at] = self.random.next_u64() as u8,
            2 => bytes.truncate(at),
            3 => {
                let range = self.stretch(bytes.len(), 64);
                bytes.drain(range);
            }
            4 => {
                let range = self.stretch(bytes.len(), 64);
                let piece = bytes[range].to_vec();
                bytes.splice(at..at, piece);
            }
            // Splice a range of another input.
            5 => {
                let other = &inputs[self.below(inputs.len())];
                let range = self.stretch(other.len(), 256);
                let piece = other[range].to_vec();
                bytes.splice(at..at, piece);
            }
            // Overwrite bytes with a boundary value, in a random width and byte order.
            6 => {
                let number = NUMBERS[self.below(NUMBERS.len())];
                let width = 1 << self.below(4);
                let little = number.to_le_bytes();
                let mut number = little[..width].to_vec();
                if self.below(2) == 0 {
                    number.reverse();
                }
                let upto = (at + width).min(bytes.len());
                bytes[at..upto].copy_from_slice(&number[..upto - at]);
            }
            // Replace a number in the text.
            7 => self.number_text(bytes, at),
            8 if !self.words.is_empty() => {
                let word = self.words[self.below(self.words.len())];
                bytes.splice(at..at, word.bytes());
            }
            9 => {
                let word = WORDS[self.below(WORDS.len())];
                bytes.splice(at..at, word.bytes());
            }
            // Duplicate or delete a line.
            _ => {
                let start = bytes[..at].iter().rposition(|b| *b == b'\n').map_or(0, |i| i + 1);
                let end = bytes[at..].iter().position(|b| *b == b'\n').map_or(bytes.len(), |i| at + i + 1);
                let line = bytes[start..end].to_vec();
                if self.below(2) == 0 {
                    bytes.drain(start..end);
                } else if line.len() < 4096 {
                    bytes.splice(end..end, line);
                }
            }
        }
    }

    fn number_text(&mut self, bytes: &mut Vec<u8>, at: usize) {
        let is_digit = |b: &u8| b.is_ascii_digit();
        let Some(start) = bytes[at..].iter().position(is_digit).map(|i| at + i) else { return };
        let end = bytes[start..].iter().position(|b| !is_digit(b)).map_or(bytes.len(), |i| start + i);
        let text = match self.below(3) {
            0 => WORDS[self.below(WORDS.len())].to_owned(),
            _ => NUMBERS[self.below(NUMBERS.len())].to_string(),
        };
        bytes.splice(start..end, text.into_bytes());
    }
}

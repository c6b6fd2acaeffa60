//! Continuous sequence numbers over wraps and restarts of the driver's.

/// Jump above which the driver is taken to have restarted its numbers.
const JUMP: u32 = 100_000;

/// Extension of the driver's 32-bit numbers to continuous ones, across wraps and reconnects.
#[derive(Debug, Default)]
pub(crate) struct Sequence {
    last: Option<u32>,
    counted: u64,
    /// Frames numbered by the driver that were never received.
    pub lost: u64,
}

impl Sequence {
    /// Returns the continuous number of a frame.
    pub fn count(&mut self, number: u32) -> u64 {
        let ahead = self.last.map_or(1, |last| number.wrapping_sub(last));
        self.last = Some(number);
        let step = if (1..=JUMP).contains(&ahead) { u64::from(ahead) } else { 1 };
        self.lost += step - 1;
        self.counted += step;
        self.counted - 1
    }

    /// Treats the next frame as the first of a new driver sequence.
    pub fn restart(&mut self) {
        self.last = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_count_on_over_wraps_and_restarts() {
        let mut sequence = Sequence::default();
        let numbers = [u32::MAX - 1, u32::MAX, 0, 1, 4, 5].map(|n| sequence.count(n));
        assert_eq!((numbers, sequence.lost), ([0, 1, 2, 3, 6, 7], 2));
        sequence.restart();
        assert_eq!((sequence.count(0), sequence.count(1)), (8, 9));
        assert_eq!((sequence.count(1), sequence.count(0), sequence.count(3_000_000_000)), (10, 11, 12));
        assert_eq!(sequence.lost, 2, "a driver that counts anew has lost nothing that we know of");
    }
}

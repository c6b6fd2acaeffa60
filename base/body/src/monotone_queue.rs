//! Priority queue for keys that seldom come before the one taken last.

use std::{cmp::Reverse, collections::BinaryHeap};

/// Largest bucket; keys of later ones share its heap.
const LAST_BUCKET: usize = 65_535;

/// Queue that returns the lowest key first; fast where a pushed key is seldom below the one popped last, as in searches that
/// never go back. Keys wait in buckets, unsorted; only those of the current bucket are in a heap, which stays in
/// the processor's cache where a heap of hundreds of thousands of keys does not.
pub(crate) struct MonotoneQueue<K, B> {
    /// Returns the bucket of a key; ascending with it.
    bucket_of: B,
    buckets: Vec<Vec<K>>,
    current: BinaryHeap<Reverse<K>>,
    /// Bucket of `current`; lower ones are empty.
    bucket: usize,
}

impl<K: Ord + Copy, B: Fn(&K) -> usize> MonotoneQueue<K, B> {
    /// Creates an empty queue; `bucket_of` returns the bucket of a key, ascending with it. Keys beyond bucket 65,534
    /// share one heap.
    pub fn new(bucket_of: B) -> Self {
        Self { bucket_of, buckets: Vec::new(), current: BinaryHeap::new(), bucket: 0 }
    }

    /// Adds a key.
    pub fn push(&mut self, key: K) {
        let bucket = (self.bucket_of)(&key).min(LAST_BUCKET);
        if bucket <= self.bucket {
            self.current.push(Reverse(key));
            return;
        }
        if bucket >= self.buckets.len() {
            self.buckets.resize_with(bucket + 1, Vec::new);
        }
        self.buckets[bucket].push(key);
    }

    /// Takes the lowest key.
    pub fn pop(&mut self) -> Option<K> {
        while self.current.is_empty() {
            self.bucket += 1;
            let waiting = self.buckets.get_mut(self.bucket)?;
            self.current = std::mem::take(waiting).into_iter().map(Reverse).collect();
        }
        self.current.pop().map(|Reverse(key)| key)
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};

    use super::*;

    #[test]
    fn keys_come_in_the_order_of_a_plain_heap_also_when_others_are_added_between() {
        let mut rng = rand::rngs::StdRng::seed_from_u64(3);
        for (shift, from_bucket) in [(0, 0), (6, 0), (30, 0), (0, LAST_BUCKET - 2000), (0, usize::MAX - 10_000)] {
            let mut queue = MonotoneQueue::new(|key: &u32| from_bucket + (*key >> shift) as usize);
            let mut plain = BinaryHeap::new();
            for _ in 0..500 {
                let key = rng.random_range(0..5000);
                queue.push(key);
                plain.push(Reverse(key));
            }
            let mut taken = 0;
            while let Some(Reverse(expected)) = plain.pop() {
                assert_eq!(queue.pop(), Some(expected));
                taken += 1;
                if taken < 2000 && rng.random_range(0..3) > 0 {
                    // Seldom lower ones too.
                    let key = (expected + rng.random_range(0..300u32)).saturating_sub(20);
                    queue.push(key);
                    plain.push(Reverse(key));
                }
            }
            assert!(taken > 500 && queue.pop().is_none());
            // After its end it takes keys again.
            queue.push(9000);
            assert_eq!((queue.pop(), queue.pop()), (Some(9000), None));
        }
    }
}

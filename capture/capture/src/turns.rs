//! Merge of several threads' frames into the order of capture.

use std::sync::{Condvar, Mutex, MutexGuard};

use flyrig_types::{lock, wait};

/// Merge by time: a thread with a frame waits until no other can have an earlier one, while reading and decoding
/// proceed in parallel. Assumes that each thread's times increase; where they do not, only the order suffers.
#[derive(Debug)]
pub(crate) struct Turns {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug)]
struct State {
    /// Per thread the earliest time of its next frame; `None` when it has ended.
    earliest: Vec<Option<i64>>,
    closed: bool,
}

impl Turns {
    pub fn new(threads: usize) -> Self {
        Self {
            state: Mutex::new(State { earliest: vec![Some(i64::MIN); threads], closed: false }),
            changed: Condvar::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Waits until the frame at `nanos`, or the time until which the thread has none, is the earliest of all, the lower
    /// slot first among equals. Returns false when closed meanwhile.
    pub fn wait(&self, slot: usize, nanos: i64) -> bool {
        let mut state = self.lock();
        state.earliest[slot] = Some(nanos);
        self.changed.notify_all();
        while !state.closed {
            let is_first = state
                .earliest
                .iter()
                .enumerate()
                .all(|(other, earliest)| earliest.is_none_or(|earliest| (nanos, slot) <= (earliest, other)));
            if is_first {
                return true;
            }
            state = wait(&self.changed, state);
        }
        false
    }

    /// Marks the frame at `nanos` as delivered; the thread's next one is later.
    pub fn done(&self, slot: usize, nanos: i64) {
        self.lock().earliest[slot] = Some(nanos.saturating_add(1));
        self.changed.notify_all();
    }

    /// Marks that the thread yields no more frames.
    pub fn end(&self, slot: usize) {
        self.lock().earliest[slot] = None;
        self.changed.notify_all();
    }

    /// Releases all waiting threads.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }
}

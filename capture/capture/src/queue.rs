//! Bounded queue between live stages that drops the oldest element instead of blocking.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use flyrig_types::{lock, wait, wait_timeout};

/// Reason why [`LatestQueue::pop`] returned no element.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PopError {
    /// No element arrived in time.
    #[error("no element arrived in time")]
    Timeout,
    /// The queue is closed and empty.
    #[error("the queue is closed")]
    Closed,
}

/// Bounded FIFO queue: [`Self::push`] into a full queue drops the oldest element and counts it. Shared through an
/// `Arc`.
///
/// ```
/// use std::time::Duration;
///
/// use flyrig_capture::LatestQueue;
///
/// let queue = LatestQueue::new(2);
/// for frame in 0..3 {
///     queue.push(frame)?;
/// }
/// assert_eq!((queue.pop(Duration::ZERO), queue.dropped()), (Ok(1), 1));
/// # Ok::<(), i32>(())
/// ```
#[derive(Debug)]
pub struct LatestQueue<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
    capacity: usize,
}

#[derive(Debug)]
struct State<T> {
    items: VecDeque<T>,
    dropped: u64,
    closed: bool,
}

impl<T> LatestQueue<T> {
    /// Creates an empty queue with at least one slot.
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        let capacity = capacity.max(1);
        let state = State { items: VecDeque::with_capacity(capacity.min(1024)), dropped: 0, closed: false };
        Self { state: Mutex::new(state), changed: Condvar::new(), capacity }
    }

    /// Locks the state, which is consistent at every step: no code panics with the lock held.
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        lock(&self.state)
    }

    /// Appends an element without blocking. Returns the oldest element, as dropped, when the queue was full.
    ///
    /// # Errors
    /// Returns the element itself when the queue is closed, which does not count as a drop.
    pub fn push(&self, item: T) -> Result<Option<T>, T> {
        let mut state = self.lock();
        if state.closed {
            return Err(item);
        }
        let oldest = if state.items.len() >= self.capacity { state.items.pop_front() } else { None };
        state.dropped += u64::from(oldest.is_some());
        state.items.push_back(item);
        drop(state);
        self.changed.notify_all();
        Ok(oldest)
    }

    /// Appends an element, blocking until there is room (back-pressure); nothing is dropped.
    ///
    /// # Errors
    /// Returns the element when the queue is closed, before or during the wait.
    pub fn push_wait(&self, item: T) -> Result<(), T> {
        let mut state = self.lock();
        while !state.closed && state.items.len() >= self.capacity {
            state = wait(&self.changed, state);
        }
        if state.closed {
            return Err(item);
        }
        state.items.push_back(item);
        drop(state);
        self.changed.notify_all();
        Ok(())
    }

    /// Removes the oldest element, blocking until there is one.
    ///
    /// # Errors
    /// [`PopError::Timeout`], or [`PopError::Closed`] once a closed queue is empty.
    pub fn pop(&self, timeout: Duration) -> Result<T, PopError> {
        let deadline = Instant::now().checked_add(timeout);
        let mut state = self.lock();
        loop {
            if let Some(item) = state.items.pop_front() {
                drop(state);
                self.changed.notify_all();
                return Ok(item);
            }
            if state.closed {
                return Err(PopError::Closed);
            }
            // A time beyond the clock's end is for ever.
            let left = deadline.map_or(Duration::MAX, |deadline| deadline.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return Err(PopError::Timeout);
            }
            state =
                if deadline.is_none() { wait(&self.changed, state) } else { wait_timeout(&self.changed, state, left) };
        }
    }

    /// Rejects further elements and wakes all waiting threads; queued elements can still be removed.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    /// Returns whether [`Self::close`] was called.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.lock().closed
    }

    /// Returns the number of elements dropped because the queue was full.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.lock().dropped
    }

    /// Returns the number of queued elements.
    #[must_use]
    pub fn len(&self) -> usize {
        self.lock().items.len()
    }

    /// Returns whether the queue is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::Arc, thread};

    use super::*;

    const LONG: Duration = Duration::from_secs(60);

    #[test]
    fn a_full_queue_drops_the_oldest_and_counts() {
        let queue = LatestQueue::new(2);
        assert_eq!([queue.push(1), queue.push(2), queue.push(3)], [Ok(None), Ok(None), Ok(Some(1))]);
        assert_eq!((queue.dropped(), queue.len()), (1, 2));
        assert_eq!((queue.pop(LONG), queue.pop(LONG)), (Ok(2), Ok(3)));
        assert_eq!(queue.pop(Duration::ZERO), Err(PopError::Timeout));
        assert_eq!(LatestQueue::new(0).push(1), Ok(None), "one place at least");
    }

    #[test]
    fn a_closed_queue_is_emptied_and_then_says_so() {
        let queue = LatestQueue::new(2);
        queue.push(1).unwrap();
        queue.close();
        assert_eq!(queue.push(2), Err(2));
        assert_eq!(queue.push_wait(3), Err(3));
        assert_eq!((queue.pop(LONG), queue.pop(Duration::MAX)), (Ok(1), Err(PopError::Closed)));
        assert_eq!(queue.dropped(), 0);
    }

    #[test]
    fn pop_and_push_wait_for_each_other_and_close_frees_both() {
        let queue = Arc::new(LatestQueue::new(1));
        let writer = Arc::clone(&queue);
        let thread = thread::Builder::new().name("writer".into()).spawn(move || {
            for i in 0..1000 {
                writer.push_wait(i).unwrap();
            }
            let stuck = (writer.push_wait(1000), writer.push_wait(1001));
            assert_eq!(stuck, (Ok(()), Err(1001)));
        });
        for i in 0..1000 {
            assert_eq!(queue.pop(LONG), Ok(i));
        }
        while queue.is_empty() {
            thread::yield_now();
        }
        queue.close();
        thread.unwrap().join().unwrap();
        assert_eq!((queue.pop(LONG), queue.dropped()), (Ok(1000), 0));

        let empty = Arc::new(LatestQueue::<u8>::new(1));
        let reader = Arc::clone(&empty);
        let thread = thread::Builder::new().name("reader".into()).spawn(move || reader.pop(Duration::MAX));
        empty.close();
        assert_eq!(thread.unwrap().join().unwrap(), Err(PopError::Closed));
    }
}

//! Locks that a panicking thread leaves usable.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Locks a mutex, even a poisoned one. For values that are consistent at every step, so that a thread that panicked while it
/// held the lock left nothing half done.
///
/// ```
/// use std::sync::Mutex;
///
/// let frames = Mutex::new(3);
/// *flyrig_types::lock(&frames) += 1;
/// assert_eq!(*flyrig_types::lock(&frames), 4);
/// ```
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for a notification, like [`Condvar::wait`], and locks again as [`lock`] does.
pub fn wait<'a, T>(changed: &Condvar, guard: MutexGuard<'a, T>) -> MutexGuard<'a, T> {
    changed.wait(guard).unwrap_or_else(PoisonError::into_inner)
}

/// Waits for a notification for at most `timeout`, like [`Condvar::wait_timeout`], and locks again as [`lock`] does.
pub fn wait_timeout<'a, T>(changed: &Condvar, guard: MutexGuard<'a, T>, timeout: Duration) -> MutexGuard<'a, T> {
    changed.wait_timeout(guard, timeout).unwrap_or_else(PoisonError::into_inner).0
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn a_poisoned_lock_still_opens() {
        let value = Arc::new(Mutex::new(1));
        let held = Arc::clone(&value);
        let panicked = std::thread::Builder::new().spawn(move || {
            let mut value = lock(&held);
            *value = 2;
            panic!("while it holds the lock");
        });
        assert!(panicked.unwrap().join().is_err() && value.is_poisoned());
        assert_eq!(*lock(&value), 2);
        assert_eq!(*wait_timeout(&Condvar::new(), lock(&value), Duration::from_millis(1)), 2);
    }
}

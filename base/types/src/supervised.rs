//! Threads whose work is restarted after a panic.

use std::{
    io,
    sync::{Arc, Mutex, MutexGuard},
    thread::{Builder, JoinHandle, Thread},
    time::Instant,
};

use crate::locks::lock;
use crate::panics::caught;
use crate::restarts::Restarts;

/// Health of a thread.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ThreadHealth {
    /// The thread's name.
    pub name: String,
    /// Number of restarts after a panic.
    pub restarts: u64,
    /// Text of the last panic.
    pub panic: Option<String>,
    /// Whether the work has ended for good, after more panics in a row than [`Restarts`] allows.
    pub has_failed: bool,
}

/// Shared view of the health of a [`SupervisedThread`].
#[derive(Debug, Clone)]
pub struct ThreadWatch(Arc<Mutex<ThreadHealth>>);

impl ThreadWatch {
    /// Returns the thread's health now.
    #[must_use]
    pub fn health(&self) -> ThreadHealth {
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, ThreadHealth> {
        lock(&self.0)
    }
}

/// Thread whose work is restarted after a panic, as often in a row as [`Restarts`] allows; then it has failed for good.
///
/// ```
/// let mut thread = flyrig_types::SupervisedThread::start("worker", || ())?;
/// thread.join();
/// assert_eq!(thread.health().restarts, 0);
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Debug)]
pub struct SupervisedThread {
    watch: ThreadWatch,
    thread: Option<JoinHandle<()>>,
}

impl SupervisedThread {
    /// Starts a thread that runs `work` until it returns. Shortly after a panic `work` is called again; all state that it has
    /// touched must be consistent then.
    ///
    /// # Errors
    /// Error of the system when it starts no thread.
    pub fn start(name: &str, mut work: impl FnMut() + Send + 'static) -> io::Result<Self> {
        let health = ThreadHealth { name: name.to_owned(), ..ThreadHealth::default() };
        let watch = ThreadWatch(Arc::new(Mutex::new(health)));
        let of_thread = watch.clone();
        let thread = Builder::new().name(name.to_owned()).spawn(move || {
            let mut restarts = Restarts::default();
            while let Err(text) = caught(&mut work) {
                let due = restarts.after_failure(Instant::now());
                {
                    let mut health = of_thread.lock();
                    health.panic = Some(text);
                    health.has_failed = restarts.are_exhausted();
                    if health.has_failed {
                        break;
                    }
                }
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
                of_thread.lock().restarts += 1;
            }
            let _ = caught(move || drop(work));
        })?;
        Ok(Self { watch, thread: Some(thread) })
    }

    /// Returns a view of the thread's health that may outlive this.
    #[must_use]
    pub fn watch(&self) -> &ThreadWatch {
        &self.watch
    }

    /// Returns the thread's health now.
    #[must_use]
    pub fn health(&self) -> ThreadHealth {
        self.watch.health()
    }

    /// Returns the thread, to unpark it; `None` once it was joined.
    #[must_use]
    pub fn thread(&self) -> Option<&Thread> {
        self.thread.as_ref().map(JoinHandle::thread)
    }

    /// Waits for the end of the work. Does nothing when called again.
    pub fn join(&mut self) {
        // Panics of the work were caught inside.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    #[test]
    fn work_goes_on_after_a_panic() {
        let turns = Arc::new(AtomicU64::new(0));
        let of_thread = Arc::clone(&turns);
        let mut thread = SupervisedThread::start("worker", move || {
            if of_thread.fetch_add(1, Ordering::Relaxed) < 2 {
                panic!("out of luck");
            }
        })
        .unwrap();
        thread.join();
        let panic = Some("out of luck".to_owned());
        let expected = ThreadHealth { name: "worker".to_owned(), restarts: 2, panic, has_failed: false };
        assert_eq!((thread.health(), turns.load(Ordering::Relaxed)), (expected, 3));
    }

    #[test]
    fn work_that_panics_again_and_again_fails_for_good() {
        let turns = Arc::new(AtomicU64::new(0));
        let of_thread = Arc::clone(&turns);
        let mut thread = SupervisedThread::start("worker", move || {
            let turn = of_thread.fetch_add(1, Ordering::Relaxed);
            panic!("turn {turn}");
        })
        .unwrap();
        let watch = thread.watch().clone();
        thread.join();
        let health = watch.health();
        assert_eq!((health.restarts, health.panic.as_deref(), health.has_failed), (5, Some("turn 5"), true));
        assert_eq!(turns.load(Ordering::Relaxed), 6);
    }
}

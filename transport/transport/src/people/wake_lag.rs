//! Scheduling delay of a thread that only waits: on a busy computer, messages are ingested late although the line is fast.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

/// Interval at which the thread should run.
pub(crate) const TICK: Duration = Duration::from_millis(20);
/// Largest number of instants reported at once: more are missed only by a computer that slept.
const MOST_TICKS: u32 = 64;

/// Instants at which the thread should run.
#[derive(Debug)]
pub(crate) struct Ticks {
    next: Instant,
}

impl Ticks {
    pub fn new(now: Instant) -> Self {
        Self { next: now + TICK }
    }

    /// Calls `late` with the delay of each instant that has passed: messages that arrived at these instants would have waited as long for a
    /// thread that runs only now.
    pub fn run(&mut self, now: Instant, mut late: impl FnMut(Duration)) {
        for _ in 0..MOST_TICKS {
            let Some(by) = now.checked_duration_since(self.next) else { return };
            late(by);
            self.next += TICK;
        }
        self.next = self.next.max(now);
    }

    /// Returns the time until the next instant.
    pub fn wait(&self, now: Instant) -> Duration {
        self.next.saturating_duration_since(now)
    }
}

/// Thread that measures the delay.
#[derive(Debug)]
pub(crate) struct WakeLag {
    is_stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl WakeLag {
    /// Starts the thread, which calls `late` as [`Ticks::run`] does until it is dropped.
    pub fn start(mut late: impl FnMut(Duration) + Send + 'static) -> io::Result<Self> {
        let is_stopped = Arc::new(AtomicBool::new(false));
        let should_stop = Arc::clone(&is_stopped);
        let thread = std::thread::Builder::new().name("flyrig-wake-lag".to_owned()).spawn(move || {
            let mut ticks = Ticks::new(Instant::now());
            while !should_stop.load(Ordering::Relaxed) {
                std::thread::park_timeout(ticks.wait(Instant::now()));
                ticks.run(Instant::now(), &mut late);
            }
        })?;
        Ok(Self { is_stopped, thread: Some(thread) })
    }
}

impl Drop for WakeLag {
    fn drop(&mut self) {
        self.is_stopped.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            if thread.join().is_err() {
                tracing::warn!("the thread that measures scheduling delays has panicked");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::sync_channel;

    use super::*;

    #[test]
    fn every_instant_that_passed_is_as_late_as_a_message_would_be() {
        let start = Instant::now();
        let mut ticks = Ticks::new(start);
        let mut run = |at: Duration| {
            let mut late = Vec::new();
            ticks.run(start + at, |by| late.push(by.as_millis()));
            (late, ticks.wait(start + at).as_millis())
        };
        let at = Duration::from_millis;
        assert_eq!(run(at(5)), (vec![], 15));
        assert_eq!(run(at(20)), (vec![0], 20));
        // Early, then 90 ms late.
        assert_eq!(run(at(39)), (vec![], 1));
        assert_eq!(run(at(130)), (vec![90, 70, 50, 30, 10], 10));
        // A computer that slept for a day goes on with the present.
        let (late, wait) = run(Duration::from_secs(86_400));
        assert_eq!((late.len(), wait), (MOST_TICKS as usize, 0));
        assert_eq!(run(Duration::from_secs(86_400) + at(20)).0, [20, 0]);
    }

    #[test]
    fn the_thread_runs_until_it_is_dropped() {
        let (sender, receiver) = sync_channel(4);
        let lag = WakeLag::start(move |by| {
            let _ = sender.try_send(by);
        })
        .unwrap();
        for _ in 0..3 {
            receiver.recv_timeout(Duration::from_secs(60)).unwrap();
        }
        drop(lag);
        // The thread has ended and given the sender back.
        while receiver.recv_timeout(Duration::ZERO).is_ok() {}
        assert_eq!(receiver.try_recv(), Err(std::sync::mpsc::TryRecvError::Disconnected));
    }
}

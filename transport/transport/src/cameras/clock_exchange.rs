//! Queries of other computers' clocks, and their answers.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_types::{SupervisedThread, ThreadWatch};
use zenoh::{
    Session, Wait,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, Query},
};

use crate::{
    cameras::{host_clock::HostClock, host_id::HostId},
    error::TransportError,
};

/// Interval between two queries of a clock: at first, and later.
const EAGER: Duration = Duration::from_millis(50);
const CALM: Duration = Duration::from_millis(250);
/// Time limit of an answer.
const PATIENCE: Duration = Duration::from_secs(1);

/// Answers queries with the clock's time until the session ends.
pub(crate) fn answer(session: &Session, key: String, clock: HostClock) -> Result<(), zenoh::Error> {
    session
        .declare_queryable(key)
        .callback(move |query: Query| {
            let answered = query.reply(query.key_expr(), clock.now_nanos().to_le_bytes()).express(true).wait();
            if let Err(error) = answered {
                tracing::debug!(%error, "could not answer a query of the clock");
            }
        })
        .background()
        .wait()
}

/// Pending query of a clock.
pub(crate) struct ClockQuery {
    /// Key of the query.
    pub key: String,
    /// Identity of the computer.
    pub host: HostId,
    /// Whether more answers are needed soon.
    pub is_urgent: bool,
}

/// Thread that queries the clocks of all hosts repeatedly.
pub(crate) struct Asker {
    stop: Arc<AtomicBool>,
    thread: SupervisedThread,
}

impl Asker {
    /// Starts the thread. `hosts` returns the queries to send now; `take` is called with the host, the local send time, the remote time and
    /// the local receive time, nanoseconds.
    pub(crate) fn start(
        session: Session,
        clock: HostClock,
        hosts: impl Fn() -> Vec<ClockQuery> + Send + 'static,
        take: impl Fn(&HostId, i64, i64, i64) + Send + Sync + 'static,
    ) -> Result<Self, TransportError> {
        let stop = Arc::new(AtomicBool::new(false));
        let (stopped, take) = (stop.clone(), Arc::new(take));
        let work = move || {
            let mut calm_at = Instant::now();
            while !stopped.load(Ordering::Relaxed) {
                let now = Instant::now();
                let all = now >= calm_at;
                if all {
                    calm_at = now + CALM;
                }
                for query in hosts().into_iter().filter(|query| all || query.is_urgent) {
                    ask(&session, &clock, &query, take.clone());
                }
                std::thread::park_timeout(EAGER);
            }
        };
        let thread =
            SupervisedThread::start("clocks", work).map_err(|error| TransportError::session("clock thread", &error))?;
        Ok(Self { stop, thread })
    }

    pub(crate) fn watch(&self) -> &ThreadWatch {
        self.thread.watch()
    }

    pub(crate) fn stop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.thread() {
            thread.unpark();
        }
        self.thread.join();
    }
}

fn ask<T>(session: &Session, clock: &HostClock, query: &ClockQuery, take: Arc<T>)
where
    T: Fn(&HostId, i64, i64, i64) + Send + Sync + 'static,
{
    let (host, clock) = (query.host.clone(), clock.clone());
    let of_answer = clock.clone();
    let asked = clock.now_nanos();
    let sent = session
        .get(&query.key)
        // Otherwise the answer is held back until the query is closed, which would add to the round trip.
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .express(true)
        .timeout(PATIENCE)
        .callback(move |reply| {
            let answered = of_answer.now_nanos();
            let Ok(sample) = reply.result() else { return };
            // An answer of another length is ignored.
            if let Ok(time) = <[u8; 8]>::try_from(&*sample.payload().to_bytes()) {
                take(&host, asked, i64::from_le_bytes(time), answered);
            }
        })
        .wait();
    if let Err(error) = sent {
        tracing::debug!(%error, "could not query a clock");
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU64;

    use super::*;
    use crate::testing::{loopback_session, wait_until};

    fn asker(hosts: impl Fn() -> Vec<ClockQuery> + Send + 'static) -> Asker {
        Asker::start(loopback_session(), HostClock::new(|| 0), hosts, |_, _, _, _| {}).unwrap()
    }

    #[test]
    fn clocks_are_asked_again_after_a_panic() {
        let asked = Arc::new(AtomicU64::new(0));
        let of_thread = asked.clone();
        let mut asker = asker(move || {
            let turn = of_thread.fetch_add(1, Ordering::Relaxed);
            assert!(turn != 2, "turn {turn}");
            Vec::new()
        });
        wait_until("more turns", || asked.load(Ordering::Relaxed) > 5);
        let health = asker.watch().health();
        assert_eq!((health.name.as_str(), health.restarts, health.panic.as_deref()), ("clocks", 1, Some("turn 2")));
        asker.stop();
    }

    #[test]
    fn an_asker_that_panics_repeatedly_fails_for_good() {
        let mut asker = asker(|| panic!("no turn works"));
        wait_until("the end", || asker.watch().health().has_failed);
        asker.stop();
    }
}

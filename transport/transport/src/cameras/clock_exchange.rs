//! Questions for another computer's clock, and their answers.

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

use crate::{cameras::host_clock::HostClock, error::TransportError};

/// Between two questions: at first, and later.
const EAGER: Duration = Duration::from_millis(50);
const CALM: Duration = Duration::from_millis(250);
/// An answer later than this is none.
const PATIENCE: Duration = Duration::from_secs(1);

/// Answers with the clock's time until the session ends.
pub(crate) fn answer(session: &Session, key: String, clock: HostClock) -> Result<(), zenoh::Error> {
    session
        .declare_queryable(key)
        .callback(move |query: Query| {
            let answered = query.reply(query.key_expr(), clock.now_nanos().to_le_bytes()).express(true).wait();
            if let Err(error) = answered {
                tracing::debug!(%error, "a question for the clock was not answered");
            }
        })
        .background()
        .wait()
}

/// Whom to ask: a key, what to do with the answer (asked, answer, answered; our clock but for the second), and whether
/// more answers are wanted soon.
pub(crate) struct Question {
    pub key: String,
    pub host: u64,
    pub is_urgent: bool,
}

/// Asks every host again and again, in a thread.
pub(crate) struct Asker {
    stop: Arc<AtomicBool>,
    thread: SupervisedThread,
}

impl Asker {
    /// `hosts` gives whom to ask now; `take` gets host, time of the question, answer and time of the answer.
    pub(crate) fn start(
        session: Session,
        clock: HostClock,
        hosts: impl Fn() -> Vec<Question> + Send + 'static,
        take: impl Fn(u64, i64, i64, i64) + Send + Sync + 'static,
    ) -> Result<Self, TransportError> {
        let stop = Arc::new(AtomicBool::new(false));
        let (stopped, take) = (stop.clone(), Arc::new(take));
        let work = move || {
            let mut calm_at = Instant::now();
            while !stopped.load(Ordering::Relaxed) {
                let now = Instant::now();
                let everybody = now >= calm_at;
                if everybody {
                    calm_at = now + CALM;
                }
                for question in hosts().into_iter().filter(|question| everybody || question.is_urgent) {
                    ask(&session, &clock, &question, take.clone());
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

fn ask<T>(session: &Session, clock: &HostClock, question: &Question, take: Arc<T>)
where
    T: Fn(u64, i64, i64, i64) + Send + Sync + 'static,
{
    let (host, clock) = (question.host, clock.clone());
    let of_answer = clock.clone();
    let asked = clock.now_nanos();
    let sent = session
        .get(&question.key)
        // Else the answer is held back until the question is closed, which would count as its way.
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .express(true)
        .timeout(PATIENCE)
        .callback(move |reply| {
            let answered = of_answer.now_nanos();
            let Ok(sample) = reply.result() else { return };
            // A length that is not ours says nothing, whoever sent it.
            if let Ok(time) = <[u8; 8]>::try_from(&*sample.payload().to_bytes()) {
                take(host, asked, i64::from_le_bytes(time), answered);
            }
        })
        .wait();
    if let Err(error) = sent {
        tracing::debug!(%error, "a clock could not be asked");
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU64;

    use super::*;
    use crate::{
        session::{
            config::TransportConfig,
            opening::{self, Opened},
        },
        testing::wait_until,
    };

    fn asker(hosts: impl Fn() -> Vec<Question> + Send + 'static) -> Asker {
        let config = TransportConfig { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..TransportConfig::default() };
        let Opened { session, .. } = opening::open(&config, 1 << 16, &[]).unwrap();
        Asker::start(session, HostClock::new(|| 0), hosts, |_, _, _, _| {}).unwrap()
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
    fn an_asker_that_panics_again_and_again_fails_for_good() {
        let mut asker = asker(|| panic!("no turn works"));
        wait_until("the end", || asker.watch().health().has_failed);
        asker.stop();
    }
}

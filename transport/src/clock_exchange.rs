//! Questions for another computer's clock, and their answers.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use zenoh::{
    Session, Wait,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, Query},
};

use crate::{HostClock, TransportError};

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
    thread: Option<JoinHandle<()>>,
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
        let thread = std::thread::Builder::new()
            .name("flyrig-clocks".to_owned())
            .spawn(work)
            .map_err(|error| TransportError::session("clock thread", &error))?;
        Ok(Self { stop, thread: Some(thread) })
    }

    pub(crate) fn stop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            // A panic there has nothing to tell that its absence does not.
            let _ = thread.join();
        }
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

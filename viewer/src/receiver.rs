//! Keeps people, cameras and statistics as they come from a rig.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_stream::{StreamError, Template, stamp_of};
use flyrig_transport::{Interests, PersonMessage, RigStats, Subscriber, TransportConfig, TransportError};
use flyrig_types::{Rig, SupervisedThread, ThreadHealth};

use crate::StreamPerson;

/// How long a message is waited for.
const PATIENCE: Duration = Duration::from_millis(50);

/// How often statistics and calibration are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// How long a template is waited for; asked again later.
const TEMPLATE_PATIENCE: Duration = Duration::from_secs(10);
/// Pause after a template that did not come.
const TEMPLATE_RETRY: Duration = Duration::from_millis(500);
/// Rates are means over this time.
const RATE_OVER: Duration = Duration::from_secs(2);
/// Most people that are kept.
const MOST_PEOPLE: usize = 32;
/// Colour messages that wait for their template.
const MOST_WAITING: usize = 64;

/// State of a rig as it was received; lock it briefly.
#[derive(Debug, Default)]
pub struct ReceiverState {
    /// People by their number.
    pub people: BTreeMap<u32, StreamPerson>,
    /// The rig's cameras and its up.
    pub rig: Option<Rig>,
    /// The rig's statistics, about every second.
    pub stats: Option<RigStats>,
    /// The last thing that went wrong, and when.
    pub problem: Option<(Instant, String)>,
    /// Number of publishers of this rig that live now.
    pub publishers: usize,
    /// Age of the newest motion when it came, seconds, and whether both ends run on one host so that it is exact.
    pub age: Option<(f64, bool)>,
    /// Arrival, bytes and whether it was a motion, of the last messages.
    recent: VecDeque<(Instant, usize, bool)>,
}

impl ReceiverState {
    /// Returns bytes and motions a second.
    #[must_use]
    pub fn rates(&self, now: Instant) -> (f64, f64) {
        let recent = self.recent.iter().filter(|(at, ..)| now.saturating_duration_since(*at) < RATE_OVER);
        let (bytes, motions) = recent
            .fold((0, 0u32), |(bytes, motions), (_, size, is_motion)| (bytes + size, motions + u32::from(*is_motion)));
        (bytes as f64 / RATE_OVER.as_secs_f64(), f64::from(motions) / RATE_OVER.as_secs_f64())
    }

    /// Describes in words what keeps people from being shown; None while somebody is.
    #[must_use]
    pub fn trouble(&self, rig: &str, endpoint: &str) -> Option<String> {
        if self.publishers == 0 {
            return Some(format!(
                "No rig '{rig}' at {endpoint} yet: check that `flyrig run` is up, --rig and --connect"
            ));
        }
        if self.rig.is_none() {
            return Some("Waiting for the rig's calibration".to_owned());
        }
        if self.people.is_empty() {
            return Some("The rig is up; nobody has been seen yet".to_owned());
        }
        None
    }

    fn complain(&mut self, text: String) {
        tracing::debug!("{text}");
        self.problem = Some((Instant::now(), text));
    }

    fn count(&mut self, now: Instant, bytes: usize, is_motion: bool) {
        self.recent.push_back((now, bytes, is_motion));
        while self.recent.front().is_some_and(|(at, ..)| now.saturating_duration_since(*at) > RATE_OVER) {
            self.recent.pop_front();
        }
    }
}

/// Receives on a thread of its own until it is dropped.
pub struct Receiver {
    state: Arc<Mutex<ReceiverState>>,
    stop: Arc<AtomicBool>,
    thread: SupervisedThread,
}

impl Receiver {
    /// Connects to a rig, which may come later. `arrived` is called after each motion that came.
    ///
    /// # Errors
    /// [`TransportError`] when the session cannot be opened or no thread started.
    pub fn start(config: &TransportConfig, arrived: impl Fn() + Send + 'static) -> Result<Self, TransportError> {
        let interests = Interests { people: true, stats: true, ..Interests::default() };
        let subscriber = Subscriber::open(config, &interests)?;
        let (state, stop) = (Arc::new(Mutex::new(ReceiverState::default())), Arc::new(AtomicBool::new(false)));
        let (shared, ended) = (Arc::clone(&state), Arc::clone(&stop));
        let work = move || {
            // Begun anew after a panic: what it left behind may be anything.
            lock(&shared).people.clear();
            let mut link =
                Link { subscriber: &subscriber, state: &shared, waiting: VecDeque::new(), asked: None, looked: None };
            while !ended.load(Ordering::Relaxed) {
                link.turn(&arrived);
            }
        };
        let thread = SupervisedThread::start("receive", work).map_err(|error| TransportError {
            kind: flyrig_transport::TransportErrorKind::Session,
            topic: "receiver".to_owned(),
            message: format!("cannot start its thread: {error}"),
        })?;
        Ok(Self { state, stop, thread })
    }

    /// The state as it is now.
    pub fn state(&self) -> MutexGuard<'_, ReceiverState> {
        lock(&self.state)
    }

    /// Health of the thread.
    #[must_use]
    pub fn thread(&self) -> ThreadHealth {
        self.thread.health()
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join();
    }
}

/// Every change of the state is whole at each step.
fn lock(state: &Mutex<ReceiverState>) -> MutexGuard<'_, ReceiverState> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

/// State of the receiving thread.
struct Link<'a> {
    subscriber: &'a Subscriber,
    state: &'a Mutex<ReceiverState>,
    /// Messages of people whose template is on its way.
    waiting: VecDeque<PersonMessage>,
    /// Template that was asked for last without an answer.
    asked: Option<(u64, Instant)>,
    /// When statistics and calibration were looked at last.
    looked: Option<Instant>,
}

impl Link<'_> {
    fn turn(&mut self, arrived: &impl Fn()) {
        if self.looked.is_none_or(|at| at.elapsed() >= LOOK_EVERY) {
            self.looked = Some(Instant::now());
            self.look();
        }
        match self.subscriber.next_person(PATIENCE) {
            Ok(Some(received)) => {
                let now = Instant::now();
                let is_motion = received.body.layer.is_none();
                let capture_nanos = received.header.capture_nanos;
                {
                    let mut state = lock(self.state);
                    state.count(now, received.body.bytes.len(), is_motion);
                    if is_motion {
                        let is_exact = received.latency_is_exact;
                        let own_clock = is_exact.then(|| age_secs(capture_nanos)).flatten();
                        // Of another host only the way since the publisher's hand-in is known.
                        let way = received.latency_nanos as f64 / 1e9;
                        state.age = Some((own_clock.unwrap_or(way), own_clock.is_some()));
                    }
                }
                self.take(received.body, now);
                if is_motion {
                    arrived();
                }
            }
            Ok(None) => {}
            Err(error) => lock(self.state).complain(error.to_string()),
        }
    }

    /// Takes in statistics and calibration.
    fn look(&self) {
        let stats = self.subscriber.next_stats(Duration::ZERO);
        let rig = self.subscriber.rig(Duration::ZERO);
        let mut state = lock(self.state);
        state.publishers = self.subscriber.publishers();
        for error in [stats.as_ref().err(), rig.as_ref().err()].into_iter().flatten() {
            state.complain(error.to_string());
        }
        if let Ok(Some(stats)) = stats {
            state.stats = Some(stats.body);
        }
        if let Ok(Some(rig)) = rig {
            state.rig = Some(rig);
        }
    }

    fn take(&mut self, message: PersonMessage, now: Instant) {
        let taken = give(self.state, &message, now);
        match taken {
            Ok(()) => {}
            Err(StreamError::OtherTemplate { .. }) if message.layer.is_none() => {
                let Ok(stamp) = stamp_of(&message.bytes) else { return };
                self.meet(message.person, stamp.template);
                // A motion is shown as soon as its template is there; those after it come by themselves.
                if give(self.state, &message, now).is_ok() {
                    for colors in std::mem::take(&mut self.waiting) {
                        drop(give(self.state, &colors, now));
                    }
                }
            }
            Err(StreamError::OtherTemplate { .. }) => {
                self.waiting.push_back(message);
                while self.waiting.len() > MOST_WAITING {
                    self.waiting.pop_front();
                }
            }
            Err(error) => lock(self.state).complain(format!("person {}: {error}", message.person)),
        }
    }

    /// Fetches a template and makes its person.
    fn meet(&mut self, person: u32, hash: u64) {
        let refused = |(asked, at): (u64, Instant)| asked == hash && at.elapsed() < TEMPLATE_RETRY;
        if self.asked.is_some_and(refused) {
            return;
        }
        match self.subscriber.template(hash, TEMPLATE_PATIENCE) {
            Ok(Some(bytes)) => {
                let template = match Template::decode(&bytes) {
                    Ok(template) => template,
                    Err(error) => return self.refuse(hash, error.to_string()),
                };
                let mut state = lock(self.state);
                if state.people.len() >= MOST_PEOPLE && !state.people.contains_key(&person) {
                    state.people.pop_first();
                }
                state.people.insert(person, StreamPerson::new(Arc::new(template)));
                self.asked = None;
            }
            Ok(None) => self.asked = Some((hash, Instant::now())),
            Err(error) => self.refuse(hash, error.to_string()),
        }
    }

    fn refuse(&mut self, hash: u64, problem: String) {
        self.asked = Some((hash, Instant::now()));
        lock(self.state).complain(problem);
    }
}

/// Hands a message to its person; one who is not known has another template.
fn give(state: &Mutex<ReceiverState>, message: &PersonMessage, now: Instant) -> Result<(), StreamError> {
    let mut state = lock(state);
    let Some(person) = state.people.get_mut(&message.person) else {
        return Err(StreamError::OtherTemplate { what: "message" });
    };
    match message.layer {
        None => person.take_motion(&message.bytes, now),
        Some(_) => person.take_colors(&message.bytes).map(drop),
    }
}

/// Age of a capture time of this host's `CLOCK_MONOTONIC`, seconds.
pub(crate) fn age_secs(capture_nanos: i64) -> Option<f64> {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    let nanos = now.tv_sec.checked_mul(1_000_000_000)?.checked_add(now.tv_nsec)?;
    // A simulated or recorded source has a clock of its own.
    Some((nanos - capture_nanos) as f64 / 1e9).filter(|age| (0.0..60.0).contains(age))
}

//! Keeps people, cameras and statistics as they come from a rig.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_stream::StreamTemplate;
use flyrig_transport::{
    FetchedTemplate, Interests, PersonMessage, RigStats, Subscriber, TemplateFetcher, TransportConfig, TransportError,
};
use flyrig_types::{Rig, SupervisedThread, ThreadHealth};
use flyrig_viewing::{Ingested, People};

/// How long a message is waited for.
const PATIENCE: Duration = Duration::from_millis(50);

/// How often statistics and calibration are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// Rates are means over this time.
const RATE_OVER: Duration = Duration::from_secs(2);

/// State of a rig as it was received; lock it briefly.
#[derive(Debug, Default)]
pub struct ReceiverState {
    /// People; their clock is [`clock_secs`].
    pub people: People,
    /// The rig's cameras and its up.
    pub rig: Option<Rig>,
    /// The rig's statistics, about every second.
    pub stats: Option<RigStats>,
    /// The last thing that went wrong, and when.
    pub problem: Option<(Instant, String)>,
    /// Number of publishers of this rig that live now.
    pub publishers: usize,
    /// Reason why the rig does not admit the key, while it does not.
    pub refusal: Option<String>,
    /// Layers of colours that come, from the coarsest.
    pub color_layers: usize,
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
            return self.refusal.clone().or_else(|| {
                Some(format!("No rig '{rig}' at {endpoint} yet: check that `flyrig run` is up, --rig and --connect"))
            });
        }
        if self.rig.is_none() {
            return Some("Waiting for the rig's calibration".to_owned());
        }
        if self.people.is_empty() {
            return Some("The rig is up; nobody has been seen yet".to_owned());
        }
        None
    }

    /// Returns the age of a capture time, seconds; None where no clock of this host is known for it.
    #[must_use]
    pub fn age_of(&self, capture_nanos: i64) -> Option<f64> {
        age_secs(capture_nanos, self.stats.as_ref().and_then(|stats| stats.clock_offset_nanos))
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
        let mut templates = subscriber.template_fetcher()?;
        let (state, stop) = (Arc::new(Mutex::new(ReceiverState::default())), Arc::new(AtomicBool::new(false)));
        let (shared, ended) = (Arc::clone(&state), Arc::clone(&stop));
        let work = move || {
            // Begun anew after a panic: what it left behind may be anything.
            lock(&shared).people.clear();
            let mut link = Link { subscriber: &subscriber, state: &shared, templates: &mut templates, looked: None };
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
    templates: &'a mut TemplateFetcher,
    /// When statistics and calibration were looked at last.
    looked: Option<Instant>,
}

impl Link<'_> {
    fn turn(&mut self, arrived: &impl Fn()) {
        if self.looked.is_none_or(|at| at.elapsed() >= LOOK_EVERY) {
            self.looked = Some(Instant::now());
            self.look();
        }
        match self.templates.take() {
            Ok(Some(fetched)) => self.meet(&fetched),
            Ok(None) => {}
            Err(error) => lock(self.state).complain(error.to_string()),
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
                        let own_clock = is_exact.then(|| state.age_of(capture_nanos)).flatten();
                        // Of another host only the way since the publisher's hand-in is known.
                        let way = received.latency_nanos as f64 / 1e9;
                        state.age = Some((own_clock.unwrap_or(way), own_clock.is_some()));
                    }
                }
                self.take(&received.body);
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
        state.refusal = self.subscriber.trouble();
        state.color_layers = self.subscriber.color_layers();
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

    fn take(&mut self, message: &PersonMessage) {
        let is_motion = message.layer.is_none();
        let taken = lock(self.state).people.ingest(message.person, is_motion, &message.bytes, clock_secs());
        match taken {
            // Colours wait for the motion beside them, which is shown as soon as its template is there.
            Ok(Ingested::Needs(template)) if is_motion => self.templates.ask(message.person, template),
            Ok(_) => {}
            Err(error) => lock(self.state).complain(format!("person {}: {error}", message.person)),
        }
    }

    /// Makes the people of a template.
    fn meet(&mut self, fetched: &FetchedTemplate) {
        match StreamTemplate::decode(&fetched.bytes).map(Arc::new) {
            Ok(template) => {
                let mut state = lock(self.state);
                fetched.people.iter().for_each(|person| state.people.set_template(*person, Arc::clone(&template)));
            }
            Err(error) => {
                self.templates.refuse(fetched.hash);
                lock(self.state).complain(error.to_string());
            }
        }
    }
}

/// This host's `CLOCK_MONOTONIC`, seconds: the clock that [`ReceiverState::people`] is kept by.
#[must_use]
pub fn clock_secs() -> f64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as f64 + now.tv_nsec as f64 / 1e9
}

/// Age of a capture time, seconds: of this host's `CLOCK_MONOTONIC`, or of a clock that is `offset_nanos` behind it. None where neither can be.
#[must_use]
pub fn age_secs(capture_nanos: i64, offset_nanos: Option<i64>) -> Option<f64> {
    let now = clock_secs();
    let age = |offset: i64| Some(now - capture_nanos.saturating_add(offset) as f64 / 1e9);
    let is_possible = |age: &f64| (0.0..60.0).contains(age);
    // A simulated or recorded source has a clock of its own.
    age(0).filter(is_possible).or_else(|| age(offset_nanos?).filter(is_possible))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ages_are_of_the_clock_that_is_possible() {
        let now = (clock_secs() * 1e9) as i64;
        let near = |age: Option<f64>, expected: f64| age.is_some_and(|age| (age - expected).abs() < 5.0);
        assert!(near(age_secs(now - 20_000_000_000, None), 20.0));
        // A camera's frame needs some time to arrive, which is part of its age.
        assert!(near(age_secs(now - 20_000_000_000, Some(10_000_000_000)), 20.0));
        let other = now + 3_600_000_000_000;
        assert!(age_secs(other, None).is_none());
        assert!(near(age_secs(other, Some(-3_630_000_000_000)), 30.0));
        for capture in [i64::MIN, i64::MAX] {
            assert!(age_secs(capture, Some(capture)).is_none());
        }
    }
}

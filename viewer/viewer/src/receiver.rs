//! Receiver of people, cameras and statistics of a rig.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Mutex, MutexGuard,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_stream::StreamTemplate;
use flyrig_transport::{
    FetchedTemplate, Interests, PersonMessage, RigStats, Subscriber, TemplateFetcher, TransportConfig, TransportError,
};
use flyrig_types::{Rig, SupervisedThread, ThreadHealth, lock};
use flyrig_viewing::{Ingested, People};

/// Time limit of waiting for a message.
const PATIENCE: Duration = Duration::from_millis(50);

/// Interval between checks of statistics and calibration.
const CHECK_EVERY: Duration = Duration::from_millis(250);
/// Time over which rates are averaged.
const RATE_OVER: Duration = Duration::from_secs(2);

/// Received state of a rig; lock it briefly.
#[derive(Debug, Default)]
pub struct ReceiverState {
    /// People, whose clock is [`clock_secs`].
    pub people: People,
    /// Cameras and up direction of the rig.
    pub rig: Option<Rig>,
    /// Statistics of the rig, updated about every second.
    pub stats: Option<RigStats>,
    /// Arrival of the statistics.
    pub stats_at: Option<Instant>,
    /// Time and text of the last problem.
    pub problem: Option<(Instant, String)>,
    /// Number of live publishers of this rig.
    pub publishers: usize,
    /// Why the rig rejects the key; `None` once it accepts it.
    pub refusal: Option<String>,
    /// Number of subscribed colour layers, from the coarsest.
    pub color_layers: usize,
    /// Whether the line to the rig is why layers are missing.
    pub is_line_slow: bool,
    /// Age of the newest motion at its arrival, seconds, and whether it is exact because both ends run on one host.
    pub age: Option<(f64, bool)>,
    /// Arrival and bytes of the last messages, and whether each was a motion.
    recent: VecDeque<(Instant, usize, bool)>,
}

impl ReceiverState {
    /// Returns the rates of bytes and motions, per second.
    #[must_use]
    pub fn rates(&self, now: Instant) -> (f64, f64) {
        let recent = self.recent.iter().filter(|(at, ..)| now.saturating_duration_since(*at) < RATE_OVER);
        let (bytes, motions) = recent
            .fold((0, 0u32), |(bytes, motions), (_, size, is_motion)| (bytes + size, motions + u32::from(*is_motion)));
        (bytes as f64 / RATE_OVER.as_secs_f64(), f64::from(motions) / RATE_OVER.as_secs_f64())
    }

    /// Explains why no people are shown; `None` while there are.
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
        self.people.is_empty().then(|| self.absence())
    }

    /// Explains why nobody is shown while the rig is up.
    #[must_use]
    pub fn absence(&self) -> String {
        let Some(stats) = &self.stats else { return "Asking the rig".to_owned() };
        if let Some(secs) = stats.measuring_secs {
            let since = self.stats_at.map_or(0.0, |at| at.elapsed().as_secs_f64());
            return format!("Somebody is being measured ({:.0} s)", secs + since);
        }
        let is_seen = stats.subjects.iter().any(|subject| !matches!(subject.state.as_str(), "lost" | "searching"));
        (if is_seen { "Somebody is seen, and is on the way here" } else { "Nobody is seen" }).to_owned()
    }

    /// Returns the age of a capture time, seconds; `None` where no clock of this host is known for it.
    #[must_use]
    pub fn age_of(&self, capture_nanos: i64) -> Option<f64> {
        age_secs(capture_nanos, self.stats.as_ref().and_then(|stats| stats.clock_offset_nanos))
    }

    /// Records a problem.
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

/// Receiver on a thread of its own, until it is dropped.
pub struct Receiver {
    state: Arc<Mutex<ReceiverState>>,
    stop: Arc<AtomicBool>,
    thread: SupervisedThread,
}

impl Receiver {
    /// Connects to a rig, which may start later. `arrived` is called after each motion.
    ///
    /// # Errors
    /// [`TransportError`] when the session cannot be opened or the thread cannot be started.
    pub fn start(config: &TransportConfig, arrived: impl Fn() + Send + 'static) -> Result<Self, TransportError> {
        let interests = Interests { people: true, stats: true, ..Interests::default() };
        let subscriber = Subscriber::open(config, &interests)?;
        let mut templates = subscriber.template_fetcher()?;
        let (state, stop) = (Arc::new(Mutex::new(ReceiverState::default())), Arc::new(AtomicBool::new(false)));
        let (shared, ended) = (Arc::clone(&state), Arc::clone(&stop));
        let work = move || {
            // After a panic the state may be inconsistent.
            lock(&shared).people.clear();
            let mut link = Link { subscriber: &subscriber, state: &shared, templates: &mut templates, checked: None };
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

    /// Locks and returns the present state.
    pub fn state(&self) -> MutexGuard<'_, ReceiverState> {
        lock(&self.state)
    }

    /// Returns the health of the thread.
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

/// State of the receiving thread.
struct Link<'a> {
    subscriber: &'a Subscriber,
    state: &'a Mutex<ReceiverState>,
    templates: &'a mut TemplateFetcher,
    /// Time of the last check of statistics and calibration.
    checked: Option<Instant>,
}

impl Link<'_> {
    fn turn(&mut self, arrived: &impl Fn()) {
        if self.checked.is_none_or(|at| at.elapsed() >= CHECK_EVERY) {
            self.checked = Some(Instant::now());
            self.ingest_status();
        }
        match self.templates.take() {
            Ok(Some(fetched)) => self.set_template(&fetched),
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
                        // For another host only the latency since the publisher's hand-in is known.
                        let latency = received.latency_nanos as f64 / 1e9;
                        state.age = Some((own_clock.unwrap_or(latency), own_clock.is_some()));
                    }
                }
                self.ingest(&received.body);
                if is_motion {
                    arrived();
                }
            }
            Ok(None) => {}
            Err(error) => lock(self.state).complain(error.to_string()),
        }
    }

    /// Ingests statistics and calibration.
    fn ingest_status(&self) {
        let stats = self.subscriber.next_stats(Duration::ZERO);
        let rig = self.subscriber.rig(Duration::ZERO);
        let mut state = lock(self.state);
        state.publishers = self.subscriber.publishers();
        state.refusal = self.subscriber.trouble();
        state.color_layers = self.subscriber.color_layers();
        state.is_line_slow = self.subscriber.is_line_slow();
        for error in [stats.as_ref().err(), rig.as_ref().err()].into_iter().flatten() {
            state.complain(error.to_string());
        }
        if let Ok(Some(stats)) = stats {
            (state.stats, state.stats_at) = (Some(stats.body), Some(Instant::now()));
        }
        if let Ok(Some(rig)) = rig {
            state.rig = Some(rig);
        }
    }

    /// Ingests a message of the person stream.
    fn ingest(&mut self, message: &PersonMessage) {
        let is_motion = message.layer.is_none();
        let ingested = lock(self.state).people.ingest(message.person, is_motion, &message.bytes, clock_secs());
        match ingested {
            // Colours wait for the motion beside them, which is shown as soon as its template has arrived.
            Ok(Ingested::Needs(template)) if is_motion => self.templates.ask(message.person, template),
            Ok(_) => {}
            Err(error) => lock(self.state).complain(format!("person {}: {error}", message.person)),
        }
    }

    /// Sets a template for its people.
    fn set_template(&mut self, fetched: &FetchedTemplate) {
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

/// Returns this host's `CLOCK_MONOTONIC`, seconds, the clock of [`ReceiverState::people`].
#[must_use]
pub fn clock_secs() -> f64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as f64 + now.tv_nsec as f64 / 1e9
}

/// Returns the age of a capture time, seconds, by this host's `CLOCK_MONOTONIC`, or by a clock that is `offset_nanos` behind it; `None` where
/// neither is plausible.
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
    fn the_reason_why_nobody_is_shown_is_true() {
        let mut state = ReceiverState::default();
        assert!(state.trouble("studio", "tcp/rig:7447").unwrap().starts_with("No rig 'studio' at tcp/rig:7447 yet"));
        state.publishers = 1;
        assert_eq!(state.trouble("studio", "").unwrap(), "Waiting for the rig's calibration");
        state.rig = Some(Rig { cameras: Vec::new(), world_up: glam::DVec3::Z });
        assert_eq!(state.trouble("studio", "").unwrap(), "Asking the rig");
        let subject = |state: &str| flyrig_transport::SubjectStats { state: state.to_owned(), ..Default::default() };
        for (measuring_secs, subjects, expected) in [
            (None, vec![], "Nobody is seen"),
            (None, vec![subject("lost"), subject("searching")], "Nobody is seen"),
            (None, vec![subject("lost"), subject("first")], "Somebody is seen, and is on the way here"),
            (Some(12.2), vec![], "Somebody is being measured (12 s)"),
        ] {
            state.stats = Some(RigStats { measuring_secs, subjects, ..RigStats::default() });
            assert_eq!(state.trouble("studio", "").unwrap(), expected);
        }
    }

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

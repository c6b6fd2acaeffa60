//! Relay: receives the people of a rig, and publishes them to viewers of its own.

use std::{
    net::SocketAddr,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_stream::stamp_of;
use flyrig_types::{Rig, SupervisedThread, ThreadHealth};

use crate::{
    error::TransportError,
    people::{
        person_stream::PersonMessage,
        template_fetcher::{FetchedTemplate, TemplateFetcher},
    },
    publisher::Publisher,
    session::config::TransportConfig,
    subscriber::{Interests, Received, Subscriber},
    topic::lock,
};

/// Time limit of waiting for a message.
const PATIENCE: Duration = Duration::from_millis(50);
/// Interval between checks of statistics and calibration.
const CHECK_EVERY: Duration = Duration::from_millis(250);
/// Largest number of templates kept; the oldest is forgotten, and fetched again when a motion names it.
const MAX_TEMPLATES: usize = 64;

/// Relay of people, calibration and statistics of a rig to programs of this computer and holders of keys of the relay's own ring. The rig
/// sends them once for any number of viewers, and a slow viewer slows the relay alone. While the rig is absent, so is the relay. Viewpoints
/// are not passed on: viewers draw people themselves.
#[derive(Debug)]
pub struct Relay {
    shared: Arc<Shared>,
    thread: SupervisedThread,
}

#[derive(Debug, Default)]
struct Shared {
    stop: AtomicBool,
    state: Mutex<State>,
}

#[derive(Debug, Clone, Default)]
struct State {
    trouble: Option<String>,
    gate: Option<SocketAddr>,
}

impl Relay {
    /// Starts to receive from a rig, which may start later, with the settings `from`, and to publish with the settings `to`.
    ///
    /// # Errors
    /// `Config` or `Session` of either side; the publishing side is opened once and closed again, since it lives with the rig.
    pub fn start(from: &TransportConfig, to: &TransportConfig) -> Result<Self, TransportError> {
        let subscriber = Subscriber::open(from, &Interests { people: true, stats: true, ..Interests::default() })?;
        let templates = subscriber.template_fetcher()?;
        drop(Publisher::open(to)?);
        let shared = Arc::<Shared>::default();
        let (of_thread, to) = (Arc::clone(&shared), to.clone());
        let mut work = Work {
            subscriber,
            templates,
            to,
            shared: of_thread,
            outlet: None,
            known: Vec::new(),
            calibration: None,
            checked: None,
        };
        let thread = SupervisedThread::start("relay", move || {
            // The work restarts after a panic.
            work.outlet = None;
            while !work.shared.stop.load(Ordering::Relaxed) {
                work.turn();
            }
        });
        let thread = thread.map_err(|error| TransportError::session("relay", &error))?;
        Ok(Self { shared, thread })
    }

    /// Returns the address where holders of keys connect; `None` without keys, and while the rig is absent.
    #[must_use]
    pub fn gate(&self) -> Option<SocketAddr> {
        lock(&self.shared.state).gate
    }

    /// Returns why people are not passed on; `None` while they are.
    #[must_use]
    pub fn trouble(&self) -> Option<String> {
        lock(&self.shared.state).trouble.clone()
    }

    /// Returns the health of the thread.
    #[must_use]
    pub fn thread(&self) -> ThreadHealth {
        self.thread.health()
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.thread.join();
    }
}

struct Work {
    subscriber: Subscriber,
    templates: TemplateFetcher,
    to: TransportConfig,
    shared: Arc<Shared>,
    outlet: Option<Publisher>,
    /// Person and hash of the templates that the outlet has.
    known: Vec<(u32, u64)>,
    /// Calibration of the outlet.
    calibration: Option<Rig>,
    /// Time of the last check of statistics and calibration.
    checked: Option<Instant>,
}

impl Work {
    fn turn(&mut self) {
        if self.checked.is_none_or(|at| at.elapsed() >= CHECK_EVERY) {
            self.checked = Some(Instant::now());
            let trouble = self.follow_rig().err().map(|error| error.to_string());
            let gate = self.outlet.as_ref().and_then(Publisher::gate);
            *lock(&self.shared.state) = State { trouble, gate };
        }
        match self.templates.take() {
            Ok(Some(fetched)) => self.offer_template(fetched),
            Ok(None) => {}
            Err(error) => tracing::debug!("{error}"),
        }
        match self.subscriber.next_person(PATIENCE) {
            Ok(Some(received)) => self.pass(received),
            Ok(None) => {}
            Err(error) => tracing::debug!("{error}"),
        }
    }

    /// Opens the outlet when the rig appears, closes it when the rig disappears, and passes calibration and statistics on.
    fn follow_rig(&mut self) -> Result<(), TransportError> {
        if self.subscriber.publishers() == 0 {
            self.outlet = None;
            let rig = &self.to.rig;
            let trouble = self
                .subscriber
                .trouble()
                .unwrap_or_else(|| "does not answer yet; check that `flyrig run` is up".to_owned());
            return Err(TransportError::session(format!("rig {rig}"), &trouble));
        }
        let Some(rig) = self.subscriber.rig(Duration::ZERO)? else {
            return Ok(());
        };
        if self.outlet.is_none() {
            self.known.clear();
            self.calibration = None;
            self.outlet = Some(Publisher::open(&self.to)?);
            // The motions that came before are lost, and those of a slow rig are rare.
            self.subscriber.fetch_motions();
        }
        let Some(outlet) = &self.outlet else { return Ok(()) };
        if self.calibration.as_ref() != Some(&rig) {
            outlet.set_calibration(&rig)?;
            self.calibration = Some(rig);
        }
        if let Some(stats) = self.subscriber.next_stats(Duration::ZERO)? {
            outlet.publish_stats(&stats.body)?;
        }
        Ok(())
    }

    /// Offers a template to the viewers.
    fn offer_template(&mut self, FetchedTemplate { people, hash, bytes }: FetchedTemplate) {
        let Some(outlet) = &self.outlet else { return };
        let bytes = prost::bytes::Bytes::from(bytes);
        for person in people {
            outlet.offer_template(person, hash, bytes.clone());
            self.known.retain(|(of, _)| *of != person);
            self.known.push((person, hash));
        }
        let over = self.known.len().saturating_sub(MAX_TEMPLATES);
        self.known.drain(..over);
    }

    /// Passes a message on, or requests its template.
    fn pass(&mut self, received: Received<PersonMessage>) {
        let Some(outlet) = &self.outlet else { return };
        let Ok(stamp) = stamp_of(&received.body.bytes) else { return };
        let person = received.body.person;
        if self.known.contains(&(person, stamp.template)) {
            outlet.pass_on(received);
        } else {
            // Motion and colours of a template that has not arrived yet are repeated.
            self.templates.ask(person, stamp.template);
        }
    }
}

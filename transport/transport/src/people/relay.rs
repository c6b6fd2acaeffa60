//! A relay: receives people of a rig, and publishes them to viewers of its own.

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

/// How long a message is waited for.
const PATIENCE: Duration = Duration::from_millis(50);
/// How often statistics and calibration are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// Templates that are kept; beyond them the oldest is forgotten, and fetched again when a motion names it.
const MAX_TEMPLATES: usize = 64;

/// Passes people, calibration and statistics of a rig on to whoever connects here: programs of this computer, and holders of keys of the
/// relay's own ring. The rig sends them once, however many watch, and a slow viewer is the relay's alone. While the rig is away, so is
/// the relay. Viewpoints are not passed on: viewers draw people themselves.
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
    /// Starts to receive from one rig, which may come later, and to publish as another config says.
    ///
    /// # Errors
    /// `Config` or `Session` of either side; the publishing side is tried once and ends again, since it lives with the rig.
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
            looked: None,
        };
        let thread = SupervisedThread::start("relay", move || {
            // Begun anew after a panic.
            work.outlet = None;
            while !work.shared.stop.load(Ordering::Relaxed) {
                work.turn();
            }
        });
        let thread = thread.map_err(|error| TransportError::session("relay", &error))?;
        Ok(Self { shared, thread })
    }

    /// Address where holders of keys connect; None without keys, and while the rig is away.
    #[must_use]
    pub fn gate(&self) -> Option<SocketAddr> {
        lock(&self.shared.state).gate
    }

    /// Returns the reason why people are not passed on; None while they are.
    #[must_use]
    pub fn trouble(&self) -> Option<String> {
        lock(&self.shared.state).trouble.clone()
    }

    /// Health of the thread.
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
    /// Person and hash of templates that the outlet has.
    known: Vec<(u32, u64)>,
    /// That of the outlet.
    calibration: Option<Rig>,
    looked: Option<Instant>,
}

impl Work {
    fn turn(&mut self) {
        if self.looked.is_none_or(|at| at.elapsed() >= LOOK_EVERY) {
            self.looked = Some(Instant::now());
            let trouble = self.look().err().map(|error| error.to_string());
            let gate = self.outlet.as_ref().and_then(Publisher::gate);
            *lock(&self.shared.state) = State { trouble, gate };
        }
        match self.templates.take() {
            Ok(Some(fetched)) => self.meet(fetched),
            Ok(None) => {}
            Err(error) => tracing::debug!("{error}"),
        }
        match self.subscriber.next_person(PATIENCE) {
            Ok(Some(received)) => self.pass(received),
            Ok(None) => {}
            Err(error) => tracing::debug!("{error}"),
        }
    }

    /// Opens the outlet when the rig has come, closes it when the rig has gone, and passes calibration and statistics on.
    fn look(&mut self) -> Result<(), TransportError> {
        if self.subscriber.publishers() == 0 {
            self.outlet = None;
            let rig = &self.to.rig;
            let trouble = self
                .subscriber
                .trouble()
                .unwrap_or_else(|| "is not there yet; check that `flyrig run` is up".to_owned());
            return Err(TransportError::session(format!("rig {rig}"), &trouble));
        }
        let Some(rig) = self.subscriber.rig(Duration::ZERO)? else {
            return Ok(());
        };
        if self.outlet.is_none() {
            self.known.clear();
            self.calibration = None;
            self.outlet = Some(Publisher::open(&self.to)?);
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

    fn meet(&mut self, FetchedTemplate { people, hash, bytes }: FetchedTemplate) {
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

    fn pass(&mut self, received: Received<PersonMessage>) {
        let Some(outlet) = &self.outlet else { return };
        let Ok(stamp) = stamp_of(&received.body.bytes) else { return };
        let person = received.body.person;
        if self.known.contains(&(person, stamp.template)) {
            outlet.pass_on(received);
        } else {
            // Motion and colours of a template that is not here yet come again.
            self.templates.ask(person, stamp.template);
        }
    }
}

//! Topics of the person stream, and templates by their hash.
//!
//! A template is fetched in chunks beside motion, before colours are subscribed to.

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use crossbeam::channel::bounded;
use flyrig_stream::LAYERS;
use prost::bytes::Bytes;
use zenoh::{Session, Wait, query::Query};

use crate::{
    drain::PublisherState,
    error::TransportError,
    header::MessageKind,
    inbox::Inbox,
    keys::{self, MAX_PERSON_TOPICS},
    people::{
        catch_up::{CatchUp, Missing},
        chunks::{CHUNK, ask_template},
        present::PresentPeople,
        wake_lag::WakeLag,
    },
    topic::{Topic, lock},
};

/// Largest number of waiting queries for chunks, over all viewers.
const MAX_QUERIES: usize = 1024;
/// Message of the person stream, still encoded.
#[derive(Debug, Clone, PartialEq)]
pub struct PersonMessage {
    /// Number of the person.
    pub person: u32,
    /// Layer of a message of colours; `None` for a motion.
    pub layer: Option<usize>,
    /// Bytes for [`flyrig_stream::Motion::decode`] or [`flyrig_stream::ColorDecoder::ingest`].
    pub bytes: Bytes,
}

/// Topics of a person: motion, then the layers of colours.
type Topics = [Arc<Topic>; 1 + LAYERS];

/// People whose stream is published.
#[derive(Debug)]
pub(crate) struct PublishedPeople {
    /// Topics of person 0, which always exist, so that subscribers are noticed before a person is seen.
    first: Topics,
    /// Topics of the other people, most recently published last.
    others: Mutex<Vec<(u32, Topics)>>,
    /// Person, hash and bytes of each template, newest last.
    templates: Mutex<Vec<(u32, u64, Bytes)>>,
    /// Last motion and colours of each person, for viewers that join.
    pub present: PresentPeople,
}

fn topics_of(person: u32) -> Topics {
    std::array::from_fn(|i| {
        let (label, kind) = match i.checked_sub(1) {
            None => (keys::motion_label(person), MessageKind::Motion),
            Some(layer) => (keys::color_label(person, layer), MessageKind::Colors),
        };
        Arc::new(Topic::new(label.clone(), label, kind))
    })
}

impl PublishedPeople {
    pub fn new() -> Self {
        let present = PresentPeople::default();
        Self { first: topics_of(0), others: Mutex::default(), templates: Mutex::default(), present }
    }

    /// Returns the topics of person 0.
    pub fn first_topics(&self) -> Topics {
        self.first.clone()
    }

    pub fn is_watched(&self) -> bool {
        self.first[0].is_watched()
    }

    /// Returns the topics of a person and creates those of a new one; beyond [`MAX_PERSON_TOPICS`] the person published least recently
    /// loses them.
    pub fn topics(&self, person: u32, shared: &PublisherState) -> Topics {
        if person == 0 {
            return self.first.clone();
        }
        let mut others = lock(&self.others);
        if let Some(at) = others.iter().position(|(other, _)| *other == person) {
            others[at..].rotate_left(1);
            return others[others.len() - 1].1.clone();
        }
        let topics = topics_of(person);
        let mut all = lock(&shared.topics);
        if others.len() >= MAX_PERSON_TOPICS {
            let (_, oldest) = others.remove(0);
            oldest.iter().for_each(|topic| drop(all.remove(&topic.label)));
        }
        all.extend(topics.iter().map(|topic| (topic.label.clone(), topic.clone())));
        others.push((person, topics.clone()));
        topics
    }

    pub fn offer_template(&self, person: u32, hash: u64, bytes: Bytes) {
        let mut templates = lock(&self.templates);
        templates.retain(|(other, ..)| *other != person);
        if templates.len() > MAX_PERSON_TOPICS {
            templates.remove(0);
        }
        templates.push((person, hash, bytes));
    }

    /// Returns the reply to a query; `None` for an unknown one.
    fn reply(&self, label: &str) -> Option<Vec<u8>> {
        if label == keys::LAST_MOTIONS {
            return Some(self.present.motions(Instant::now()));
        }
        match keys::whole_colors_in(label) {
            Some((person, first_layer)) => self.present.colors_hash(person, first_layer, Instant::now()),
            None => self.chunk(label),
        }
    }

    /// Returns the reply to a query for a chunk: size of the template or of the colours, u32, and a part of its bytes.
    fn chunk(&self, label: &str) -> Option<Vec<u8>> {
        let (hash, chunk) = keys::chunk_in(label)?;
        let template =
            lock(&self.templates).iter().find(|(_, known, _)| *known == hash).map(|(.., bytes)| bytes.clone());
        let bytes = template.or_else(|| self.present.colors(hash))?;
        let first = (chunk as usize).checked_mul(CHUNK).filter(|first| *first < bytes.len())?;
        let mut reply = (bytes.len() as u32).to_le_bytes().to_vec();
        reply.extend(&bytes[first..bytes.len().min(first + CHUNK)]);
        Some(reply)
    }
}

/// Starts a thread that answers queries for templates, and returns the callback that hands them in without waiting; the thread ends when
/// the callback is dropped. The network's thread must not answer: where it also sends, replies find no room until it has sent some.
pub(crate) fn answer_templates(
    people: Arc<PublishedPeople>,
) -> Result<impl Fn(Query) + Send + Sync + 'static, TransportError> {
    let (queries, waiting) = bounded::<Query>(MAX_QUERIES);
    std::thread::Builder::new()
        .name("flyrig-answers".to_owned())
        .spawn(move || waiting.into_iter().for_each(|query| answer_template(&people, &query)))
        .map_err(|error| TransportError::session("thread for templates", &error))?;
    // A query that does not fit is not answered, and repeated by the viewer.
    Ok(move |query| drop(queries.try_send(query)))
}

/// Answers a query for a known template or the present state; another publisher may have an unknown one.
fn answer_template(people: &PublishedPeople, query: &Query) {
    let Some(reply) = keys::label_in(query.key_expr().as_str()).and_then(|label| people.reply(label)) else { return };
    if let Err(error) = query.reply(query.key_expr(), reply).wait() {
        tracing::warn!(%error, "could not answer a request for a template");
    }
}

type Subscription = zenoh::pubsub::Subscriber<()>;

/// Subscriptions to the person stream. Until the first template has arrived, nothing else is of use, and on a slow line it would delay the
/// template: motion pauses while it is fetched, and colours begin with it. Their layers follow [`Inbox::color_layers`].
pub(crate) struct PersonSubscription {
    session: Session,
    rig: String,
    inbox: Arc<Inbox>,
    motion: Mutex<Option<Subscription>>,
    /// Subscriptions to layers of colours, from the coarsest.
    layers: Mutex<Vec<Subscription>>,
    /// Thread that measures scheduling delays, started with motion.
    wake_lag: Mutex<Option<WakeLag>>,
    /// Thread that fetches what was published before, started with motion.
    catch_up: Mutex<Option<CatchUp>>,
    /// People whose templates have arrived.
    known: Mutex<BTreeSet<u32>>,
}

impl std::fmt::Debug for PersonSubscription {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PersonSubscription").field("rig", &self.rig).finish_non_exhaustive()
    }
}

impl PersonSubscription {
    pub fn new(session: &Session, rig: &str, inbox: &Arc<Inbox>) -> Self {
        let (session, rig, inbox) = (session.clone(), rig.to_owned(), inbox.clone());
        Self {
            session,
            rig,
            inbox,
            motion: Mutex::default(),
            layers: Mutex::default(),
            wake_lag: Mutex::default(),
            catch_up: Mutex::default(),
            known: Mutex::default(),
        }
    }

    /// Fetches the last motions, and the colours of all known people: the rig has appeared, or appeared again.
    pub fn rig_appeared(&self) {
        self.miss(Missing::Motions);
        lock(&self.known).iter().for_each(|person| self.miss(Missing::Colors { person: *person, first_layer: 0 }));
    }

    /// Fetches the present state of people whose template the reader has taken.
    pub fn template_taken(&self, people: &[u32]) {
        if let Some(first) = people.first() {
            // A motion that came before its template is lost to readers that keep none.
            self.miss(Missing::Motions);
            let mut known = lock(&self.known);
            known.extend(people);
            while known.len() > MAX_PERSON_TOPICS + 1 && known.first() != Some(first) {
                known.pop_first();
            }
        }
        people.iter().for_each(|person| self.miss(Missing::Colors { person: *person, first_layer: 0 }));
    }

    fn miss(&self, missing: Missing) {
        if let Some(catch_up) = &*lock(&self.catch_up) {
            catch_up.fetch(missing);
        }
    }

    fn subscribe(&self, part: &str) -> Result<Subscription, TransportError> {
        let inbox = self.inbox.clone();
        let key = keys::key(&self.rig, &format!("{}*/{part}", keys::PERSON));
        self.session
            .declare_subscriber(&key)
            .callback(move |sample| inbox.receive(&sample))
            .wait()
            .map_err(|error| TransportError::session(key, &error))
    }

    /// Subscribes to motion, unless it is subscribed already.
    pub fn begin_motion(&self) -> Result<(), TransportError> {
        let mut wake_lag = lock(&self.wake_lag);
        if wake_lag.is_none() {
            let inbox = Arc::downgrade(&self.inbox);
            let measure = move |by| inbox.upgrade().into_iter().for_each(|inbox| inbox.woke_late(by));
            match WakeLag::start(measure) {
                Ok(started) => *wake_lag = Some(started),
                Err(error) => {
                    tracing::warn!(%error, "no thread measures scheduling delays: on a busy computer colours may stop");
                }
            }
        }
        drop(wake_lag);
        let mut catch_up = lock(&self.catch_up);
        if catch_up.is_none() {
            *catch_up = Some(CatchUp::start(&self.session, &self.rig, &self.inbox)?);
        }
        drop(catch_up);
        let mut motion = lock(&self.motion);
        if motion.is_none() {
            *motion = Some(self.subscribe(keys::MOTION)?);
        }
        Ok(())
    }

    /// Subscribes to as many layers as the line carries; never waits for the line.
    pub fn follow(&self) {
        let wanted = self.inbox.color_layers();
        let mut layers = lock(&self.layers);
        let before = layers.len();
        if before != wanted {
            tracing::debug!(before, wanted, "layers of colours");
        }
        while layers.len() > wanted {
            if let Some(Err(error)) = layers.pop().map(|layer| layer.undeclare().wait()) {
                tracing::warn!(%error, "colours cannot be unsubscribed");
            }
        }
        while layers.len() < wanted {
            match self.subscribe(&format!("{}{}", keys::COLOR, layers.len())) {
                Ok(layer) => layers.push(layer),
                Err(error) => return tracing::warn!(%error, "colours cannot be received"),
            }
        }
        drop(layers);
        let missed = self.inbox.take_missed_colors();
        // A fast rig refreshes everything within a second.
        if self.inbox.is_rig_slow() {
            let colors = |person: u32, first_layer: usize| self.miss(Missing::Colors { person, first_layer });
            missed.into_iter().for_each(|person| colors(person, 0));
            if wanted > before {
                lock(&self.known).iter().for_each(|person| colors(*person, before));
            }
        }
    }

    /// Fetches a template as [`ask_template`] does; colours are subscribed to from then on.
    pub fn ask_template(&self, hash: u64, timeout: Duration) -> Result<Option<Vec<u8>>, TransportError> {
        // A person that is shown already keeps moving.
        let paused = if self.inbox.have_colors_begun() { None } else { lock(&self.motion).take() };
        let was_watching = paused.is_some();
        drop(paused);
        self.inbox.fetch_begins();
        let begun = Instant::now();
        let answer = ask_template(&self.session, &self.rig, hash, timeout);
        let bytes = answer.as_ref().ok().and_then(Option::as_ref).map_or(0, Vec::len);
        tracing::debug!(
            hash = format!("{hash:016x}"),
            bytes,
            secs = begun.elapsed().as_secs_f64(),
            "fetched a template"
        );
        self.inbox.fetch_ends(bytes);
        if was_watching {
            self.begin_motion()?;
        }
        let answer = answer?;
        if answer.is_some() {
            self.inbox.begin_colors();
            self.follow();
        }
        Ok(answer)
    }
}

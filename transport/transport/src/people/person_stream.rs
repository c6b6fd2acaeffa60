//! Topics of the person stream, and templates by their hash.
//!
//! A template is fetched in chunks beside motion, before colours are subscribed to.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use crossbeam::channel::bounded;
use flyrig_stream::{LAYERS, MAX_TEMPLATE_BYTES, template_hash};
use prost::bytes::Bytes;
use zenoh::{
    Session, Wait,
    handlers::FifoChannelHandler,
    qos::{CongestionControl, Priority},
    query::{Query, Reply},
};

use crate::{
    drain::PublisherState,
    error::TransportError,
    header::MessageKind,
    inbox::Inbox,
    keys::{self, MAX_PERSON_TOPICS},
    people::wake_lag::WakeLag,
    topic::{Topic, lock},
};

/// Bytes of a template per reply, which fit in one batch of zenoh's, so that a slow line drops no fragments.
const CHUNK: usize = 60_000;
/// Chunks under way at once: enough for 20 Mbit/s with 100 ms, and fewer than the places in the sender's queue.
const AT_ONCE: usize = 6;
/// Largest number of waiting queries for chunks, over all viewers.
const MAX_QUERIES: usize = 1024;
/// Time limit of a chunk.
const CHUNK_PATIENCE: Duration = Duration::from_secs(5);

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
        Self { first: topics_of(0), others: Mutex::default(), templates: Mutex::default() }
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

    /// Returns the reply to a query: size of the template, u32, and a chunk of its bytes.
    fn chunk(&self, label: &str) -> Option<Vec<u8>> {
        let (hash, chunk) = keys::chunk_in(label)?;
        let bytes =
            lock(&self.templates).iter().find(|(_, known, _)| *known == hash).map(|(.., bytes)| bytes.clone())?;
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

/// Answers a query for a known template; another publisher may have an unknown one.
fn answer_template(people: &PublishedPeople, query: &Query) {
    let Some(reply) = keys::label_in(query.key_expr().as_str()).and_then(|label| people.chunk(label)) else { return };
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
}

impl PersonSubscription {
    pub fn new(session: &Session, rig: &str, inbox: &Arc<Inbox>) -> Self {
        let (session, rig, inbox) = (session.clone(), rig.to_owned(), inbox.clone());
        Self { session, rig, inbox, motion: Mutex::default(), layers: Mutex::default(), wake_lag: Mutex::default() }
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
        if layers.len() != wanted {
            tracing::debug!(before = layers.len(), wanted, "layers of colours");
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

/// Fetches a template in chunks, some of them under way at once, and checks its hash.
fn ask_template(session: &Session, rig: &str, hash: u64, timeout: Duration) -> Result<Option<Vec<u8>>, TransportError> {
    let deadline = flyrig_types::deadline_after(timeout);
    let malformed = |problem: String| TransportError::malformed(keys::chunk_label(hash, 0), problem);
    let ask = |chunk: u32| ask_chunk(session, &keys::key(rig, &keys::chunk_label(hash, chunk)), deadline);
    let (mut bytes, mut count) = (Vec::new(), 1);
    let mut under_way = VecDeque::from([ask(0)?]);
    let mut asked = 1;
    for chunk in 0.. {
        let Some(replies) = under_way.pop_front() else { break };
        let mut part = received(&replies);
        if part.is_none() && chunk > 0 {
            // The chunk was dropped on the way.
            part = received(&ask(chunk)?);
        }
        let Some((size, part)) = part else { return Ok(None) };
        if size > MAX_TEMPLATE_BYTES {
            return Err(malformed(format!("a template of {size} bytes, at most {MAX_TEMPLATE_BYTES}")));
        }
        bytes.extend(part);
        count = count.max(size.div_ceil(CHUNK) as u32);
        while asked < count && under_way.len() < AT_ONCE {
            under_way.push_back(ask(asked)?);
            asked += 1;
        }
    }
    if template_hash(&bytes) == hash {
        Ok(Some(bytes))
    } else {
        Err(malformed("the answer is another template".to_owned()))
    }
}

type Replies = FifoChannelHandler<Reply>;

fn ask_chunk(session: &Session, key: &str, deadline: Instant) -> Result<Replies, TransportError> {
    let left = deadline.saturating_duration_since(Instant::now()).min(CHUNK_PATIENCE);
    session
        .get(key)
        // The reply inherits both: a stalled subscriber must not block the publisher's session, and motion goes first.
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::DataHigh)
        .timeout(left)
        .wait()
        .map_err(|error| TransportError::session(key, &error))
}

/// Returns the template's size and the bytes of a chunk; `None` when it did not arrive.
fn received(replies: &Replies) -> Option<(usize, Vec<u8>)> {
    let payload = replies.recv().ok()?.into_result().ok()?.payload().to_bytes().into_owned();
    let (size, chunk) = payload.split_first_chunk().filter(|(_, chunk)| chunk.len() <= CHUNK)?;
    Some((u32::from_le_bytes(*size) as usize, chunk.to_vec()))
}

//! The person stream: its topics, and templates by their hash.

use std::{
    ops::Range,
    sync::{Arc, Mutex, Once},
    time::{Duration, Instant},
};

use flyrig_stream::{LAYERS, MAX_TEMPLATE_BYTES, template_hash};
use prost::bytes::Bytes;
use zenoh::{
    Session, Wait,
    qos::{CongestionControl, Priority},
    query::Query,
};

use crate::{
    MessageKind, TransportError,
    drain::Shared,
    inbox::Inbox,
    keys,
    splats::MAX_PERSON_TOPICS,
    topic::{Topic, lock},
};

/// Bytes of a template in a reply: it fits in one batch of zenoh's, so that a slow line drops no fragments.
const CHUNK: usize = 60_000;
/// Chunks that are asked for at once.
const AT_ONCE: u32 = 4;
/// How long a chunk is waited for.
const CHUNK_PATIENCE: Duration = Duration::from_secs(2);

/// A message of the person stream, as it came.
#[derive(Debug, Clone, PartialEq)]
pub struct PersonMessage {
    /// Which person.
    pub person: u32,
    /// Layer of a message of colours; None for a motion.
    pub layer: Option<usize>,
    /// For [`flyrig_stream::Motion::decode`] or [`flyrig_stream::ColorDecoder::take`].
    pub bytes: Bytes,
}

/// Topics of a person: motion, then the layers of colours.
type Topics = [Arc<Topic>; 1 + LAYERS];

/// The people whose stream is published, the one that was published last at the end.
#[derive(Debug)]
pub(crate) struct People {
    /// Person 0 always has topics, so that subscribers are noticed before anybody is seen.
    first: Topics,
    others: Mutex<Vec<(u32, Topics)>>,
    /// Person, hash and bytes, the newest at the end.
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

impl People {
    pub fn new() -> Self {
        Self { first: topics_of(0), others: Mutex::default(), templates: Mutex::default() }
    }

    /// Topics of person 0.
    pub fn first_topics(&self) -> Topics {
        self.first.clone()
    }

    pub fn is_watched(&self) -> bool {
        self.first[0].is_watched()
    }

    /// Returns a person's topics. Those of a new one are made; beyond [`MAX_PERSON_TOPICS`] the person who was published longest
    /// ago loses them.
    pub fn topics(&self, person: u32, shared: &Shared) -> Topics {
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

    /// Returns a chunk of a template behind the template's size, as it is replied.
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

/// Runs on a zenoh thread. A template that is not known is not answered: another publisher may have it.
pub(crate) fn answer_template(people: &People, query: &Query) {
    let Some(reply) = keys::label_in(query.key_expr().as_str()).and_then(|label| people.chunk(label)) else { return };
    if let Err(error) = query.reply(query.key_expr(), reply).wait() {
        tracing::warn!(%error, "could not answer a request for a template");
    }
}

/// The subscription to colours, which begins with the first template: without one they are of no use, and on a slow line they would keep
/// the template waiting.
#[derive(Debug)]
pub(crate) struct ColorSubscription {
    session: Session,
    rig: String,
    inbox: Arc<Inbox>,
    begun: Once,
}

impl ColorSubscription {
    pub fn new(session: &Session, rig: &str, inbox: &Arc<Inbox>) -> Self {
        Self { session: session.clone(), rig: rig.to_owned(), inbox: inbox.clone(), begun: Once::new() }
    }

    /// Begins it, once.
    fn begin(&self) {
        self.begun.call_once(|| {
            let inbox = self.inbox.clone();
            let key = keys::key(&self.rig, &format!("{}*/color-$*", keys::PERSON));
            let begun =
                self.session.declare_subscriber(key).callback(move |sample| inbox.receive(&sample)).background().wait();
            if let Err(error) = begun {
                tracing::warn!(%error, "colours cannot be received");
            }
        });
    }

    /// Asks for a template as [`ask_template`] does; colours come from then on.
    pub fn ask_template(&self, hash: u64, timeout: Duration) -> Result<Option<Vec<u8>>, TransportError> {
        let answer = ask_template(&self.session, &self.rig, hash, timeout)?;
        if answer.is_some() {
            self.begin();
        }
        Ok(answer)
    }
}

/// Asks for a template, chunk by chunk, and checks that the answer is the one.
fn ask_template(session: &Session, rig: &str, hash: u64, timeout: Duration) -> Result<Option<Vec<u8>>, TransportError> {
    let deadline = Instant::now() + timeout;
    let malformed = |problem: String| TransportError::malformed(keys::chunk_label(hash, 0), problem);
    let Some((size, mut bytes)) = ask_chunks(session, rig, hash, 0..1, deadline)?.pop() else { return Ok(None) };
    if size > MAX_TEMPLATE_BYTES {
        return Err(malformed(format!("a template of {size} bytes, at most {MAX_TEMPLATE_BYTES}")));
    }
    let count = size.div_ceil(CHUNK) as u32;
    let mut next = 1;
    while next < count {
        let chunks = next..count.min(next + AT_ONCE);
        let replies = ask_chunks(session, rig, hash, chunks, deadline)?;
        if replies.is_empty() {
            return Ok(None);
        }
        for (_, chunk) in replies {
            bytes.extend(chunk);
            next += 1;
        }
    }
    if template_hash(&bytes) == hash {
        Ok(Some(bytes))
    } else {
        Err(malformed("the answer is another template".to_owned()))
    }
}

/// Asks for chunks at once; returns the template's size and the bytes of those that came, up to the first that did not.
fn ask_chunks(
    session: &Session,
    rig: &str,
    hash: u64,
    chunks: Range<u32>,
    deadline: Instant,
) -> Result<Vec<(usize, Vec<u8>)>, TransportError> {
    let mut asked = Vec::new();
    for chunk in chunks {
        let key = keys::key(rig, &keys::chunk_label(hash, chunk));
        let left = deadline.saturating_duration_since(Instant::now()).min(CHUNK_PATIENCE);
        let replies = session
            .get(&key)
            // The reply inherits both: a stalled subscriber must not block the publisher's session, and motion goes first.
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::DataHigh)
            .timeout(left)
            .wait()
            .map_err(|error| TransportError::session(key, &error))?;
        asked.push(replies);
    }
    let mut found = Vec::new();
    for replies in asked {
        let Some(payload) = replies.recv().ok().and_then(|reply| reply.into_result().ok()) else { break };
        let payload = payload.payload().to_bytes();
        let Some((size, chunk)) = payload.split_first_chunk().filter(|(_, chunk)| chunk.len() <= CHUNK) else { break };
        found.push((u32::from_le_bytes(*size) as usize, chunk.to_vec()));
    }
    Ok(found)
}

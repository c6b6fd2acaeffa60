//! Present state of the published people, which viewers query when they join.
//!
//! `present/motions` returns the last motion of each person. `present/colors-PERSON-LAYER` returns the hash of the present colours from a
//! layer on, whose bytes are queried in chunks like a template's: they are encoded once, and stay the same while they are fetched.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use flyrig_stream::{ColorDecoder, StreamTemplate, WholeColors, template_hash};
use prost::bytes::Bytes;

use crate::{
    keys::MAX_PERSON_TOPICS,
    people::catch_up::{pack_colors, pack_motion},
    topic::lock,
};

/// Time for which encoded colours are given to further viewers; refreshes repair what changed meanwhile.
const FRESH: Duration = Duration::from_millis(100);
/// Largest number of encoded colours that are kept while they are fetched.
const MAX_ENCODED: usize = 24;
/// Time after which a motion is not present any more: this, and a multiple of the person's interval.
const GONE_AFTER: Duration = Duration::from_secs(3);
const GONE_INTERVALS: u32 = 3;
/// Interval of a person's motions until the second one.
const FIRST_INTERVAL: Duration = Duration::from_secs(10);
/// Reply for a person whose template has the colours.
const NO_COLORS: [u8; 8] = [0; 8];

/// Colours of a person, shared with the thread that changes them.
pub type SharedColors = Arc<dyn WholeColors + Sync>;

/// Source of a person's colours.
#[derive(Debug)]
enum Source {
    /// Encoder of the colours.
    Given(SharedColors),
    /// Decoder of all that is published.
    Decoded(Box<ColorDecoder>),
    /// The template has them.
    Template,
}

#[derive(Debug)]
struct Motion {
    at: Instant,
    interval: Duration,
    /// Identity of the host that handed it in.
    host: u64,
    bytes: Bytes,
}

#[derive(Debug)]
struct Encoded {
    person: u32,
    first_layer: usize,
    at: Instant,
    hash: u64,
    bytes: Bytes,
}

/// Last motions and present colours.
#[derive(Debug, Default)]
pub(crate) struct PresentPeople {
    motions: Mutex<BTreeMap<u32, Motion>>,
    sources: Mutex<BTreeMap<u32, Source>>,
    /// Colours being fetched, newest last.
    encoded: Mutex<Vec<Encoded>>,
}

impl PresentPeople {
    /// Takes the colours of a person from their encoder.
    pub fn set_colors(&self, person: u32, colors: SharedColors) {
        self.set_source(person, Source::Given(colors));
    }

    /// Follows the colours of a person by decoding what is published for this template.
    pub fn decode_colors(&self, person: u32, template: &[u8]) {
        let Ok(template) = StreamTemplate::decode(template) else { return };
        let decoder = || Source::Decoded(Box::new(ColorDecoder::new(&template)));
        self.set_source(person, if template.has_colors() { Source::Template } else { decoder() });
    }

    fn set_source(&self, person: u32, source: Source) {
        lock(&self.motions).remove(&person);
        let mut sources = lock(&self.sources);
        sources.insert(person, source);
        while sources.len() > MAX_PERSON_TOPICS + 1 {
            sources.pop_first();
        }
    }

    /// Records a message of the person stream that `host` handed in.
    pub fn published(&self, person: u32, layer: Option<usize>, bytes: &Bytes, host: u64, now: Instant) {
        if layer.is_some() {
            if let Some(Source::Decoded(decoder)) = lock(&self.sources).get_mut(&person) {
                // Damaged colours count as missed here as well.
                drop(decoder.ingest(bytes));
            }
            return;
        }
        let mut motions = lock(&self.motions);
        let interval = motions.get(&person).map_or(FIRST_INTERVAL, |last| now.saturating_duration_since(last.at));
        motions.insert(person, Motion { at: now, interval, host, bytes: bytes.clone() });
        while motions.len() > MAX_PERSON_TOPICS + 1 {
            motions.pop_first();
        }
    }

    /// Returns the last motion of each person who is present.
    pub fn motions(&self, now: Instant) -> Vec<u8> {
        let mut packed = Vec::new();
        for (person, Motion { at, interval, host, bytes }) in &*lock(&self.motions) {
            let age = now.saturating_duration_since(*at);
            if age < GONE_AFTER + interval.saturating_mul(GONE_INTERVALS) {
                pack_motion(&mut packed, *person, (*host, age), bytes);
            }
        }
        packed
    }

    /// Encodes the colours of a person, and returns the hash of the bytes; `None` before the first colours.
    pub fn colors_hash(&self, person: u32, first_layer: usize, now: Instant) -> Option<Vec<u8>> {
        let mut encoded = lock(&self.encoded);
        let same = |of: &&Encoded| of.person == person && of.first_layer == first_layer;
        if let Some(recent) = encoded.iter().rev().find(same)
            && now.saturating_duration_since(recent.at) < FRESH
        {
            return Some(recent.hash.to_le_bytes().to_vec());
        }
        let given = match lock(&self.sources).get(&person)? {
            Source::Template => return Some(NO_COLORS.to_vec()),
            Source::Given(colors) => Err(Arc::clone(colors)),
            Source::Decoded(decoder) => Ok(decoder.whole(first_layer)),
        };
        let messages = given.unwrap_or_else(|colors| colors.whole(first_layer));
        if messages.is_empty() {
            return None;
        }
        let bytes = Bytes::from(pack_colors(&messages));
        let hash = template_hash(&bytes);
        encoded.push(Encoded { person, first_layer, at: now, hash, bytes });
        let over = encoded.len().saturating_sub(MAX_ENCODED);
        encoded.drain(..over);
        Some(hash.to_le_bytes().to_vec())
    }

    /// Returns encoded colours by their hash.
    pub fn colors(&self, hash: u64) -> Option<Bytes> {
        lock(&self.encoded).iter().find(|known| known.hash == hash).map(|known| known.bytes.clone())
    }
}

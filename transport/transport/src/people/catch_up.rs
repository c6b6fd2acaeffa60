//! Fetches what was published before a viewer joined, on a thread of its own: the last motions and the present colours. What arrives is
//! handed to the reader like any other message of the person stream.

use std::{
    collections::VecDeque,
    sync::Arc,
    time::{Duration, Instant},
};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};
use flyrig_stream::{LAYERS, MAX_MESSAGE_BYTES, stamp_of};
use flyrig_types::caught;
use prost::bytes::Bytes;
use zenoh::Session;

use crate::{
    error::TransportError,
    header::{Header, MessageKind, empty_header},
    host,
    inbox::{Inbox, Raw},
    keys,
    people::chunks::{ask, ask_template},
};

/// Largest number of waiting requests; more are left to refreshes.
const MAX_WAITING: usize = 64;
/// Time limit of a query, and of the bytes of colours.
const PATIENCE: Duration = Duration::from_secs(5);
const COLORS_PATIENCE: Duration = Duration::from_secs(30);
/// Pause before a query that was not answered is repeated, and largest number of repetitions: the first colours of a person come after the
/// template, motions may come in a moment, and older rigs never answer.
const RETRY: Duration = Duration::from_millis(500);
const MOST_TRIES: u32 = 20;
/// Longest wait of the thread.
const TURN: Duration = Duration::from_secs(60);

/// State that is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Missing {
    /// Last motions of all people.
    Motions,
    /// Colours of a person, from a layer on.
    Colors { person: u32, first_layer: usize },
}

/// Thread that fetches missing state until it is dropped; dropping does not wait for a query under way.
#[derive(Debug)]
pub(crate) struct CatchUp {
    missing: Sender<Missing>,
}

impl CatchUp {
    pub fn start(session: &Session, rig: &str, inbox: &Arc<Inbox>) -> Result<Self, TransportError> {
        let link = Link { session: session.clone(), rig: rig.to_owned(), inbox: Arc::clone(inbox) };
        let (missing, requests) = bounded(MAX_WAITING);
        std::thread::Builder::new()
            .name("flyrig-catch-up".to_owned())
            .spawn(move || run(&requests, |missing| link.fetch(missing)))
            .map_err(|error| TransportError::session("thread for present people", &error))?;
        Ok(Self { missing })
    }

    /// Requests missing state; never waits.
    pub fn fetch(&self, missing: Missing) {
        // One that does not fit is left to refreshes.
        let _ = self.missing.try_send(missing);
    }
}

/// Fetches requests until their sender is dropped; `fetch` returns false for one that was not answered.
fn run(requests: &Receiver<Missing>, fetch: impl Fn(Missing) -> bool) {
    // Time, request and number of tries so far.
    let mut waiting = VecDeque::<(Instant, Missing, u32)>::new();
    loop {
        let due = waiting.iter().map(|(at, ..)| *at).min();
        let left = due.map_or(TURN, |due| due.saturating_duration_since(Instant::now()));
        match requests.recv_timeout(left) {
            Ok(missing) => add(&mut waiting, missing),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        requests.try_iter().for_each(|missing| add(&mut waiting, missing));
        let now = Instant::now();
        let Some(at) = waiting.iter().position(|(at, ..)| *at <= now) else { continue };
        let Some((_, missing, tries)) = waiting.remove(at) else { continue };
        let is_answered = caught(|| fetch(missing)).unwrap_or(false);
        if !is_answered && tries < MOST_TRIES {
            waiting.push_back((Instant::now() + RETRY, missing, tries + 1));
        }
    }
}

/// Adds a request; one for the same person replaces it, from the coarser layer on.
fn add(waiting: &mut VecDeque<(Instant, Missing, u32)>, missing: Missing) {
    for (_, known, tries) in waiting.iter_mut() {
        match (known, missing) {
            (Missing::Motions, Missing::Motions) => return *tries = 0,
            (Missing::Colors { person, first_layer }, Missing::Colors { person: of, first_layer: from })
                if *person == of =>
            {
                *first_layer = (*first_layer).min(from);
                return *tries = 0;
            }
            _ => {}
        }
    }
    if waiting.len() < MAX_WAITING {
        waiting.push_back((Instant::now(), missing, 0));
    }
}

struct Link {
    session: Session,
    rig: String,
    inbox: Arc<Inbox>,
}

impl Link {
    fn fetch(&self, missing: Missing) -> bool {
        let fetched = match missing {
            Missing::Motions => self.fetch_motions(),
            Missing::Colors { person, first_layer } => self.fetch_colors(person, first_layer),
        };
        fetched.unwrap_or_else(|error| {
            tracing::debug!("{error}");
            false
        })
    }

    fn ask(&self, label: &str) -> Result<Option<Vec<u8>>, TransportError> {
        ask(&self.session, &keys::key(&self.rig, label), flyrig_types::deadline_after(PATIENCE))
    }

    fn fetch_motions(&self) -> Result<bool, TransportError> {
        let Some(packed) = self.ask(keys::LAST_MOTIONS)? else { return Ok(false) };
        for (person, (host, age), bytes) in unpack_motions(&packed) {
            self.hand_over(keys::motion_label(person), MessageKind::Motion, bytes, host, age);
        }
        // A relay, or a rig, may have its first person in a moment.
        Ok(!packed.is_empty())
    }

    fn fetch_colors(&self, person: u32, first_layer: usize) -> Result<bool, TransportError> {
        let label = keys::whole_colors_label(person, first_layer);
        let Some(reply) = self.ask(&label)? else { return Ok(false) };
        let hash = <[u8; 8]>::try_from(reply.as_slice()).map(u64::from_le_bytes);
        let hash = hash.map_err(|_| TransportError::malformed(label, "the answer is no hash"))?;
        if hash == 0 {
            return Ok(true);
        }
        let begun = Instant::now();
        self.inbox.fetch_begins();
        let answer = ask_template(&self.session, &self.rig, hash, COLORS_PATIENCE);
        let packed = answer.as_ref().ok().and_then(Option::as_ref);
        self.inbox.fetch_ends(packed.map_or(0, Vec::len));
        let Some(packed) = answer? else { return Ok(false) };
        tracing::debug!(
            person,
            first_layer,
            bytes = packed.len(),
            secs = begun.elapsed().as_secs_f64(),
            "fetched colours"
        );
        for (layer, bytes) in unpack_colors(&packed) {
            self.hand_over(keys::color_label(person, layer), MessageKind::Colors, bytes, 0, Duration::ZERO);
        }
        Ok(true)
    }

    /// Hands a message to the reader that `host` handed in `age` ago; 0 for an unknown host.
    fn hand_over(&self, label: String, kind: MessageKind, bytes: &[u8], host: u64, age: Duration) {
        let Ok(stamp) = stamp_of(bytes) else { return self.inbox.count_unreadable() };
        let latency_nanos = i64::try_from(age.as_nanos()).unwrap_or(i64::MAX);
        let exact = host != 0 && host == host::host_id();
        let header = Header {
            kind,
            frame: stamp.frame,
            capture_nanos: stamp.capture_nanos,
            host,
            publish_unix_nanos: host::unix_nanos().saturating_sub(latency_nanos),
            publish_nanos: if exact { host::monotonic_nanos().saturating_sub(latency_nanos) } else { 0 },
            ..empty_header()
        };
        let payload = Bytes::copy_from_slice(bytes);
        self.inbox.hand_over(label, Raw { header, payload, latency_nanos, exact });
    }
}

/// Appends a motion: person, host that handed it in, age in nanoseconds, length, bytes.
pub(crate) fn pack_motion(packed: &mut Vec<u8>, person: u32, (host, age): (u64, Duration), bytes: &[u8]) {
    packed.extend(person.to_le_bytes());
    packed.extend(host.to_le_bytes());
    packed.extend(u64::try_from(age.as_nanos()).unwrap_or(u64::MAX).to_le_bytes());
    packed.extend((bytes.len() as u32).to_le_bytes());
    packed.extend(bytes);
}

/// Reads motions until the bytes end or are damaged.
fn unpack_motions(mut packed: &[u8]) -> impl Iterator<Item = (u32, (u64, Duration), &[u8])> {
    std::iter::from_fn(move || {
        let (person, rest) = packed.split_first_chunk()?;
        let (host, rest) = rest.split_first_chunk()?;
        let (age, rest) = rest.split_first_chunk()?;
        let (bytes, rest) = split_message(rest)?;
        packed = rest;
        let sent = (u64::from_le_bytes(*host), Duration::from_nanos(u64::from_le_bytes(*age)));
        Some((u32::from_le_bytes(*person), sent, bytes))
    })
}

/// Joins messages of colours: layer, length, bytes of each.
pub(crate) fn pack_colors(messages: &[(usize, Vec<u8>)]) -> Vec<u8> {
    let mut packed = Vec::new();
    for (layer, bytes) in messages {
        packed.push(*layer as u8);
        packed.extend((bytes.len() as u32).to_le_bytes());
        packed.extend(bytes);
    }
    packed
}

/// Reads messages of colours until the bytes end or are damaged.
fn unpack_colors(mut packed: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    std::iter::from_fn(move || {
        let (layer, rest) = packed.split_first()?;
        let (bytes, rest) = split_message(rest)?;
        packed = rest;
        Some((usize::from(*layer), bytes)).filter(|(layer, _)| *layer < LAYERS)
    })
}

fn split_message(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    let length = u32::from_le_bytes(*length) as usize;
    (length <= MAX_MESSAGE_BYTES && length <= rest.len()).then(|| rest.split_at(length))
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::topic::lock;

    #[test]
    fn packed_messages_come_back_and_damaged_ones_end_the_list() {
        let mut packed = Vec::new();
        pack_motion(&mut packed, 3, (8, Duration::from_millis(40)), b"abc");
        pack_motion(&mut packed, 9, (0, Duration::ZERO), b"");
        let found: Vec<_> = unpack_motions(&packed).collect();
        assert_eq!(found, [(3, (8, Duration::from_millis(40)), &b"abc"[..]), (9, (0, Duration::ZERO), &b""[..])]);
        assert!((0..packed.len()).all(|end| unpack_motions(&packed[..end]).count() < 2));
        let messages = vec![(0, b"x".to_vec()), (2, vec![7; 300])];
        let packed = pack_colors(&messages);
        let found: Vec<_> = unpack_colors(&packed).map(|(layer, bytes)| (layer, bytes.to_vec())).collect();
        assert_eq!(found, messages);
        assert!((0..packed.len()).all(|end| unpack_colors(&packed[..end]).count() < 2));
        assert_eq!(unpack_colors(&[LAYERS as u8, 0, 0, 0, 0]).count(), 0);
        assert_eq!(unpack_colors(&[0, 255, 255, 255, 255, 1]).count(), 0);
    }

    #[test]
    fn requests_are_repeated_until_they_are_answered_and_joined_by_person() {
        let (sender, requests) = bounded(8);
        let colors = |person, first_layer| Missing::Colors { person, first_layer };
        for missing in [colors(1, 2), Missing::Motions, colors(1, 1), colors(2, 0), Missing::Motions] {
            sender.send(missing).unwrap();
        }
        let seen = Mutex::new(Vec::new());
        let sender = Mutex::new(Some(sender));
        run(&requests, |missing| {
            let mut seen = lock(&seen);
            seen.push(missing);
            // The first answer is missing.
            if seen.len() == 4 {
                drop(lock(&sender).take());
            }
            seen.len() > 1
        });
        assert_eq!(*lock(&seen), [colors(1, 1), Missing::Motions, colors(2, 0), colors(1, 1)]);
    }
}

//! Received messages that wait for their reader: one slot per topic, the newest message wins, bounded in bytes over all topics.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    ops::Bound,
    sync::{Condvar, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use flyrig_types::{Camera, CameraId, Intrinsics, Rig, wait_timeout};
use prost::bytes::Bytes;
use zenoh::sample::Sample;

use crate::{
    cameras::calibration::{RigTransforms, decode_calibration, decode_transforms},
    error::{TransportError, TransportErrorKind},
    expected::{check_label, expected_payload},
    header::{self, Header, MessageKind},
    host::{self, Moment},
    keys::{self, MAX_PERSON_TOPICS},
    people::color_layers::ColorLayers,
    report::{Tally, TopicReport},
    schema::SCHEMA_VERSION,
    topic::lock,
};

/// Largest number of topics that a subscriber keeps slots for.
const MAX_TOPICS: usize = 256;

/// Largest number of errors that wait to be reported; later ones are only counted.
const MAX_ERRORS: usize = 16;

/// Largest number of bytes of fetched messages that wait; the oldest are dropped.
const MAX_FETCHED_BYTES: usize = 16 << 20;

/// Received message, not yet decoded.
#[derive(Debug)]
pub(crate) struct Raw {
    pub header: Header,
    pub payload: Bytes,
    /// Publisher's hand-in to arrival, by wall clocks where it came from another host.
    pub latency_nanos: i64,
    /// Whether both ends run on one host.
    pub exact: bool,
}

#[derive(Debug, Default)]
struct Slot {
    raw: Option<Raw>,
    /// Number of the latest message, counted over all topics.
    arrival: u64,
    tally: Tally,
}

#[derive(Debug, Default)]
struct State {
    slots: BTreeMap<String, Slot>,
    /// Messages of the person stream that were fetched, in order.
    fetched: VecDeque<(String, Raw)>,
    /// People of whom changes of colours were missed.
    missed_colors: BTreeSet<u32>,
    /// Number of messages received over all topics.
    arrivals: u64,
    /// Payload bytes in all slots.
    waiting: u64,
    /// Label that was served last, so that topics take turns.
    served: String,
    errors: VecDeque<TransportError>,
    /// Whether the reader last got an error: then a message goes first, so that errors never delay messages.
    erred: bool,
    unreadable: u64,
    /// Intrinsics with their publisher: calibrations of two publishers are never mixed.
    lenses: BTreeMap<CameraId, (u64, Intrinsics)>,
    places: Option<(u64, RigTransforms)>,
    publishers: Vec<String>,
}

/// Mailbox shared by the zenoh callbacks and the reader.
#[derive(Debug)]
pub(crate) struct Inbox {
    state: Mutex<State>,
    changed: Condvar,
    host: u64,
    /// Bound of the payload bytes in all slots.
    quota: u64,
    /// Label and name of the view of this subscriber's viewpoint.
    own_view: (String, String),
    color_layers: Mutex<ColorLayers>,
}

impl State {
    /// Takes the payload out of a slot.
    fn take(&mut self, label: &str) -> Option<Raw> {
        let raw = self.slots.get_mut(label)?.raw.take()?;
        self.waiting -= raw.payload.len() as u64;
        Some(raw)
    }

    /// Drops payloads of topics other than `label` until `bytes` more fit, the largest first: a topic of huge messages loses its own.
    fn make_room(&mut self, label: &str, bytes: u64, quota: u64) {
        while self.waiting.saturating_add(bytes) > quota {
            let size = |slot: &Slot| slot.raw.as_ref().map(|raw| (raw.payload.len(), u64::MAX - slot.arrival));
            let largest = self.slots.iter().filter(|(other, _)| *other != label).max_by_key(|(_, slot)| size(slot));
            let Some(other) = largest.filter(|(_, slot)| slot.raw.is_some()).map(|(other, _)| other.clone()) else {
                return;
            };
            self.take(&other);
            if let Some(slot) = self.slots.get_mut(&other) {
                slot.tally.totals.dropped += 1;
            }
        }
    }

    /// Forgets the least recent of `most` topics with this prefix, so that people may come and go for days.
    fn forget_person(&mut self, prefix: &str, most: usize) {
        let persons = self.slots.iter().filter(|(label, _)| label.starts_with(prefix));
        let oldest = persons.clone().min_by_key(|(_, slot)| slot.arrival).map(|(label, _)| label.clone());
        if let Some(oldest) = oldest.filter(|_| persons.count() >= most) {
            self.take(&oldest);
            self.slots.remove(&oldest);
        }
    }

    /// Stores the parts of the rig's calibration, whose payloads need no slot.
    fn keep_calibration(&mut self, header: &Header, payload: &[u8]) -> Result<(), TransportError> {
        match header.kind {
            MessageKind::Calibration => {
                let (id, lens) = decode_calibration(payload)?;
                self.lenses.retain(|_, (publisher, _)| *publisher == header.publisher);
                if self.lenses.len() < MAX_TOPICS || self.lenses.contains_key(&id) {
                    self.lenses.insert(id, (header.publisher, lens));
                }
            }
            MessageKind::Transforms => self.places = Some((header.publisher, decode_transforms(payload)?)),
            MessageKind::View
            | MessageKind::Splats
            | MessageKind::Stats
            | MessageKind::Frame
            | MessageKind::CameraStatus
            | MessageKind::Motion
            | MessageKind::Colors => {}
        }
        Ok(())
    }

    /// Makes room for a slot of this label: refuses one topic too many, and forgets a person in favour of a new one.
    fn make_slot(&mut self, key: &str, label: &str) -> Result<(), TransportError> {
        if self.slots.contains_key(label) {
            return Ok(());
        }
        if self.slots.len() >= MAX_TOPICS {
            return Err(TransportError::malformed(key, format!("more than {MAX_TOPICS} topics")));
        }
        if label.starts_with(keys::PERSON_SPLATS) {
            self.forget_person(keys::PERSON_SPLATS, MAX_PERSON_TOPICS);
        }
        if keys::is_person(label) {
            self.forget_person(keys::PERSON, (1 + flyrig_stream::LAYERS) * MAX_PERSON_TOPICS);
        }
        Ok(())
    }
}

/// Timing of a message that has arrived.
#[derive(Clone, Copy)]
struct Observed {
    now: Instant,
    /// Identity of the publisher's clock.
    clock: u64,
    /// Publisher's hand-in to arrival, by clocks that are never set; only differences of one `clock` mean something.
    latency_nanos: i64,
    /// Messages of the topic that were missed before it.
    missed: u64,
}

impl Inbox {
    pub(crate) fn new(own_view_name: String, quota: u64) -> Self {
        let own_view = (keys::view_label(&own_view_name), own_view_name);
        let color_layers = Mutex::new(ColorLayers::new(Instant::now()));
        Self { state: Mutex::default(), changed: Condvar::new(), host: host::host_id(), quota, own_view, color_layers }
    }

    /// Returns the number of colour layers that the line carries, from the coarsest; 0 before [`Self::begin_colors`].
    pub(crate) fn color_layers(&self) -> usize {
        lock(&self.color_layers).wanted()
    }

    /// Records that a thread which only waits ran late by `by`.
    pub(crate) fn woke_late(&self, by: Duration) {
        lock(&self.color_layers).woke_late(by);
    }

    /// Records that a template is being fetched from now on.
    pub(crate) fn fetch_begins(&self) {
        lock(&self.color_layers).fetch_begins(Instant::now());
    }

    /// Records that a template has arrived with `bytes` bytes, or with 0 that the fetch failed.
    pub(crate) fn fetch_ends(&self, bytes: usize) {
        lock(&self.color_layers).fetch_ends(Instant::now(), bytes);
    }

    pub(crate) fn have_colors_begun(&self) -> bool {
        lock(&self.color_layers).has_begun()
    }

    /// Returns whether so few frame sets come that a refresh of the colours would take long.
    pub(crate) fn is_rig_slow(&self) -> bool {
        lock(&self.color_layers).is_rig_slow()
    }

    /// Returns whether the line carries fewer than all layers of colours.
    pub(crate) fn is_line_slow(&self) -> bool {
        lock(&self.color_layers).is_line_slow()
    }

    /// Takes the people of whom changes of colours were missed.
    pub(crate) fn take_missed_colors(&self) -> BTreeSet<u32> {
        std::mem::take(&mut lock(&self.state).missed_colors)
    }

    /// Hands a fetched message of the person stream to the reader.
    pub(crate) fn hand_over(&self, label: String, raw: Raw) {
        let mut state = lock(&self.state);
        state.fetched.push_back((label, raw));
        let size = |fetched: &VecDeque<(String, Raw)>| fetched.iter().map(|(_, raw)| raw.payload.len()).sum::<usize>();
        while size(&state.fetched) > MAX_FETCHED_BYTES {
            state.fetched.pop_front();
        }
        drop(state);
        self.changed.notify_all();
    }

    /// Begins to subscribe to colours.
    pub(crate) fn begin_colors(&self) {
        lock(&self.color_layers).begin();
    }

    /// Returns the name of a label's view; `None` for other topics.
    pub(crate) fn view_name<'a>(&'a self, label: &'a str) -> Option<&'a str> {
        if label == self.own_view.0 { Some(&self.own_view.1) } else { label.strip_prefix("view/") }
    }

    /// Ingests a sample; runs on a zenoh thread.
    pub(crate) fn receive(&self, sample: &Sample) {
        let now = Moment::now();
        let key = sample.key_expr().as_str();
        let attachment = sample.attachment().filter(|bytes| bytes.len() <= header::MAX_ATTACHMENT);
        let attachment = attachment.map(zenoh::bytes::ZBytes::to_bytes).unwrap_or_default();
        // The payload may lie in memory that the publisher takes back when we stall: copy it now.
        let (len, payload) = (sample.payload().len(), || Bytes::from(sample.payload().to_bytes().into_owned()));
        if let Err(error) = self.accept(key, &attachment, len, payload, now) {
            self.refuse(error);
        }
    }

    /// Checks a message and puts it into the slot of its topic. `len` is the length of the payload, which is copied once it is
    /// known to fit.
    fn accept(
        &self,
        key: &str,
        attachment: &[u8],
        len: usize,
        payload: impl Fn() -> Bytes,
        now: Moment,
    ) -> Result<(), TransportError> {
        let header = Header::decode(key, attachment)?;
        let label = keys::label_in(key).unwrap_or_default();
        check_label(key, label)?;
        self.check_payload(key, label, header.kind, len)?;
        let payload = payload();
        let mut state = lock(&self.state);
        state.keep_calibration(&header, &payload)?;
        state.make_slot(key, label)?;
        let waits = !matches!(header.kind, MessageKind::Calibration | MessageKind::Transforms);
        let is_replaced = waits && state.take(label).is_some();
        if waits {
            state.make_room(label, payload.len() as u64, self.quota);
            state.waiting += payload.len() as u64;
        }
        state.arrivals += 1;
        let arrival = state.arrivals;
        let slot = state.slots.entry(label.to_owned()).or_default();
        slot.arrival = arrival;
        let exact = self.host != 0 && header.host == self.host;
        let by_wall = now.unix_nanos.saturating_sub(header.publish_unix_nanos);
        // Older programs do not say when they sent by a clock that is never set.
        let steady = (header.publish_nanos != 0).then(|| now.monotonic_nanos.saturating_sub(header.publish_nanos));
        let latency_nanos = steady.filter(|_| exact).unwrap_or(by_wall);
        let missed_before = slot.tally.totals.missed;
        slot.tally.add(&header, payload.len(), now.instant, latency_nanos, exact);
        slot.tally.totals.replaced += u64::from(is_replaced);
        let missed = slot.tally.totals.missed.saturating_sub(missed_before);
        let clock = if header.host == 0 { header.publisher } else { header.host };
        let observed = Observed { now: now.instant, clock, latency_nanos: steady.unwrap_or(by_wall), missed };
        self.observe_line(label, header.kind, payload.len(), observed);
        slot.raw = waits.then_some(Raw { header, payload, latency_nanos, exact });
        // A reader that is too slow misses the replaced changes as well.
        if let Some((person, Some(_))) = keys::person_in(label).filter(|_| missed > 0 || is_replaced) {
            state.missed_colors.insert(person);
            while state.missed_colors.len() > MAX_PERSON_TOPICS {
                state.missed_colors.pop_first();
            }
        }
        drop(state);
        self.changed.notify_all();
        Ok(())
    }

    /// Checks kind and length of a topic's payload.
    fn check_payload(&self, key: &str, label: &str, found: MessageKind, len: usize) -> Result<(), TransportError> {
        let malformed = |message: String| Err(TransportError::malformed(key, message));
        let (expected, limit) = expected_payload(label);
        if found != expected {
            return malformed(format!("holds {found:?}, expected {expected:?}"));
        }
        if len > limit {
            return malformed(format!("{len} bytes, at most {limit}"));
        }
        if len as u64 > self.quota {
            let quota = self.quota;
            return malformed(format!("{len} bytes, over the inbox of {quota} bytes; raise inbox-bytes"));
        }
        Ok(())
    }

    /// Reports a message of the person stream to the choice of colour layers.
    fn observe_line(&self, label: &str, kind: MessageKind, bytes: usize, observed: Observed) {
        if !matches!(kind, MessageKind::Motion | MessageKind::Colors) {
            return;
        }
        let mut layers = lock(&self.color_layers);
        layers.count(keys::person_in(label).and_then(|(_, layer)| layer), bytes);
        if kind == MessageKind::Motion {
            layers.motion(observed.now, observed.clock, observed.latency_nanos, observed.missed);
        }
    }

    /// Counts a message or publisher that cannot be read, and reports its error once.
    pub(crate) fn refuse(&self, error: TransportError) {
        let mut state = lock(&self.state);
        state.unreadable += 1;
        if state.errors.len() < MAX_ERRORS && !state.errors.contains(&error) {
            state.errors.push_back(error);
        }
        drop(state);
        self.changed.notify_all();
    }

    pub(crate) fn count_unreadable(&self) {
        lock(&self.state).unreadable += 1;
    }

    /// Counts publishers by their liveliness tokens.
    pub(crate) fn publisher_alive(&self, key: &str, alive: bool) {
        let version = keys::version_in(key).unwrap_or_default();
        if version != format!("v{SCHEMA_VERSION}") {
            if alive {
                self.refuse(TransportError::version(key, version));
            }
            return;
        }
        let mut state = lock(&self.state);
        state.publishers.retain(|known| known != key);
        if alive && state.publishers.len() < MAX_TOPICS {
            state.publishers.push(key.to_owned());
        }
        drop(state);
        self.changed.notify_all();
    }

    /// Takes the next waiting message among the labels that `wanted` accepts; topics take turns.
    pub(crate) fn next(
        &self,
        timeout: Duration,
        wanted: impl Fn(&str) -> bool,
    ) -> Result<Option<(String, Raw)>, TransportError> {
        self.wait(timeout, |state| {
            if let Some(at) = state.fetched.iter().position(|(label, _)| wanted(label)) {
                return state.fetched.remove(at);
            }
            let ready = |(label, slot): (&String, &Slot)| (wanted(label) && slot.raw.is_some()).then(|| label.clone());
            let after = (Bound::Excluded(state.served.as_str()), Bound::Unbounded);
            let label =
                state.slots.range::<str, _>(after).find_map(ready).or_else(|| state.slots.iter().find_map(ready))?;
            let raw = state.take(&label)?;
            state.served.clone_from(&label);
            Some((label, raw))
        })
    }

    /// Returns the rig once all of its parts have arrived. Parts that form no valid rig are forgotten, so that they are reported once.
    pub(crate) fn rig(&self, timeout: Duration) -> Result<Option<Rig>, TransportError> {
        let rig = |state: &State| {
            let (publisher, places) = state.places.as_ref()?;
            let cameras = places.camera_from_world.iter().map(|(id, camera_from_world)| {
                let (from, intrinsics) = state.lenses.get(id)?;
                let camera = Camera {
                    time_offset_nanos: 0,
                    color: Default::default(),
                    id: id.clone(),
                    intrinsics: *intrinsics,
                    camera_from_world: *camera_from_world,
                };
                (from == publisher).then_some(camera)
            });
            Some(Rig { cameras: cameras.collect::<Option<_>>()?, world_up: places.world_up })
        };
        let checked = self.wait(timeout, |state| {
            let rig = rig(state)?;
            Some(match rig.validate() {
                Ok(()) => Ok(rig),
                Err(error) => {
                    state.places = None;
                    state.unreadable += 1;
                    Err(TransportError::malformed("calibration", error.to_string()))
                }
            })
        })?;
        checked.transpose()
    }

    fn wait<T>(
        &self,
        timeout: Duration,
        mut ready: impl FnMut(&mut State) -> Option<T>,
    ) -> Result<Option<T>, TransportError> {
        let deadline = flyrig_types::deadline_after(timeout);
        let mut state: MutexGuard<'_, State> = lock(&self.state);
        loop {
            if !state.erred
                && let Some(error) = state.errors.pop_front()
            {
                state.erred = true;
                return Err(error);
            }
            state.erred = false;
            if let Some(value) = ready(&mut state) {
                return Ok(Some(value));
            }
            if let Some(error) = state.errors.pop_front() {
                state.erred = true;
                return Err(error);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            state = wait_timeout(&self.changed, state, left);
        }
    }

    pub(crate) fn publishers(&self) -> usize {
        lock(&self.state).publishers.len()
    }

    pub(crate) fn unreadable(&self) -> u64 {
        lock(&self.state).unreadable
    }

    pub(crate) fn reports(&self) -> Vec<(String, TopicReport)> {
        lock(&self.state).slots.iter().map(|(label, slot)| (label.clone(), slot.tally.report())).collect()
    }
}

/// Maps any decoding error but an unknown version to `Malformed`.
pub(crate) fn as_malformed(error: TransportError) -> TransportError {
    match error.kind {
        TransportErrorKind::UnknownVersion => error,
        _ => TransportError { kind: TransportErrorKind::Malformed, ..error },
    }
}

#[cfg(test)]
#[path = "inbox_tests.rs"]
mod tests;

#[cfg(test)]
#[path = "inbox_clock_tests.rs"]
mod clock_tests;

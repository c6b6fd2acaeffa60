//! What has come in and waits for its reader: one slot a topic, the newest wins.

use std::{
    collections::{BTreeMap, VecDeque},
    ops::Bound,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use flyrig_types::{Camera, CameraId, Intrinsics, Rig};
use prost::bytes::Bytes;
use zenoh::sample::Sample;

use crate::{
    Header, MessageKind, TransportError, TransportErrorKind,
    calibration::{RigTransforms, decode_calibration, decode_transforms},
    header, keys,
    report::{Tally, TopicReport},
    splats,
    topic::lock,
    view::MAX_IMAGE_BYTES,
};

/// Most topics that a subscriber keeps slots for.
const MAX_TOPICS: usize = 256;

/// Most errors that wait to be told; later ones are only counted.
const MAX_ERRORS: usize = 16;

/// A message as it came, undecoded.
#[derive(Debug)]
pub(crate) struct Raw {
    pub header: Header,
    pub payload: Bytes,
    pub latency_nanos: i64,
    pub exact: bool,
}

#[derive(Debug, Default)]
struct Slot {
    raw: Option<Raw>,
    tally: Tally,
}

#[derive(Debug, Default)]
struct State {
    slots: BTreeMap<String, Slot>,
    /// Label that was served last, for turns.
    served: String,
    errors: VecDeque<TransportError>,
    unreadable: u64,
    /// With the publisher it came from: calibrations of two publishers are never mixed.
    lenses: BTreeMap<CameraId, (u64, Intrinsics)>,
    places: Option<(u64, RigTransforms)>,
    publishers: Vec<String>,
}

/// Shared by the zenoh callbacks and the reader.
#[derive(Debug)]
pub(crate) struct Inbox {
    state: Mutex<State>,
    changed: Condvar,
    host: u64,
    /// Label and name of our own viewpoint's view.
    own_view: (String, String),
}

impl Inbox {
    pub(crate) fn new(own_view_name: String) -> Self {
        let own_view = (keys::view_label(&own_view_name), own_view_name);
        Self { state: Mutex::default(), changed: Condvar::new(), host: header::host_id(), own_view }
    }

    /// Name of a view for its reader; `None` for other topics.
    pub(crate) fn view_name<'a>(&'a self, label: &'a str) -> Option<&'a str> {
        if label == self.own_view.0 { Some(&self.own_view.1) } else { label.strip_prefix("view/") }
    }

    /// Takes a sample in; runs on a zenoh thread.
    pub(crate) fn receive(&self, sample: &Sample) {
        let (now, unix_nanos) = (Instant::now(), header::unix_nanos());
        let key = sample.key_expr().as_str();
        let attachment = sample.attachment().map(zenoh::bytes::ZBytes::to_bytes).unwrap_or_default();
        // The payload may lie in memory that the publisher takes back when we stall: copy it now.
        let payload = |limit: usize| {
            let len = sample.payload().len();
            let too_long = || TransportError::malformed(key, format!("{len} bytes, at most {limit}"));
            if len > limit { Err(too_long()) } else { Ok(Bytes::from(sample.payload().to_bytes().into_owned())) }
        };
        if let Err(error) = self.accept(key, &attachment, payload, now, unix_nanos) {
            self.refuse(error);
        }
    }

    fn accept(
        &self,
        key: &str,
        attachment: &[u8],
        payload: impl Fn(usize) -> Result<Bytes, TransportError>,
        now: Instant,
        unix_nanos: i64,
    ) -> Result<(), TransportError> {
        let header = Header::decode(key, attachment)?;
        let label = keys::label_in(key).unwrap_or_default();
        let (expected, limit) = match label {
            "splats" => (MessageKind::Splats, splats::MAX_BYTES),
            "stats" => (MessageKind::Stats, crate::stats::MAX_JSON_BYTES),
            "transforms" => (MessageKind::Transforms, crate::calibration::MAX_BYTES),
            _ if label.starts_with("calibration/") => (MessageKind::Calibration, crate::calibration::MAX_BYTES),
            _ => (MessageKind::View, 2 * MAX_IMAGE_BYTES),
        };
        if header.kind != expected {
            let found = header.kind;
            return Err(TransportError::malformed(key, format!("holds {found:?}, expected {expected:?}")));
        }
        let payload = payload(limit)?;
        let mut state = lock(&self.state);
        match header.kind {
            MessageKind::Calibration => {
                let (id, lens) = decode_calibration(&payload)?;
                state.lenses.retain(|_, (publisher, _)| *publisher == header.publisher);
                if state.lenses.len() < MAX_TOPICS || state.lenses.contains_key(&id) {
                    state.lenses.insert(id, (header.publisher, lens));
                }
            }
            MessageKind::Transforms => state.places = Some((header.publisher, decode_transforms(&payload)?)),
            MessageKind::View
            | MessageKind::Splats
            | MessageKind::Stats
            | MessageKind::Frame
            | MessageKind::CameraStatus => {}
        }
        if state.slots.len() >= MAX_TOPICS && !state.slots.contains_key(label) {
            return Err(TransportError::malformed(key, format!("more than {MAX_TOPICS} topics")));
        }
        let slot = state.slots.entry(label.to_owned()).or_default();
        let exact = self.host != 0 && header.host == self.host;
        let latency_nanos = unix_nanos.saturating_sub(header.publish_unix_nanos);
        slot.tally.add(&header, payload.len(), now, latency_nanos, exact);
        if !matches!(expected, MessageKind::Calibration | MessageKind::Transforms)
            && slot.raw.replace(Raw { header, payload, latency_nanos, exact }).is_some()
        {
            slot.tally.totals.replaced += 1;
        }
        drop(state);
        self.changed.notify_all();
        Ok(())
    }

    /// A message or publisher that cannot be read: counted, and told once.
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

    /// Keeps count of publishers as their liveliness tokens come and go.
    pub(crate) fn publisher_alive(&self, key: &str, alive: bool) {
        let version = keys::version_in(key).unwrap_or_default();
        if version != format!("v{}", crate::SCHEMA_VERSION) {
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

    /// The next untaken message among the labels that `wanted` says, in turns.
    pub(crate) fn next(
        &self,
        timeout: Duration,
        wanted: impl Fn(&str) -> bool,
    ) -> Result<Option<(String, Raw)>, TransportError> {
        self.wait(timeout, |state| {
            let ready = |(label, slot): (&String, &Slot)| (wanted(label) && slot.raw.is_some()).then(|| label.clone());
            let after = (Bound::Excluded(state.served.as_str()), Bound::Unbounded);
            let label =
                state.slots.range::<str, _>(after).find_map(ready).or_else(|| state.slots.iter().find_map(ready))?;
            let raw = state.slots.get_mut(&label)?.raw.take()?;
            state.served.clone_from(&label);
            Some((label, raw))
        })
    }

    /// The whole rig once its parts have come.
    pub(crate) fn rig(&self, timeout: Duration) -> Result<Option<Rig>, TransportError> {
        let rig = self.wait(timeout, |state| {
            let (publisher, places) = state.places.as_ref()?;
            let cameras = places.camera_from_world.iter().map(|(id, camera_from_world)| {
                let (from, intrinsics) = state.lenses.get(id)?;
                let camera = Camera { id: id.clone(), intrinsics: *intrinsics, camera_from_world: *camera_from_world };
                (from == publisher).then_some(camera)
            });
            Some(Rig { cameras: cameras.collect::<Option<_>>()?, world_up: places.world_up })
        })?;
        if let Some(rig) = &rig {
            rig.validate().map_err(|error| TransportError::malformed("calibration", error.to_string()))?;
        }
        Ok(rig)
    }

    fn wait<T>(
        &self,
        timeout: Duration,
        mut ready: impl FnMut(&mut State) -> Option<T>,
    ) -> Result<Option<T>, TransportError> {
        let deadline = Instant::now() + timeout;
        let mut state: MutexGuard<'_, State> = lock(&self.state);
        loop {
            if let Some(error) = state.errors.pop_front() {
                return Err(error);
            }
            if let Some(value) = ready(&mut state) {
                return Ok(Some(value));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
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

/// A decoding error's kind seen from the reader: whatever is wrong with a message is the message's fault.
pub(crate) fn as_malformed(error: TransportError) -> TransportError {
    match error.kind {
        TransportErrorKind::UnknownVersion => error,
        _ => TransportError { kind: TransportErrorKind::Malformed, ..error },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drain::empty_header;

    fn put(inbox: &Inbox, key: &str, header: &Header) -> Result<(), TransportError> {
        let payload = |_| Ok(Bytes::from_static(b"x"));
        inbox.accept(key, &header.encode(), payload, Instant::now(), 0)
    }

    #[test]
    fn views_take_turns_and_the_newest_wins() {
        let inbox = Inbox::new("viewer-me".to_owned());
        for sequence in 0..3 {
            for view in ["a", "b"] {
                let header = Header { kind: MessageKind::View, sequence, ..empty_header() };
                put(&inbox, &format!("flyrig/v1/r/view/{view}"), &header).unwrap();
            }
        }
        let next = || inbox.next(Duration::ZERO, |label| inbox.view_name(label).is_some()).unwrap();
        let (first, raw) = next().unwrap();
        assert_eq!((first.as_str(), raw.header.sequence), ("view/a", 2));
        put(&inbox, "flyrig/v1/r/view/a", &Header { kind: MessageKind::View, sequence: 3, ..empty_header() }).unwrap();
        assert_eq!(next().unwrap().0, "view/b");
        assert_eq!(next().unwrap().0, "view/a");
        assert!(next().is_none());
        assert_eq!(inbox.reports()[0].1.replaced, 2);
    }

    #[test]
    fn topics_kinds_and_errors_are_bounded() {
        let inbox = Inbox::new("viewer-me".to_owned());
        let header = Header { kind: MessageKind::View, ..empty_header() };
        for i in 0..MAX_TOPICS {
            put(&inbox, &format!("flyrig/v1/r/view/{i}"), &header).unwrap();
        }
        assert!(put(&inbox, "flyrig/v1/r/view/more", &header).unwrap_err().to_string().contains("topics"));
        let error = put(&inbox, "flyrig/v1/r/splats", &header).unwrap_err();
        assert!(error.to_string().contains("holds View, expected Splats"), "{error}");
        for i in 0..100 {
            inbox.refuse(TransportError::malformed("x", i.to_string()));
        }
        assert_eq!(inbox.unreadable(), 100);
        let mut told = 0;
        while inbox.next(Duration::ZERO, |_| false).is_err() {
            told += 1;
        }
        assert_eq!(told, MAX_ERRORS);
    }
}

//! Publisher: the rig's side.

use std::{
    collections::BTreeSet,
    net::SocketAddr,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use flyrig_access::{Gate, Role};
use flyrig_stream::{SplatState, Stamp};
use flyrig_types::{Rig, ThreadHealth};
use prost::bytes::Bytes;
use zenoh::{Wait, liveliness::LivelinessToken, query::Query, sample::SampleKind};

use crate::{
    cameras::calibration::{encode_calibration, encode_transforms},
    drain::{Drain, DrainThread, PublisherState, Retained},
    error::TransportError,
    header::{Header, MessageKind, empty_header},
    host::host_id,
    json::{MAX_JSON_BYTES, from_json, to_json},
    keys::{self, MAX_PERSON_TOPICS, VIEWER_PREFIX},
    people::{
        person_stream::{PersonMessage, PublishedPeople, answer_templates},
        present::SharedColors,
    },
    printable::printable,
    session::{
        config::{LARGEST_QUESTION, Side, TransportConfig},
        opening::{self, Opened},
    },
    stats::RigStats,
    subscriber::Received,
    topic::{Body, PublishOutcome, Topic, TopicCounts, lock},
    views::{
        view::ViewFrame,
        viewpoint::{Leases, Viewpoint},
    },
};

/// Largest number of views of a rig, those of viewers not counted.
const MAX_VIEWS: usize = 64;

/// Counts of viewpoint requests since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ViewpointCounts {
    /// Viewpoints whose lease runs now.
    pub active: usize,
    /// Viewpoints granted, renewals not counted.
    pub granted: u64,
    /// Number of requests refused.
    pub refused: u64,
    /// Viewpoints that ended: the lease ran out, the subscriber left, or they could not be drawn.
    pub expired: u64,
}

/// Publisher of a rig; once open, no method waits for the network.
///
/// ```no_run
/// use flyrig_transport::{Publisher, RigStats, TransportConfig};
///
/// let publisher = Publisher::open(&TransportConfig::publisher("studio"))?;
/// publisher.publish_stats(&RigStats { frame: 1, frames_per_second: 30.0, ..RigStats::default() })?;
/// publisher.close()?;
/// # Ok::<(), flyrig_transport::TransportError>(())
/// ```
pub struct Publisher {
    shared: Arc<PublisherState>,
    splats: Arc<Topic>,
    /// Splat topics of all people but the first, most recently published last.
    persons: Mutex<Vec<(u32, Arc<Topic>)>>,
    people: Arc<PublishedPeople>,
    stats: Arc<Topic>,
    endpoints: Vec<String>,
    /// Gate that admits holders of keys.
    gate: Option<Gate>,
    drain: DrainThread,
    _alive: LivelinessToken,
}

impl std::fmt::Debug for Publisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Publisher")
            .field("rig", &self.shared.rig)
            .field("endpoints", &self.endpoints)
            .finish_non_exhaustive()
    }
}

impl Publisher {
    /// Opens the session and starts the publisher thread.
    ///
    /// # Errors
    /// `Config`, or `Session` when zenoh cannot listen there.
    pub fn open(config: &TransportConfig) -> Result<Self, TransportError> {
        config.validate()?;
        let rig = &config.rig;
        let Opened { session, endpoints, gate } =
            opening::open(config, Side::Sender, LARGEST_QUESTION, &[Role::Viewer, Role::Relay])?;
        let failed = |error: zenoh::Error| TransportError::session(format!("publisher of rig {rig}"), &error);

        let splats = Arc::new(Topic::new("splats".to_owned(), "splats".to_owned(), MessageKind::Splats));
        let stats = Arc::new(Topic::new("stats".to_owned(), "stats".to_owned(), MessageKind::Stats));
        let lease = Duration::from_millis(config.viewpoint_lease_millis);
        let leases =
            Leases::new(config.max_viewers, lease, config.viewpoint_pixels_per_second).with_keys(gate.is_some());
        let people = Arc::new(PublishedPeople::new());
        let mut topics = vec![splats.clone(), stats.clone()];
        topics.extend(people.first_topics());
        let (shared, woken) = PublisherState::new(rig, &session, &topics, leases);

        let state = shared.clone();
        session
            .declare_queryable(keys::key(rig, "viewpoint/*"))
            .callback(move |query| answer_viewpoint(&state, &query))
            .background()
            .wait()
            .map_err(failed)?;
        let state = shared.clone();
        session
            .liveliness()
            .declare_subscriber(keys::key(rig, "viewer/*/alive"))
            .callback(move |sample| {
                let name = keys::name_in(sample.key_expr().as_str(), "viewer", "/alive");
                if let (SampleKind::Delete, Some(name)) = (sample.kind(), name) {
                    lock(&state.leases).drop_subscriber(name);
                    state.wake();
                }
            })
            .background()
            .wait()
            .map_err(failed)?;
        let answer = Arc::new(answer_templates(people.clone())?);
        for label in ["template/*", "present/*"] {
            let answer = Arc::clone(&answer);
            session
                .declare_queryable(keys::key(rig, label))
                .callback(move |query| answer(query))
                .background()
                .wait()
                .map_err(failed)?;
        }
        let alive = keys::key(rig, &format!("alive/{}", session.zid()));
        let alive = session.liveliness().declare_token(alive).wait().map_err(failed)?;

        let drain = DrainThread::start(Drain { shared: shared.clone(), session, woken })?;
        let persons = Mutex::default();
        Ok(Self { shared, splats, persons, people, stats, endpoints, gate, drain, _alive: alive })
    }

    /// Returns the endpoints that it listens on, port 0 replaced by the actual one.
    #[must_use]
    pub fn endpoints(&self) -> &[String] {
        &self.endpoints
    }

    /// Returns the address where holders of keys connect; `None` without keys.
    #[must_use]
    pub fn gate(&self) -> Option<SocketAddr> {
        self.gate.as_ref().map(Gate::address)
    }

    /// Registers a view, so that its subscribers are noticed before its first image.
    ///
    /// # Errors
    /// `Config` for a bad name or more than 64 views.
    pub fn add_view(&self, view: &str) -> Result<(), TransportError> {
        self.view_topic(view).map(|_| ())
    }

    /// Returns whether a view that was added or published, or that of a requested viewpoint, has subscribers; up to about 50 ms old.
    #[must_use]
    pub fn has_subscribers(&self, view: &str) -> bool {
        lock(&self.shared.topics).get(&keys::view_label(view)).is_some_and(|topic| topic.is_watched())
    }

    /// Returns whether the splats of the first person have subscribers; a [`crate::Subscriber`] takes those of all people.
    #[must_use]
    pub fn has_splat_subscribers(&self) -> bool {
        self.splats.is_watched()
    }

    /// Hands in an image of a view.
    ///
    /// # Errors
    /// `Config` for a bad name, size or more than 64 views.
    pub fn publish_view(&self, view: &str, frame: ViewFrame) -> Result<PublishOutcome, TransportError> {
        frame.validate(view)?;
        let Some(topic) = self.view_topic(view)? else { return Ok(PublishOutcome::Unwatched) };
        let header = Header {
            frame: frame.frame,
            capture_nanos: frame.capture_nanos,
            width: frame.width,
            height: frame.height,
            ..empty_header()
        };
        Ok(self.offer(&topic, Body::View(frame), header))
    }

    /// Hands in the splat state of a person; the publisher thread encodes it. Each person has a slot of its own; the first state of a
    /// new person is [`PublishOutcome::Unwatched`], since it could not be subscribed to yet.
    pub fn publish_splats(&self, state: Arc<SplatState>) -> PublishOutcome {
        let header = Header { frame: state.frame, capture_nanos: state.capture_nanos, ..empty_header() };
        let topic = match state.person {
            0 => self.splats.clone(),
            person => self.person_topic(person),
        };
        self.offer(&topic, Body::Splats(state), header)
    }

    /// Returns whether the person stream has subscribers.
    #[must_use]
    pub fn has_person_subscribers(&self) -> bool {
        self.people.is_watched()
    }

    /// Keeps the template of a person for viewers that query it; those of the last [`MAX_PERSON_TOPICS`] + 1 people are kept. Viewers that
    /// join get the present colours, which are decoded from those that are published: give their encoder instead where there is one
    /// ([`Self::offer_template_with`]).
    pub fn offer_template(&self, person: u32, hash: u64, bytes: Bytes) {
        self.people.present.decode_colors(person, &bytes);
        self.people.offer_template(person, hash, bytes);
    }

    /// Keeps the template of a person, as [`Self::offer_template`] does, and the encoder of the colours for viewers that join. The encoder
    /// is locked while its state is encoded.
    pub fn offer_template_with(&self, person: u32, hash: u64, bytes: Bytes, colors: SharedColors) {
        self.people.present.set_colors(person, colors);
        self.people.offer_template(person, hash, bytes);
    }

    /// Hands in a message of the person stream: motion, or a layer of colours. It replaces a waiting one of the same kind.
    pub fn publish_person(&self, stamp: &Stamp, layer: Option<usize>, bytes: Bytes) -> PublishOutcome {
        let header = Header { frame: stamp.frame, capture_nanos: stamp.capture_nanos, ..empty_header() };
        self.offer_person(stamp.person, layer, bytes, header)
    }

    /// Hands in a message of another publisher's person stream with its original times.
    pub(crate) fn pass_on(&self, received: Received<PersonMessage>) -> PublishOutcome {
        let PersonMessage { person, layer, bytes } = received.body;
        self.offer_person(person, layer, bytes, received.header)
    }

    fn offer_person(&self, person: u32, layer: Option<usize>, bytes: Bytes, header: Header) -> PublishOutcome {
        let topics = self.people.topics(person, &self.shared);
        let host = if header.host == 0 { host_id() } else { header.host };
        self.people.present.published(person, layer, &bytes, host, Instant::now());
        topics
            .get(layer.map_or(0, |layer| layer + 1))
            .map_or(PublishOutcome::Unwatched, |topic| self.offer(topic, Body::Bytes(bytes), header))
    }

    fn person_topic(&self, person: u32) -> Arc<Topic> {
        let mut persons = lock(&self.persons);
        if let Some(at) = persons.iter().position(|(other, _)| *other == person) {
            persons[at..].rotate_left(1);
            return persons[persons.len() - 1].1.clone();
        }
        let label = keys::splats_label(person);
        let topic = Arc::new(Topic::new(label.clone(), label.clone(), MessageKind::Splats));
        let mut topics = lock(&self.shared.topics);
        if persons.len() >= MAX_PERSON_TOPICS {
            let (oldest, _) = persons.remove(0);
            topics.remove(&keys::splats_label(oldest));
        }
        topics.insert(label, topic.clone());
        persons.push((person, topic.clone()));
        topic
    }

    /// Hands in statistics.
    ///
    /// # Errors
    /// `Config` when a figure is not finite.
    pub fn publish_stats(&self, stats: &RigStats) -> Result<PublishOutcome, TransportError> {
        let header = Header { frame: stats.frame, capture_nanos: stats.capture_nanos, ..empty_header() };
        Ok(self.offer(&self.stats, Body::Bytes(Bytes::from(stats.encode()?)), header))
    }

    /// Sets the calibration; it is sent to the first subscriber, and once per second for later ones.
    ///
    /// # Errors
    /// `Config` when the rig is not valid or a camera's name cannot be part of a key.
    pub fn set_calibration(&self, rig: &Rig) -> Result<(), TransportError> {
        let topic = |label: String, kind| Arc::new(Topic::new(label.clone(), label, kind));
        let transforms = topic("transforms".to_owned(), MessageKind::Transforms);
        let mut calibration = vec![Retained { topic: transforms, bytes: Bytes::from(encode_transforms(rig)?) }];
        for camera in &rig.cameras {
            keys::check_name("camera", camera.id.as_str())?;
            let lens = topic(format!("calibration/{}", camera.id), MessageKind::Calibration);
            calibration.push(Retained { topic: lens, bytes: Bytes::from(encode_calibration(camera)?) });
        }
        let mut topics = lock(&self.shared.topics);
        topics.retain(|_, topic| !matches!(topic.kind, MessageKind::Calibration | MessageKind::Transforms));
        topics.extend(calibration.iter().map(|Retained { topic, .. }| (topic.label.clone(), topic.clone())));
        *lock(&self.shared.calibration) = calibration.into();
        drop(topics);
        self.shared.wake();
        Ok(())
    }

    /// Returns the viewpoints whose lease runs.
    #[must_use]
    pub fn requested_viewpoints(&self) -> Vec<Viewpoint> {
        let mut leases = lock(&self.shared.leases);
        leases.expire(Instant::now());
        leases.viewpoints()
    }

    /// Takes the viewpoints to draw for the frame set at `now`: those that are watched and whose last image is a period of their
    /// `max_fps` old. The next image of each is due a period later, so call this once per frame set.
    #[must_use]
    pub fn due_viewpoints(&self, now: Instant) -> Vec<Viewpoint> {
        let watched = |topic: &&Arc<Topic>| topic.is_watched() && topic.name.starts_with(VIEWER_PREFIX);
        let watched: BTreeSet<String> =
            lock(&self.shared.topics).values().filter(watched).map(|topic| topic.name.clone()).collect();
        lock(&self.shared.leases).take_due(now, |view| watched.contains(view))
    }

    /// Sets the largest viewpoint that the rig can draw, pixels; larger ones end, and are refused with a reason. There is no limit at
    /// first.
    pub fn set_max_view_pixels(&self, pixels: u64) {
        lock(&self.shared.leases).set_max_view_pixels(pixels);
        self.shared.sync_viewer_topics();
    }

    /// Ends the viewpoint of a subscriber because it could not be drawn. The same request is refused with this reason for a minute;
    /// another camera or rate is tried again.
    pub fn refuse_viewpoint(&self, subscriber: &str, reason: &str) {
        lock(&self.shared.leases).refuse(subscriber, reason, Instant::now());
        self.shared.sync_viewer_topics();
    }

    /// Returns the counts of viewpoint requests.
    #[must_use]
    pub fn viewpoint_counts(&self) -> ViewpointCounts {
        let leases = lock(&self.shared.leases);
        ViewpointCounts {
            active: leases.len(),
            granted: leases.granted,
            refused: leases.refused,
            expired: leases.expired,
        }
    }

    /// Returns the counts of each topic: `view/NAME`, `viewer/SUBSCRIBER/view`, `splats`, `splats/PERSON`, `stats`,
    /// `calibration/CAMERA`, `transforms`.
    #[must_use]
    pub fn counts(&self) -> Vec<(String, TopicCounts)> {
        lock(&self.shared.topics).iter().map(|(label, topic)| (label.clone(), topic.counts())).collect()
    }

    /// Returns the health of the publisher thread.
    #[must_use]
    pub fn thread(&self) -> ThreadHealth {
        self.drain.health()
    }

    /// Ends the thread and the session; dropping does the same without reporting errors.
    ///
    /// # Errors
    /// `Session` when the thread died or zenoh fails to close.
    pub fn close(mut self) -> Result<(), TransportError> {
        self.drain.stop()
    }

    fn offer(&self, topic: &Topic, body: Body, header: Header) -> PublishOutcome {
        let outcome = topic.offer(body, header);
        if outcome != PublishOutcome::Unwatched {
            self.shared.wake();
        }
        outcome
    }

    /// Returns the topic of a view; `None` for the view of a viewer whose lease has ended.
    fn view_topic(&self, view: &str) -> Result<Option<Arc<Topic>>, TransportError> {
        let label = keys::view_label(view);
        let mut topics = lock(&self.shared.topics);
        if let Some(topic) = topics.get(&label) {
            return Ok(Some(topic.clone()));
        }
        if view.starts_with(VIEWER_PREFIX) {
            return Ok(None);
        }
        keys::check_name("view", view)?;
        let views = topics.keys().filter(|label| label.starts_with("view/")).count();
        if views >= MAX_VIEWS {
            return Err(TransportError::config(format!("view {view}"), format!("a rig has at most {MAX_VIEWS} views")));
        }
        let topic = Arc::new(Topic::new(label.clone(), view.to_owned(), MessageKind::View));
        topics.insert(label, topic.clone());
        Ok(Some(topic))
    }
}

/// Answers a request for a viewpoint; runs on a zenoh thread, so it is short and never waits.
fn answer_viewpoint(shared: &PublisherState, query: &Query) {
    let key = query.key_expr().as_str();
    let Some(subscriber) = keys::name_in(key, "viewpoint", "") else { return };
    // A payload that is too long is not even copied, and refused as empty.
    let payload = query.payload().filter(|payload| payload.len() <= MAX_JSON_BYTES);
    let payload = payload.map(zenoh::bytes::ZBytes::to_bytes).unwrap_or_default();
    let answer = lock(&shared.leases).ask(subscriber, from_json(key, &payload), Instant::now());
    if !answer.granted {
        tracing::debug!(subscriber = %printable(subscriber), reason = answer.reason, "refused a viewpoint");
    }
    shared.sync_viewer_topics();
    shared.wake();
    let replied = to_json(key, &answer).and_then(|bytes| {
        query.reply(query.key_expr(), bytes).wait().map_err(|error| TransportError::session(key, &error))
    });
    if let Err(error) = replied {
        tracing::warn!(%error, "could not answer a viewpoint request");
    }
}

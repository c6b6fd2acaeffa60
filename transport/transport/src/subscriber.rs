//! Subscriber: the viewer's side.

use std::{sync::Arc, time::Duration};

use flyrig_access::KeyProbe;
use flyrig_stream::{MAX_SPLAT_BYTES, SplatState};
use flyrig_types::{Camera, Rig};
use prost::bytes::Bytes;
use zenoh::{Session, Wait, liveliness::LivelinessToken, sample::SampleKind};

use crate::{
    error::TransportError,
    header::Header,
    inbox::{Inbox, Raw, as_malformed},
    keys::{self, VIEWER_PREFIX},
    people::{
        person_stream::{PersonMessage, PersonSubscription},
        template_fetcher::TemplateFetcher,
    },
    report::TopicReport,
    session::{
        config::{LARGEST_QUESTION, Side, TransportConfig},
        opening::{self, Opened},
    },
    stats::RigStats,
    views::{
        renewal::Renewal,
        view::{MAX_MESSAGE_BYTES, ViewFrame},
        viewpoint::{ViewpointStatus, check_camera},
    },
};

/// Selection of views to receive.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Views {
    /// No view.
    #[default]
    None,
    /// Every view of the rig, without the viewpoints of other subscribers.
    All,
    /// Views of these names.
    Named(Vec<String>),
}

/// Selection of messages to receive; the others are not sent to this subscriber at all. Calibration always arrives, a viewpoint on
/// request.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Interests {
    /// Rendered views.
    pub views: Views,
    /// Whether to receive splat states.
    pub splats: bool,
    /// Whether to receive the person stream: motion, and colours once a template has been fetched.
    pub people: bool,
    /// Whether to receive the rig's statistics.
    pub stats: bool,
}

/// Received message with its header.
#[derive(Debug, Clone, PartialEq)]
pub struct Received<T> {
    /// Name of the view, otherwise the topic.
    pub topic: String,
    /// Header of the message.
    pub header: Header,
    /// Time from the publisher's hand-in to the receipt here; between hosts and for images by wall clocks, where it may be negative.
    pub latency_nanos: i64,
    /// Whether both ends run on one host, so that the latency is exact; that of images unless the wall clock is set meanwhile.
    pub latency_is_exact: bool,
    /// Decoded message.
    pub body: T,
}

/// Subscriber of a rig; the newest message of each topic waits for its reader, older ones are replaced and counted.
///
/// ```no_run
/// use std::time::Duration;
///
/// use flyrig_transport::{Interests, Subscriber, TransportConfig};
///
/// let interests = Interests { stats: true, ..Interests::default() };
/// let subscriber = Subscriber::open(&TransportConfig::subscriber("studio"), &interests)?;
/// if let Some(received) = subscriber.next_stats(Duration::from_secs(2))? {
///     println!("{:.1} frame sets per second", received.body.frames_per_second);
/// }
/// # Ok::<(), flyrig_transport::TransportError>(())
/// ```
pub struct Subscriber {
    inbox: Arc<Inbox>,
    people: Arc<PersonSubscription>,
    id: String,
    renewal: Renewal,
    probe: Option<KeyProbe>,
    session: Session,
    closed: bool,
    _alive: LivelinessToken,
}

impl std::fmt::Debug for Subscriber {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Subscriber").field("id", &self.id).finish_non_exhaustive()
    }
}

impl Subscriber {
    /// Opens the session; the publisher may start later.
    ///
    /// # Errors
    /// `Config` or `Session`.
    pub fn open(config: &TransportConfig, interests: &Interests) -> Result<Self, TransportError> {
        config.validate()?;
        let rig = &config.rig;
        let failed = |error: zenoh::Error| TransportError::session(format!("subscriber of rig {rig}"), &error);
        let largest = MAX_MESSAGE_BYTES.max(MAX_SPLAT_BYTES) + LARGEST_QUESTION;
        let Opened { session, .. } = opening::open(config, Side::Receiver, largest, &[])?;
        let id = session.zid().to_string();
        let id = config.key.as_ref().map_or_else(|| id.clone(), |key| keys::session_name(&key.topic_name, &id));
        let inbox = Arc::new(Inbox::new(format!("{VIEWER_PREFIX}{id}"), config.inbox_bytes));

        let mut labels = vec!["calibration/*".to_owned(), "transforms".to_owned(), format!("viewer/{id}/view")];
        match &interests.views {
            Views::None => {}
            Views::All => labels.push("view/*".to_owned()),
            Views::Named(names) => {
                for name in names {
                    keys::check_name("view", name)?;
                    labels.push(keys::view_label(name));
                }
            }
        }
        if interests.splats {
            labels.extend(["splats".to_owned(), format!("{}*", keys::PERSON_SPLATS)]);
        }
        labels.extend(interests.stats.then(|| "stats".to_owned()));
        for label in labels {
            let inbox = inbox.clone();
            session
                .declare_subscriber(keys::key(rig, &label))
                .callback(move |sample| inbox.receive(&sample))
                .background()
                .wait()
                .map_err(failed)?;
        }
        let watcher = inbox.clone();
        let people = Arc::new(PersonSubscription::new(&session, rig, &inbox));
        // The session keeps the callback, and the people the session.
        let to_people = Arc::downgrade(&people);
        if interests.people {
            people.begin_motion()?;
        }
        session
            .liveliness()
            .declare_subscriber(keys::any_version_alive(rig))
            .history(true)
            .callback(move |sample| {
                let is_alive = sample.kind() == SampleKind::Put;
                watcher.publisher_alive(sample.key_expr().as_str(), is_alive);
                if let Some(people) = to_people.upgrade().filter(|_| is_alive) {
                    people.rig_appeared();
                }
            })
            .background()
            .wait()
            .map_err(failed)?;
        let alive = keys::key(rig, &format!("viewer/{id}/alive"));
        let alive = session.liveliness().declare_token(alive).wait().map_err(failed)?;
        let key = keys::key(rig, &format!("viewpoint/{id}"));
        let renewal = Renewal::start(session.clone(), key, format!("{VIEWER_PREFIX}{id}"))?;
        let connected = inbox.clone();
        let probe = opening::probe(config, move || connected.publishers() > 0)?;
        Ok(Self { inbox, people, id, renewal, probe, session, closed: false, _alive: alive })
    }

    /// Returns the name of this subscriber towards the publisher.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Returns the name of the view under which the requested viewpoint arrives.
    #[must_use]
    pub fn viewpoint_view(&self) -> String {
        format!("{VIEWER_PREFIX}{}", self.id)
    }

    /// Takes the next waiting image of any view (views take turns); `None` after the timeout.
    ///
    /// # Errors
    /// `UnknownVersion` or `Malformed`, once for each such message or publisher of any topic; the subscriber stays usable. After an
    /// error a waiting message comes first, so that errors delay no message.
    pub fn next_view(&self, timeout: Duration) -> Result<Option<Received<ViewFrame>>, TransportError> {
        let Some((label, raw)) = self.inbox.next(timeout, |label| self.inbox.view_name(label).is_some())? else {
            return Ok(None);
        };
        let name = self.inbox.view_name(&label).unwrap_or(&label).to_owned();
        self.received(name, raw, ViewFrame::decode).map(Some)
    }

    /// Takes the newest waiting splat state of any person (people take turns, see [`SplatState::person`]); `None` after the timeout.
    ///
    /// # Errors
    /// As [`Self::next_view`].
    pub fn next_splats(&self, timeout: Duration) -> Result<Option<Received<SplatState>>, TransportError> {
        let Some((label, raw)) = self.inbox.next(timeout, keys::is_splats)? else { return Ok(None) };
        self.received(label, raw, |_, _, payload| Ok(SplatState::decode(&payload)?)).map(Some)
    }

    /// Takes the next waiting message of the person stream, topics in turns; `None` after the timeout. Call it often: only the newest
    /// message of a topic waits. What was published before comes like other messages: the last motions once the rig appears, and the
    /// present colours of a person whose template [`TemplateFetcher::take`] returned. It also adapts the number of colour layers, see [`Self::color_layers`].
    ///
    /// # Errors
    /// As [`Self::next_view`].
    pub fn next_person(&self, timeout: Duration) -> Result<Option<Received<PersonMessage>>, TransportError> {
        self.people.follow();
        let Some((label, raw)) = self.inbox.next(timeout, keys::is_person)? else { return Ok(None) };
        let (person, layer) = keys::person_in(&label).unwrap_or_default();
        self.received(label, raw, |_, _, bytes| Ok(PersonMessage { person, layer, bytes })).map(Some)
    }

    /// Queries the bytes of the [`flyrig_stream::StreamTemplate`] that a motion's stamp names. Returns `None` without an answer within
    /// `timeout`, and at once while no publisher of templates is known; ask again then.
    ///
    /// # Errors
    /// `Malformed` when the answer is not that template, `Session` when the query cannot be sent.
    pub fn template(&self, hash: u64, timeout: Duration) -> Result<Option<Vec<u8>>, TransportError> {
        self.people.ask_template(hash, timeout)
    }

    /// Fetches the last motions again; they come through [`Self::next_person`].
    pub(crate) fn fetch_motions(&self) {
        self.people.rig_appeared();
    }

    /// Fetches the present colours of a person whose template [`Self::template`] returned; they come through [`Self::next_person`]. Never
    /// waits.
    pub fn fetch_colors(&self, person: u32) {
        self.people.template_taken(&[person]);
    }

    /// Starts a fetcher of templates, which works in parallel to this subscriber.
    ///
    /// # Errors
    /// `Session` when no thread can be started.
    pub fn template_fetcher(&self) -> Result<TemplateFetcher, TransportError> {
        TemplateFetcher::start(self.people.clone())
    }

    /// Takes the newest waiting statistics; `None` after the timeout.
    ///
    /// # Errors
    /// As [`Self::next_view`].
    pub fn next_stats(&self, timeout: Duration) -> Result<Option<Received<RigStats>>, TransportError> {
        let Some((label, raw)) = self.inbox.next(timeout, |label| label == "stats")? else { return Ok(None) };
        self.received(label, raw, |_, _, payload| RigStats::decode(&payload)).map(Some)
    }

    /// Returns the rig once all of its cameras have arrived; waits at most `timeout`, which may be zero.
    ///
    /// # Errors
    /// As [`Self::next_view`].
    pub fn rig(&self, timeout: Duration) -> Result<Option<Rig>, TransportError> {
        self.inbox.rig(timeout)
    }

    /// Requests images through a camera of this subscriber, or moves it; the lease is renewed until the viewpoint is released. The
    /// images arrive through [`Self::next_view`] as the view [`Self::viewpoint_view`].
    ///
    /// # Errors
    /// `Config` when the camera is not valid, larger than 4096 pixels per side, or another number, `max_fps` included (0.01 to 1000), is out of its range.
    pub fn request_viewpoint(&self, camera: &Camera, max_fps: f64) -> Result<(), TransportError> {
        check_camera("our viewpoint", camera, max_fps)?;
        self.renewal.want(Some((camera.clone(), max_fps)));
        Ok(())
    }

    /// Releases the viewpoint.
    pub fn release_viewpoint(&self) {
        self.renewal.want(None);
    }

    /// Returns the status of the requested viewpoint.
    #[must_use]
    pub fn viewpoint_status(&self) -> ViewpointStatus {
        self.renewal.status()
    }

    /// Returns the number of subscribed colour layers, from the coarsest, 0..=[`flyrig_stream::LAYERS`]: fewer while motion is late or
    /// missing, none before the first template.
    #[must_use]
    pub fn color_layers(&self) -> usize {
        self.inbox.color_layers()
    }

    /// Returns whether the line is why fewer than all layers are subscribed to: motion came late or was lost, or a template took too long.
    #[must_use]
    pub fn is_line_slow(&self) -> bool {
        self.inbox.is_line_slow()
    }

    /// Returns the number of live publishers of this rig with the same schema version.
    #[must_use]
    pub fn publishers(&self) -> usize {
        self.inbox.publishers()
    }

    /// Returns why the rig rejects the key; `None` once it accepts it, without a key, and before the first answer.
    #[must_use]
    pub fn trouble(&self) -> Option<String> {
        self.probe.as_ref().and_then(KeyProbe::trouble)
    }

    /// Returns the report of each topic (`view/NAME`, `viewer/SUBSCRIBER/view`, `splats`, ...).
    #[must_use]
    pub fn reports(&self) -> Vec<(String, TopicReport)> {
        self.inbox.reports()
    }

    /// Returns the number of messages and publishers that could not be read since the start.
    #[must_use]
    pub fn unreadable(&self) -> u64 {
        self.inbox.unreadable()
    }

    /// Releases the viewpoint and ends the session; dropping does the same without reporting errors.
    ///
    /// # Errors
    /// `Session` when zenoh fails to close.
    pub fn close(mut self) -> Result<(), TransportError> {
        self.stop()
    }

    fn stop(&mut self) -> Result<(), TransportError> {
        if std::mem::replace(&mut self.closed, true) {
            return Ok(());
        }
        let stopped = self.renewal.stop();
        let closed = self.session.close().wait().map_err(|error| TransportError::session("closing", &error));
        stopped.and(closed)
    }

    fn received<T>(
        &self,
        topic: String,
        raw: Raw,
        decode: impl Fn(&str, &Header, Bytes) -> Result<T, TransportError>,
    ) -> Result<Received<T>, TransportError> {
        let Raw { header, payload, latency_nanos, exact } = raw;
        let body = decode(&topic, &header, payload).map_err(|error| {
            self.inbox.count_unreadable();
            as_malformed(error)
        })?;
        Ok(Received { topic, header, latency_nanos, latency_is_exact: exact, body })
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        if let Err(error) = self.stop() {
            tracing::warn!(%error, "closing the subscriber");
        }
    }
}

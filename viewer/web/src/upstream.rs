//! The one subscription to the rig, while browsers watch.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_stream::{ColorDecoder, LAYERS, StreamTemplate, WholeColors, stamp_of};
use flyrig_transport::{
    FetchedTemplate, Header, Interests, PersonMessage, Received, RigStats, SubjectStats, Subscriber, TemplateFetcher,
    TransportConfig, TransportError,
};
use serde::Serialize;

use crate::hub::Hub;

/// Time limit of waiting for a message.
const PATIENCE: Duration = Duration::from_millis(50);
/// Interval between checks of statistics and calibration.
const CHECK_EVERY: Duration = Duration::from_millis(250);
/// Pause after a session that could not be opened.
const SESSION_RETRY: Duration = Duration::from_millis(500);
/// Time that the subscription outlives the last browser, so that a page that is loaded again finds it.
const LINGER: Duration = Duration::from_secs(5);

/// Largest plausible age of a motion at its arrival, nanoseconds.
const OLDEST_NANOS: i64 = 60_000_000_000;

/// Status of the rig for the page.
#[derive(Debug, Default, Serialize)]
struct State<'a> {
    rig: &'a str,
    /// Why no people can be shown; `None` without a problem.
    trouble: Option<String>,
    /// Whether the rig is up and has sent its statistics.
    is_running: bool,
    /// Frame sets per second of the rig.
    sets_per_second: f64,
    /// Number, state and tracking quality, 0..=1, of each person.
    people: Vec<(u32, String, Option<f64>)>,
    /// Time for which a person has been measured who cannot be shown yet, seconds.
    measuring_secs: Option<f64>,
    /// Number of subscribed colour layers, and of all layers.
    color_layers: (usize, usize),
    /// Whether the line to the rig is why layers are missing.
    is_line_slow: bool,
    /// Present time by the clock of the motions' stamps, seconds.
    clock_secs: Option<f64>,
}

/// Feeds browsers until `stop` is set.
pub(crate) fn run(config: &TransportConfig, hub: &Arc<Hub>, stop: &AtomicBool) {
    let mut link: Option<Link> = None;
    let mut watched = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        if hub.browsers() > 0 {
            watched = Instant::now();
        } else if watched.elapsed() >= LINGER || link.is_none() {
            if link.take().is_some() {
                hub.forget_people();
            }
            std::thread::sleep(PATIENCE);
            continue;
        }
        match &mut link {
            Some(link) => link.turn(config, hub),
            None => match Link::open(config) {
                Ok(opened) => link = Some(opened),
                Err(error) => {
                    send_state(hub, &State { rig: &config.rig, trouble: Some(error.to_string()), ..State::default() });
                    std::thread::sleep(SESSION_RETRY);
                }
            },
        }
    }
}

/// Subscription to the rig.
struct Link {
    subscriber: Subscriber,
    templates: TemplateFetcher,
    /// Time of the last check of statistics and calibration.
    checked: Option<Instant>,
    stats: Option<RigStats>,
    was_up: bool,
    /// Decoders of the colours of people, for browsers that join.
    colors: BTreeMap<u32, ColorDecoder>,
    /// Arrival of the newest motion, and the time of the stamps' clock then, nanoseconds.
    clock: Option<(Instant, i64)>,
}

impl Link {
    fn open(config: &TransportConfig) -> Result<Self, TransportError> {
        let subscriber = Subscriber::open(config, &Interests { people: true, stats: true, ..Interests::default() })?;
        let templates = subscriber.template_fetcher()?;
        let (colors, clock) = (BTreeMap::new(), None);
        Ok(Self { subscriber, templates, checked: None, stats: None, was_up: false, colors, clock })
    }

    fn turn(&mut self, config: &TransportConfig, hub: &Hub) {
        if self.checked.is_none_or(|at| at.elapsed() >= CHECK_EVERY) {
            self.checked = Some(Instant::now());
            self.report(config, hub);
        }
        match self.templates.take() {
            Ok(Some(FetchedTemplate { people, hash, bytes })) => {
                let template = StreamTemplate::decode(&bytes).ok();
                for person in people {
                    hub.template(person, hash, &bytes);
                    self.colors.remove(&person);
                    if let Some(template) = template.as_ref().filter(|template| !template.has_colors()) {
                        self.colors.insert(person, ColorDecoder::new(template));
                    }
                }
            }
            Ok(None) => {}
            Err(error) => tracing::debug!("{error}"),
        }
        match self.subscriber.next_person(PATIENCE) {
            Ok(Some(received)) => {
                self.note_clock(&received);
                self.pass_on(&received.body, hub);
            }
            Ok(None) => {}
            Err(error) => tracing::debug!("{error}"),
        }
        if hub.wants_whole() {
            let messages = |decoder: &ColorDecoder| decoder.whole(0).into_iter().map(|(_, bytes)| bytes).collect();
            let people: Vec<_> = self.colors.iter().map(|(person, decoder)| (*person, messages(decoder))).collect();
            hub.whole(&people);
        }
    }

    /// Relates the stamps' clock to this program's by a motion that has arrived. The age at the hand-in is by one clock of the rig's
    /// computer, the way to here by wall clocks where that is another computer.
    fn note_clock(&mut self, received: &Received<PersonMessage>) {
        let Header { capture_nanos, publish_nanos, .. } = received.header;
        if received.body.layer.is_some() || publish_nanos == 0 {
            return;
        }
        let offset = self.stats.as_ref().and_then(|stats| stats.clock_offset_nanos);
        let age = |offset: i64| publish_nanos.saturating_sub(capture_nanos.saturating_add(offset));
        let is_possible = |age: &i64| (0..OLDEST_NANOS).contains(age);
        // A simulated or recorded source has a clock of its own.
        let handed_in = Some(age(0)).filter(is_possible).or_else(|| Some(age(offset?)).filter(is_possible));
        let now = handed_in.map(|age| capture_nanos.saturating_add(age).saturating_add(received.latency_nanos.max(0)));
        self.clock = now.map(|nanos| (Instant::now(), nanos));
    }

    /// Passes a message on, or requests its template.
    fn pass_on(&mut self, message: &PersonMessage, hub: &Hub) {
        let Ok(stamp) = stamp_of(&message.bytes) else { return };
        if !hub.has_template(message.person, stamp.template) {
            // Motion and colours of a template that has not arrived yet are repeated.
            return self.templates.ask(message.person, stamp.template);
        }
        match message.layer {
            None => hub.motion(message.person, &message.bytes),
            Some(_) => {
                if let Some(decoder) = self.colors.get_mut(&message.person) {
                    // The browsers report what is damaged.
                    drop(decoder.ingest(&message.bytes));
                }
                hub.colors(message.person, &message.bytes);
            }
        }
    }

    /// Passes on calibration and the status of the rig.
    fn report(&mut self, config: &TransportConfig, hub: &Hub) {
        if let Ok(Some(stats)) = self.subscriber.next_stats(Duration::ZERO) {
            self.stats = Some(stats.body);
        }
        let is_up = self.subscriber.publishers() > 0;
        if std::mem::replace(&mut self.was_up, is_up) && !is_up {
            hub.forget_people();
            (self.stats, self.clock) = (None, None);
            self.colors.clear();
        }
        let rig = self.subscriber.rig(Duration::ZERO).ok().flatten();
        if let Some(json) = rig.as_ref().and_then(|rig| serde_json::to_vec(rig).ok()) {
            hub.rig(&json);
        }
        let trouble = match (is_up, &rig) {
            (false, _) => self
                .subscriber
                .trouble()
                .or_else(|| Some(format!("No rig '{}' yet: check that `flyrig run` is up", config.rig))),
            (true, None) => Some("Waiting for the rig's calibration".to_owned()),
            (true, Some(_)) => None,
        };
        let stats = self.stats.as_ref();
        let person = |of: &SubjectStats| (of.person, of.state.clone(), of.quality);
        let since = |(at, nanos): (Instant, i64)| nanos as f64 / 1e9 + at.elapsed().as_secs_f64();
        let state = State {
            rig: &config.rig,
            trouble,
            is_running: stats.is_some(),
            sets_per_second: stats.map_or(0.0, |stats| stats.frames_per_second),
            people: stats.map(|stats| stats.subjects.iter().map(person).collect()).unwrap_or_default(),
            measuring_secs: stats.and_then(|stats| stats.measuring_secs),
            color_layers: (self.subscriber.color_layers(), LAYERS),
            is_line_slow: self.subscriber.is_line_slow(),
            clock_secs: self.clock.map(since),
        };
        send_state(hub, &state);
    }
}

/// Sends the status of the rig to the browsers.
fn send_state(hub: &Hub, state: &State<'_>) {
    if let Ok(json) = serde_json::to_vec(state) {
        hub.state(&json);
    }
}

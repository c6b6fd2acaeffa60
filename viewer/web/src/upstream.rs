//! The one subscription to the rig, while browsers watch.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_stream::{LAYERS, stamp_of};
use flyrig_transport::{
    FetchedTemplate, Interests, PersonMessage, RigStats, Subscriber, TemplateFetcher, TransportConfig, TransportError,
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

/// Status of the rig for the page.
#[derive(Debug, Serialize)]
struct State<'a> {
    rig: &'a str,
    /// Why no people can be shown; `None` without a problem.
    trouble: Option<String>,
    /// Frame sets per second of the rig.
    sets_per_second: f64,
    /// Number and tracking quality, 0..=1, of each person.
    people: Vec<(u32, Option<f64>)>,
    /// Number of subscribed colour layers, and of all layers.
    color_layers: (usize, usize),
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
                    send_state(hub, &config.rig, Some(error.to_string()), None, LAYERS);
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
}

impl Link {
    fn open(config: &TransportConfig) -> Result<Self, TransportError> {
        let subscriber = Subscriber::open(config, &Interests { people: true, stats: true, ..Interests::default() })?;
        let templates = subscriber.template_fetcher()?;
        Ok(Self { subscriber, templates, checked: None, stats: None, was_up: false })
    }

    fn turn(&mut self, config: &TransportConfig, hub: &Hub) {
        if self.checked.is_none_or(|at| at.elapsed() >= CHECK_EVERY) {
            self.checked = Some(Instant::now());
            self.report(config, hub);
        }
        match self.templates.take() {
            Ok(Some(FetchedTemplate { people, hash, bytes })) => {
                people.into_iter().for_each(|person| hub.template(person, hash, &bytes));
            }
            Ok(None) => {}
            Err(error) => tracing::debug!("{error}"),
        }
        match self.subscriber.next_person(PATIENCE) {
            Ok(Some(received)) => self.pass_on(&received.body, hub),
            Ok(None) => {}
            Err(error) => tracing::debug!("{error}"),
        }
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
            Some(_) => hub.colors(message.person, &message.bytes),
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
            self.stats = None;
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
        send_state(hub, &config.rig, trouble, self.stats.as_ref(), self.subscriber.color_layers());
    }
}

/// Sends the status of the rig to the browsers.
fn send_state(hub: &Hub, rig: &str, trouble: Option<String>, stats: Option<&RigStats>, layers: usize) {
    let people = stats.map(|stats| stats.subjects.iter().map(|of| (of.person, of.quality)).collect());
    let sets_per_second = stats.map_or(0.0, |stats| stats.frames_per_second);
    let state =
        State { rig, trouble, sets_per_second, people: people.unwrap_or_default(), color_layers: (layers, LAYERS) };
    if let Ok(json) = serde_json::to_vec(&state) {
        hub.state(&json);
    }
}

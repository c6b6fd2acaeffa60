//! Publisher thread: tracks subscriptions, drains the slots, repeats the calibration, ends leases.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use crossbeam::channel::{Receiver, Sender};
use flyrig_types::{SupervisedThread, ThreadHealth};
use prost::bytes::Bytes;
use zenoh::{Session, Wait, qos::CongestionControl};

use crate::{
    error::TransportError,
    header::{Header, MessageKind, empty_header},
    host,
    keys::{self, VIEWER_PREFIX},
    topic::{Body, Pending, Topic, lock},
    views::viewpoint::Leases,
};

/// Interval between checks of subscriptions and leases.
const TICK: Duration = Duration::from_millis(50);

/// Interval at which the calibration is repeated for late subscribers.
const REPEAT: Duration = Duration::from_secs(1);

/// Delay before a zenoh publisher that could not be declared is tried again.
const DECLARE_RETRY: Duration = Duration::from_secs(1);

/// Message that is repeated.
#[derive(Clone)]
pub(crate) struct Retained {
    pub topic: Arc<Topic>,
    pub bytes: Bytes,
}

/// State shared by the handles, the zenoh callbacks and the publisher thread.
pub(crate) struct PublisherState {
    pub rig: String,
    pub publisher_id: u64,
    pub host_id: u64,
    pub topics: Mutex<BTreeMap<String, Arc<Topic>>>,
    pub calibration: Mutex<Arc<[Retained]>>,
    pub leases: Mutex<Leases>,
    pub stop: AtomicBool,
    /// Channel of wake-ups, which holds at most one.
    pub wake: Sender<()>,
}

impl PublisherState {
    /// Creates the state of a session that publishes these topics, and the receiver of its wake-ups.
    pub(crate) fn new(
        rig: &str,
        session: &Session,
        topics: &[Arc<Topic>],
        leases: Leases,
    ) -> (Arc<Self>, Receiver<()>) {
        let (wake, woken) = crossbeam::channel::bounded(1);
        let shared = Self {
            rig: rig.to_owned(),
            publisher_id: host::fnv1a(session.zid().to_string().as_bytes()),
            host_id: host::host_id(),
            topics: Mutex::new(topics.iter().map(|topic| (topic.label.clone(), topic.clone())).collect()),
            calibration: Mutex::new(Arc::new([])),
            leases: Mutex::new(leases),
            stop: AtomicBool::new(false),
            wake,
        };
        (Arc::new(shared), woken)
    }

    pub(crate) fn wake(&self) {
        // A full channel wakes the thread anyway.
        let _ = self.wake.try_send(());
    }

    /// Adds and removes the viewers' topics according to the leases, so that viewers who come and go for days leave nothing behind.
    pub(crate) fn sync_viewer_topics(&self) {
        let views: Vec<String> = lock(&self.leases).viewpoints().into_iter().map(|viewpoint| viewpoint.view).collect();
        let mut topics = lock(&self.topics);
        topics.retain(|_, topic| !topic.name.starts_with(VIEWER_PREFIX) || views.contains(&topic.name));
        for view in views {
            if !topics.values().any(|topic| topic.name == view) {
                let label = keys::view_label(&view);
                topics.insert(label.clone(), Arc::new(Topic::new(label, view, MessageKind::View)));
            }
        }
    }
}

/// Topic with its zenoh publisher; `None` until declared.
struct Lane {
    topic: Arc<Topic>,
    publisher: Option<zenoh::pubsub::Publisher<'static>>,
    declare_at: Instant,
}

/// Work of the publisher thread.
pub(crate) struct Drain {
    pub shared: Arc<PublisherState>,
    pub session: Session,
    pub woken: Receiver<()>,
}

/// Publisher thread and its session, which end together.
pub(crate) struct DrainThread {
    shared: Arc<PublisherState>,
    session: Session,
    thread: SupervisedThread,
    is_stopped: bool,
}

impl DrainThread {
    pub(crate) fn start(drain: Drain) -> Result<Self, TransportError> {
        Self::start_with(drain, || {})
    }

    /// Starts the thread with a callback for every turn, in which tests panic.
    fn start_with(drain: Drain, each_turn: impl Fn() + Send + 'static) -> Result<Self, TransportError> {
        let (shared, session) = (drain.shared.clone(), drain.session.clone());
        let thread = SupervisedThread::start("publish", move || drain.run(&each_turn))
            .map_err(|error| TransportError::session("publisher thread", &error))?;
        Ok(Self { shared, session, thread, is_stopped: false })
    }

    pub(crate) fn health(&self) -> ThreadHealth {
        self.thread.health()
    }

    /// Ends thread and session; does nothing the second time.
    pub(crate) fn stop(&mut self) -> Result<(), TransportError> {
        if std::mem::replace(&mut self.is_stopped, true) {
            return Ok(());
        }
        self.shared.stop.store(true, Ordering::Relaxed);
        self.shared.wake();
        self.thread.join();
        let joined = match self.thread.health() {
            ThreadHealth { panic: Some(text), has_failed: true, .. } => {
                Err(TransportError::session("publisher thread", &format!("it panicked repeatedly: {text}")))
            }
            _ => Ok(()),
        };
        let closed = self.session.close().wait().map_err(|error| TransportError::session("closing", &error));
        joined.and(closed)
    }
}

impl Drop for DrainThread {
    fn drop(&mut self) {
        if let Err(error) = self.stop() {
            tracing::warn!(%error, "closing the publisher");
        }
    }
}

impl Drain {
    /// Runs until stopped. After a panic it may be called again: it declares its publishers anew.
    fn run(&self, each_turn: &impl Fn()) {
        let mut lanes: Vec<Lane> = Vec::new();
        let mut next_tick = Instant::now();
        let mut next_repeat = Instant::now();
        while !self.shared.stop.load(Ordering::Relaxed) {
            each_turn();
            let now = Instant::now();
            if now >= next_tick {
                next_tick = now + TICK;
                lock(&self.shared.leases).expire(now);
                self.shared.sync_viewer_topics();
                self.sync_lanes(&mut lanes, now);
                if update_watched(&lanes) || now >= next_repeat {
                    next_repeat = now + REPEAT;
                    let calibration = lock(&self.shared.calibration).clone();
                    for Retained { topic, bytes } in calibration.iter() {
                        topic.offer(Body::Bytes(bytes.clone()), empty_header());
                    }
                }
            }
            for lane in &lanes {
                if let Some(pending) = lane.topic.take() {
                    let result = self.send(lane, &pending);
                    if let Err(error) = &result {
                        tracing::warn!(%error, "could not publish");
                    }
                    lane.topic.count(&result);
                }
            }
            // The wake-up follows the message into its slot, so no message is overlooked.
            let _ = self.woken.recv_deadline(next_tick);
        }
    }

    fn sync_lanes(&self, lanes: &mut Vec<Lane>, now: Instant) {
        let topics: Vec<Arc<Topic>> = lock(&self.shared.topics).values().cloned().collect();
        lanes.retain(|lane| topics.iter().any(|topic| Arc::ptr_eq(topic, &lane.topic)));
        for topic in topics {
            if !lanes.iter().any(|lane| Arc::ptr_eq(&topic, &lane.topic)) {
                lanes.push(Lane { topic, publisher: None, declare_at: now });
            }
        }
        // Urgent topics first: a send can wait a moment for a slow subscriber.
        lanes.sort_by_key(|lane| lane.topic.priority() as u8);
        for lane in lanes.iter_mut().filter(|lane| lane.publisher.is_none() && lane.declare_at <= now) {
            let declared = self
                .session
                .declare_publisher(keys::key(&self.shared.rig, &lane.topic.label))
                .congestion_control(CongestionControl::Drop)
                .priority(lane.topic.priority())
                .encoding(lane.topic.encoding())
                .wait();
            match declared {
                Ok(publisher) => lane.publisher = Some(publisher),
                Err(error) => {
                    tracing::warn!(topic = lane.topic.label, %error, "could not declare a publisher, trying again");
                    lane.declare_at = now + DECLARE_RETRY;
                }
            }
        }
    }

    fn send(&self, lane: &Lane, pending: &Pending) -> Result<usize, TransportError> {
        let topic = &lane.topic;
        let publisher = lane
            .publisher
            .as_ref()
            .ok_or_else(|| TransportError::session(topic.label.clone(), &"zenoh has not taken the topic yet"))?;
        let payload = pending.body.encode(&topic.name)?;
        let len = payload.len();
        // Messages passed on keep the host by whose clock they are timed.
        let host = if pending.header.host == 0 { self.shared.host_id } else { pending.header.host };
        let header = Header { publisher: self.shared.publisher_id, host, ..pending.header };
        let put = publisher.put(payload).attachment(pending.attachment(header));
        put.wait().map_err(|error| TransportError::session(topic.label.clone(), &error))?;
        Ok(len)
    }
}

/// Asks zenoh for subscriptions; returns whether a topic of the calibration has gained a subscriber.
fn update_watched(lanes: &[Lane]) -> bool {
    let mut calibration_wanted = false;
    for lane in lanes {
        let Some(publisher) = &lane.publisher else { continue };
        let watched = publisher.matching_status().wait().is_ok_and(|status| status.matching());
        let calibrates = matches!(lane.topic.kind, MessageKind::Calibration | MessageKind::Transforms);
        calibration_wanted |= calibrates && watched && !lane.topic.is_watched();
        lane.topic.set_watched(watched);
    }
    calibration_wanted
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU64;

    use super::*;
    use crate::testing::{loopback_session, wait_until};

    /// Returns a drain and its only topic.
    fn drain() -> (Drain, Arc<Topic>) {
        let session = loopback_session();
        let topic = Arc::new(Topic::new("stats".to_owned(), "stats".to_owned(), MessageKind::Stats));
        let leases = Leases::new(0, Duration::ZERO, 0);
        let (shared, woken) = PublisherState::new("drill", &session, std::slice::from_ref(&topic), leases);
        (Drain { shared, session, woken }, topic)
    }

    #[test]
    fn publishing_goes_on_after_a_panic() {
        let (drain, topic) = drain();
        let heard = Arc::new(AtomicU64::new(0));
        let of_callback = heard.clone();
        let subscriber = drain.session.declare_subscriber(keys::key("drill", "stats"));
        let _subscriber = subscriber
            .callback(move |_| {
                of_callback.fetch_add(1, Ordering::Relaxed);
            })
            .wait()
            .unwrap();
        let turns = AtomicU64::new(0);
        let mut thread = DrainThread::start_with(drain, move || {
            let turn = turns.fetch_add(1, Ordering::Relaxed);
            assert!(turn != 1 && turn != 3, "turn {turn}");
        })
        .unwrap();
        wait_until("two restarts", || thread.health().restarts == 2);
        wait_until("a message", || {
            topic.offer(Body::Bytes(Bytes::from_static(b"{}")), empty_header());
            heard.load(Ordering::Relaxed) > 0
        });
        let health = thread.health();
        assert_eq!((health.name.as_str(), health.panic.as_deref()), ("publish", Some("turn 3")));
        thread.stop().unwrap();
    }

    #[test]
    fn a_publisher_that_panics_repeatedly_reports_it_at_its_end() {
        let (drain, _) = drain();
        let mut thread = DrainThread::start_with(drain, || panic!("no turn works")).unwrap();
        wait_until("the end", || thread.health().has_failed);
        let error = thread.stop().unwrap_err().to_string();
        assert!(error.contains("it panicked repeatedly: no turn works"), "{error}");
    }
}

//! Thread of a subscriber that requests its viewpoint and renews the lease.

use std::{
    sync::{Arc, Condvar, Mutex},
    thread::JoinHandle,
    time::Duration,
};

use flyrig_types::{Camera, wait, wait_timeout};
use zenoh::{Session, Wait, qos::CongestionControl};

use crate::{
    error::TransportError,
    json::{MAX_JSON_BYTES, to_json},
    topic::lock,
    views::viewpoint::{ViewpointAnswer, ViewpointRequest, ViewpointStatus},
};

/// Time limit of an answer.
const ANSWER: Duration = Duration::from_secs(1);

/// Delay before a request is repeated after no answer or a refusal.
const RETRY: Duration = Duration::from_millis(500);

#[derive(Debug)]
struct State {
    wanted: Option<(Camera, f64)>,
    changed: bool,
    stop: bool,
    status: ViewpointStatus,
}

#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    wake: Condvar,
}

/// Handle of the renewing thread.
#[derive(Debug)]
pub(crate) struct Renewal {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Renewal {
    pub(crate) fn start(session: Session, key: String, view: String) -> Result<Self, TransportError> {
        let state = State { wanted: None, changed: false, stop: false, status: ViewpointStatus::Idle };
        let shared = Arc::new(Shared { state: Mutex::new(state), wake: Condvar::new() });
        let thread = std::thread::Builder::new()
            .name("flyrig-viewpoint".to_owned())
            .spawn({
                let shared = shared.clone();
                move || run(&shared, &session, &key, &view)
            })
            .map_err(|error| TransportError::session("viewpoint thread", &error))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    pub(crate) fn want(&self, wanted: Option<(Camera, f64)>) {
        let mut state = lock(&self.shared.state);
        match (&wanted, &state.status) {
            (None, _) => state.status = ViewpointStatus::Idle,
            // A moved camera keeps its lease.
            (Some(_), ViewpointStatus::Granted { .. }) => {}
            (Some(_), _) => state.status = ViewpointStatus::Pending,
        }
        state.wanted = wanted;
        state.changed = true;
        drop(state);
        self.shared.wake.notify_all();
    }

    pub(crate) fn status(&self) -> ViewpointStatus {
        lock(&self.shared.state).status.clone()
    }

    pub(crate) fn stop(&mut self) -> Result<(), TransportError> {
        let Some(thread) = self.thread.take() else { return Ok(()) };
        lock(&self.shared.state).stop = true;
        self.shared.wake.notify_all();
        thread.join().map_err(|_| TransportError::session("viewpoint thread", &"it panicked"))
    }
}

fn run(shared: &Shared, session: &Session, key: &str, view: &str) {
    // Without a request before, there is nothing to release.
    let mut asked = false;
    let mut pause: Option<Duration> = None;
    loop {
        let mut state = lock(&shared.state);
        if !state.changed && !state.stop {
            state = match pause {
                Some(pause) => wait_timeout(&shared.wake, state, pause),
                None => wait(&shared.wake, state),
            };
        }
        let wanted = if state.stop { None } else { state.wanted.clone() };
        let (stop, _) = (state.stop, std::mem::take(&mut state.changed));
        drop(state);

        if wanted.is_some() || asked {
            let answer = ask(session, key, wanted.clone());
            asked = wanted.is_some();
            pause = asked.then(|| match &answer {
                Ok(Some(answer)) if answer.granted => {
                    Duration::from_millis((answer.lease_millis / 3).clamp(20, 60_000))
                }
                _ => RETRY,
            });
            let status = match (&wanted, answer) {
                (None, _) => ViewpointStatus::Idle,
                (Some(_), Ok(Some(answer))) if answer.granted => ViewpointStatus::Granted { view: view.to_owned() },
                (Some(_), Ok(Some(answer))) => ViewpointStatus::Refused { reason: answer.reason },
                (Some(_), Ok(None)) => ViewpointStatus::Pending,
                (Some(_), Err(error)) => {
                    tracing::debug!(%error, "asking for a viewpoint");
                    ViewpointStatus::Pending
                }
            };
            let mut state = lock(&shared.state);
            // An answer to a request that has changed meanwhile is ignored.
            if !state.changed {
                state.status = status;
            }
        }
        if stop {
            return;
        }
    }
}

/// Sends a request and returns the first readable answer; `None` without a publisher.
fn ask(session: &Session, key: &str, wanted: Option<(Camera, f64)>) -> Result<Option<ViewpointAnswer>, TransportError> {
    let (camera, max_fps) = wanted.map_or((None, 1.0), |(camera, max_fps)| (Some(camera), max_fps));
    let question = to_json(key, &ViewpointRequest { camera, max_fps })?;
    let replies = session
        .get(key)
        .payload(question)
        // The reply inherits it: a stalled subscriber must not block the publisher's session.
        .congestion_control(CongestionControl::Drop)
        .timeout(ANSWER)
        .wait()
        .map_err(|error| TransportError::session(key, &error))?;
    let mut unreadable = None;
    while let Ok(reply) = replies.recv() {
        let Ok(sample) = reply.result() else { continue };
        let payload = sample.payload();
        let answer = match payload.len() {
            0..=MAX_JSON_BYTES => ViewpointAnswer::decode(key, &payload.to_bytes()),
            len => Err(TransportError::malformed(key, format!("answer of {len} bytes, at most {MAX_JSON_BYTES}"))),
        };
        match answer {
            Ok(answer) => return Ok(Some(answer)),
            Err(error) => unreadable = Some(error),
        }
    }
    unreadable.map_or(Ok(None), Err)
}

//! Publisher of a computer with cameras.

use std::{sync::Arc, time::Duration};

use flyrig_access::KeyProbe;
use flyrig_types::{CameraId, Frame, ThreadHealth};
use prost::bytes::Bytes;
use zenoh::{Wait, liveliness::LivelinessToken};

use crate::{
    cameras::{
        clock_exchange,
        frame::{CameraStatus, MAX_FRAME_BYTES},
        host_clock::HostClock,
    },
    drain::{Drain, DrainThread, PublisherState},
    error::TransportError,
    header::{Header, MessageKind, empty_header},
    keys,
    session::{
        config::{LARGEST_QUESTION, Side, TransportConfig},
        opening::{self, Opened},
    },
    topic::{Body, PublishOutcome, Topic, TopicCounts},
    views::viewpoint::Leases,
};

/// Publisher of camera frames, each camera to a topic with one slot: the newest frame wins, nothing waits for the network. It also answers
/// queries for the clock.
pub struct CameraPublisher {
    shared: Arc<PublisherState>,
    cameras: Vec<Lane>,
    endpoints: Vec<String>,
    probe: Option<KeyProbe>,
    drain: DrainThread,
    _alive: LivelinessToken,
}

struct Lane {
    camera: CameraId,
    frames: Arc<Topic>,
    status: Arc<Topic>,
}

impl std::fmt::Debug for CameraPublisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CameraPublisher")
            .field("rig", &self.shared.rig)
            .field("endpoints", &self.endpoints)
            .finish_non_exhaustive()
    }
}

impl CameraPublisher {
    /// Opens the session and starts its thread. `clock` stamps the frames.
    ///
    /// # Errors
    /// `Config` for names that cannot be part of a key and for cameras that the holder's key is not for, or `Session` when zenoh cannot
    /// listen there.
    pub fn open(config: &TransportConfig, cameras: &[CameraId], clock: HostClock) -> Result<Self, TransportError> {
        config.validate()?;
        let rig = &config.rig;
        for camera in cameras {
            keys::check_name("camera", camera.as_str())?;
            check_right(config, camera)?;
        }
        let Opened { session, endpoints, .. } = opening::open(config, Side::Sender, LARGEST_QUESTION, &[])?;
        let host = session.zid().to_string();
        let host = config.key.as_ref().map_or(host.clone(), |key| keys::session_name(&key.topic_name, &host));
        let lane = |camera: &CameraId| {
            let topic = |label: String, kind| {
                let label = if config.key.is_some() { keys::of_holder(&label, &host) } else { label };
                Arc::new(Topic::new(label.clone(), label, kind))
            };
            Lane {
                camera: camera.clone(),
                frames: topic(keys::frames_label(camera), MessageKind::Frame),
                status: topic(keys::status_label(camera), MessageKind::CameraStatus),
            }
        };
        let cameras: Vec<Lane> = cameras.iter().map(lane).collect();
        let failed = |error: zenoh::Error| TransportError::session(format!("cameras of rig {rig}"), &error);
        let topics: Vec<_> = cameras.iter().flat_map(|lane| [lane.frames.clone(), lane.status.clone()]).collect();
        let (shared, woken) = PublisherState::new(rig, &session, &topics, Leases::new(0, Duration::ZERO, 0));
        clock_exchange::answer(&session, keys::key(rig, &format!("clock/{host}")), clock).map_err(failed)?;
        let alive = keys::key(rig, &format!("host/{host}"));
        let alive = session.liveliness().declare_token(alive).wait().map_err(failed)?;
        let drain = DrainThread::start(Drain { shared: shared.clone(), session, woken })?;
        let statuses: Vec<_> = cameras.iter().map(|lane| lane.status.clone()).collect();
        let probe = opening::probe(config, move || statuses.iter().any(|topic| topic.is_watched()))?;
        Ok(Self { shared, cameras, endpoints, probe, drain, _alive: alive })
    }

    /// Returns the endpoints that it listens on, port 0 replaced by the actual one.
    #[must_use]
    pub fn endpoints(&self) -> &[String] {
        &self.endpoints
    }

    /// Returns why the rig rejects the key; `None` once it accepts it, without a key, and before the first answer.
    #[must_use]
    pub fn trouble(&self) -> Option<String> {
        self.probe.as_ref().and_then(KeyProbe::trouble)
    }

    /// Hands in a frame.
    ///
    /// # Errors
    /// `Config` for a camera that was not named at the start, and for an image of more than [`MAX_FRAME_BYTES`].
    pub fn publish(&self, frame: Frame) -> Result<PublishOutcome, TransportError> {
        let lane = self.lane(&frame.camera)?;
        let length = frame.image.bytes().len();
        if length > MAX_FRAME_BYTES {
            let text = format!("image of {length} bytes, at most {MAX_FRAME_BYTES}; choose a smaller size");
            return Err(TransportError::config(format!("camera {}", frame.camera), text));
        }
        let header = Header {
            frame: frame.sequence,
            capture_nanos: frame.capture_nanos,
            width: frame.image.width(),
            height: frame.image.height(),
            ..empty_header()
        };
        Ok(self.offer(&lane.frames, Body::Frame(Arc::new(frame)), header))
    }

    /// Hands in the status of a camera; the frames replaced here are added to it.
    ///
    /// # Errors
    /// `Config` for a camera that was not named at the start.
    pub fn publish_status(&self, camera: &CameraId, status: &CameraStatus) -> Result<PublishOutcome, TransportError> {
        let lane = self.lane(camera)?;
        let overtaken = status.overtaken.saturating_add(lane.frames.counts().replaced);
        let bytes = CameraStatus { overtaken, ..status.clone() }.encode()?;
        Ok(self.offer(&lane.status, Body::Bytes(Bytes::from(bytes)), empty_header()))
    }

    /// Returns the counts of each camera's frames.
    #[must_use]
    pub fn counts(&self) -> Vec<(CameraId, TopicCounts)> {
        self.cameras.iter().map(|lane| (lane.camera.clone(), lane.frames.counts())).collect()
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

    fn lane(&self, camera: &CameraId) -> Result<&Lane, TransportError> {
        self.cameras.iter().find(|lane| lane.camera == *camera).ok_or_else(|| {
            TransportError::config(format!("camera {camera}"), "is not one of those that this publisher was opened for")
        })
    }

    fn offer(&self, topic: &Topic, body: Body, header: Header) -> PublishOutcome {
        let outcome = topic.offer(body, header);
        if outcome != PublishOutcome::Unwatched {
            self.shared.wake();
        }
        outcome
    }
}

/// Checks that the key, where there is one, is for a camera: the rig would leave its images out.
fn check_right(config: &TransportConfig, camera: &CameraId) -> Result<(), TransportError> {
    match &config.key {
        Some(key) if !key.may_send(camera.as_str()) => {
            let text = format!(
                "the key of '{}' is for {}; take it out of source.cameras, or ask for a key that names it (`flyrig keys add NAME --role cameras --camera {camera}`)",
                key.holder,
                key.cameras.join(", ")
            );
            Err(TransportError::config(format!("camera {camera}"), text))
        }
        _ => Ok(()),
    }
}

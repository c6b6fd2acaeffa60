//! Viewpoints that subscribers ask for.

use std::time::{Duration, Instant};

use flyrig_types::Camera;
use serde::{Deserialize, Serialize};

use crate::{TransportError, keys};

/// Largest side of a picture that a subscriber may ask for, pixels.
pub const MAX_VIEWPOINT_SIDE: u32 = 4096;

/// A camera that a subscriber wants to look through.
#[derive(Debug, Clone, PartialEq)]
pub struct Viewpoint {
    /// Who asked.
    pub subscriber: String,
    /// Name of the view to publish the pictures under.
    pub view: String,
    /// Where it looks from; validated, at most 4096 pixels a side.
    pub camera: Camera,
    /// Pictures a second that the subscriber wants at most.
    pub max_fps: f64,
}

/// How a subscriber's own viewpoint stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ViewpointStatus {
    /// None was asked for.
    Idle,
    /// No answer so far; it is asked again.
    Pending,
    /// The publisher renders it under this view name.
    Granted {
        /// Name of the view.
        view: String,
    },
    /// The publisher says no; it is asked again at each renewal.
    Refused {
        /// Why, in the publisher's words.
        reason: String,
    },
}

/// The question; an absent camera gives the viewpoint back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewpointRequest {
    pub camera: Option<Camera>,
    pub max_fps: f64,
}

/// The answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewpointAnswer {
    pub granted: bool,
    pub reason: String,
    pub lease_millis: u64,
}

/// Checks a request's numbers.
pub(crate) fn check_camera(topic: &str, camera: &Camera, max_fps: f64) -> Result<(), TransportError> {
    let refuse = |message: String| Err(TransportError::config(topic, message));
    if let Err(error) = camera.validate() {
        return refuse(error.to_string());
    }
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    if width > MAX_VIEWPOINT_SIDE || height > MAX_VIEWPOINT_SIDE {
        return refuse(format!("{width}x{height} pixels asked for, at most {MAX_VIEWPOINT_SIDE} a side"));
    }
    if !(max_fps > 0.0 && max_fps <= 1000.0) {
        return refuse(format!("{max_fps} pictures a second asked for, expected more than 0, at most 1000"));
    }
    Ok(())
}

struct Lease {
    viewpoint: Viewpoint,
    ends: Instant,
}

/// The viewpoints of a publisher: bounded, each with a lease.
pub(crate) struct Leases {
    active: Vec<Lease>,
    max_viewers: usize,
    lease: Duration,
    pub granted: u64,
    pub refused: u64,
    pub expired: u64,
}

impl Leases {
    pub(crate) fn new(max_viewers: usize, lease: Duration) -> Self {
        Self { active: Vec::new(), max_viewers, lease, granted: 0, refused: 0, expired: 0 }
    }

    /// Grants, renews, gives back or refuses.
    pub(crate) fn ask(
        &mut self,
        subscriber: &str,
        request: Result<ViewpointRequest, TransportError>,
        now: Instant,
    ) -> ViewpointAnswer {
        self.expire(now);
        let answer = self.try_ask(subscriber, request, now);
        let (granted, reason) = match answer {
            Ok(()) => (true, String::new()),
            Err(error) => {
                self.refused += 1;
                (false, error.to_string())
            }
        };
        ViewpointAnswer { granted, reason, lease_millis: self.lease.as_millis() as u64 }
    }

    fn try_ask(
        &mut self,
        subscriber: &str,
        request: Result<ViewpointRequest, TransportError>,
        now: Instant,
    ) -> Result<(), TransportError> {
        let topic = format!("viewpoint of {subscriber}");
        let ViewpointRequest { camera, max_fps } = request?;
        keys::check_name("subscriber", subscriber)?;
        let Some(camera) = camera else {
            self.active.retain(|lease| lease.viewpoint.subscriber != subscriber);
            return Ok(());
        };
        check_camera(&topic, &camera, max_fps)?;
        let viewpoint = Viewpoint {
            subscriber: subscriber.to_owned(),
            view: format!("{}{subscriber}", keys::VIEWER_PREFIX),
            camera,
            max_fps,
        };
        let ends = now + self.lease;
        if let Some(lease) = self.active.iter_mut().find(|lease| lease.viewpoint.subscriber == subscriber) {
            *lease = Lease { viewpoint, ends };
            return Ok(());
        }
        if self.active.len() >= self.max_viewers {
            let max = self.max_viewers;
            return Err(TransportError::config(
                topic,
                format!("all {max} viewpoints of the rig are taken; wait for one or raise max-viewers"),
            ));
        }
        self.active.push(Lease { viewpoint, ends });
        self.granted += 1;
        Ok(())
    }

    /// Forgets a subscriber that is gone.
    pub(crate) fn drop_subscriber(&mut self, subscriber: &str) {
        let before = self.active.len();
        self.active.retain(|lease| lease.viewpoint.subscriber != subscriber);
        self.expired += (before - self.active.len()) as u64;
    }

    pub(crate) fn expire(&mut self, now: Instant) {
        let before = self.active.len();
        self.active.retain(|lease| lease.ends > now);
        self.expired += (before - self.active.len()) as u64;
    }

    pub(crate) fn viewpoints(&self) -> Vec<Viewpoint> {
        self.active.iter().map(|lease| lease.viewpoint.clone()).collect()
    }

    pub(crate) fn len(&self) -> usize {
        self.active.len()
    }
}

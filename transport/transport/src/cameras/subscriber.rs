//! Subscriber of the cameras of other computers.

use std::{
    net::SocketAddr,
    sync::{Arc, Condvar, Mutex},
    time::{Duration, Instant},
};

use flyrig_access::{Gate, HolderList, Role};
use flyrig_types::{CameraId, Frame, ThreadWatch, wait_timeout};
use zenoh::{Session, Wait, sample::Sample, sample::SampleKind};

use crate::{
    cameras::{
        clock_exchange::{Asker, ClockQuery},
        frame::MAX_FRAME_BYTES,
        host_clock::HostClock,
        host_id::HostId,
        inbox::CameraInbox,
        link::CameraLink,
    },
    error::TransportError,
    header::MAX_ATTACHMENT,
    json::MAX_JSON_BYTES,
    keys,
    session::{
        config::{LARGEST_QUESTION, Side, TransportConfig},
        opening::{self, Opened},
    },
    topic::lock,
};

/// Subscriber of cameras of other computers; capture times are on this computer's clock.
///
/// A few frames per camera wait for their reader, the newest win. Computers may start later, vanish and return.
pub struct CameraSubscriber {
    shared: Arc<Shared>,
    asker: Asker,
    session: Session,
    /// Instruction how a computer with cameras connects here.
    how: String,
    /// Gate that admits computers with keys.
    gate: Option<Gate>,
    closed: bool,
}

struct Shared {
    rig: String,
    inbox: Mutex<CameraInbox>,
    changed: Condvar,
    clock: HostClock,
    inbox_bytes: u64,
    /// Holders of keys, who send under names of their own.
    holders: Option<HolderList>,
}

impl std::fmt::Debug for CameraSubscriber {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CameraSubscriber").field("rig", &self.shared.rig).finish_non_exhaustive()
    }
}

impl CameraSubscriber {
    /// Opens the session; the computers with cameras may start later. `clock` is the local clock.
    ///
    /// # Errors
    /// `Config` for names that cannot be part of a key, or `Session`.
    pub fn open(config: &TransportConfig, cameras: &[CameraId], clock: HostClock) -> Result<Self, TransportError> {
        config.validate()?;
        let rig = &config.rig;
        for camera in cameras {
            keys::check_name("camera", camera.as_str())?;
        }
        let Opened { session, gate, .. } =
            opening::open(config, Side::Receiver, MAX_FRAME_BYTES + LARGEST_QUESTION, &[Role::Cameras])?;
        let failed = |error: zenoh::Error| TransportError::session(format!("cameras of rig {rig}"), &error);
        let shared = Arc::new(Shared {
            rig: rig.clone(),
            inbox: Mutex::new(CameraInbox::new(rig, cameras, config.inbox_bytes)),
            changed: Condvar::new(),
            clock: clock.clone(),
            inbox_bytes: config.inbox_bytes,
            holders: gate.as_ref().map(Gate::holders),
        });
        for camera in cameras {
            let own = [keys::frames_label(camera), keys::status_label(camera)];
            let of_holders = own.iter().filter(|_| gate.is_some()).map(|label| keys::of_holder(label, "*"));
            for label in own.iter().cloned().chain(of_holders) {
                let (shared, camera) = (shared.clone(), camera.clone());
                session
                    .declare_subscriber(keys::key(rig, &label))
                    .callback(move |sample| shared.receive(&camera, &sample))
                    .background()
                    .wait()
                    .map_err(failed)?;
            }
        }
        let watcher = shared.clone();
        session
            .liveliness()
            .declare_subscriber(keys::ANY_HOST)
            .history(true)
            .callback(move |sample| {
                let is_alive = sample.kind() == SampleKind::Put;
                lock(&watcher.inbox).host(sample.key_expr().as_str(), is_alive);
                watcher.changed.notify_all();
            })
            .background()
            .wait()
            .map_err(failed)?;
        let (asking, taking) = (shared.clone(), shared.clone());
        let hosts = move || -> Vec<ClockQuery> { lock(&asking.inbox).clock_queries() };
        let take = move |host: &HostId, asked, answer, answered| {
            lock(&taking.inbox).clock(host, asked, answer, answered);
        };
        let asker = Asker::start(session.clone(), clock, hosts, take)?;
        let how = match &gate {
            Some(gate) => format!(
                "run `flyrig capture rig.toml --key KEY` on it, with a key of role cameras; it is expected at port {}",
                gate.address().port()
            ),
            None => format!(
                "run `flyrig capture` on it, and let transport.connect ({}) name its transport.listen",
                config.connect.join(", ")
            ),
        };
        Ok(Self { shared, asker, session, how, gate, closed: false })
    }

    /// Returns the address where computers with keys connect; `None` without keys.
    #[must_use]
    pub fn gate(&self) -> Option<SocketAddr> {
        self.gate.as_ref().map(Gate::address)
    }

    /// Returns a watch of the thread that compares the clocks.
    #[must_use]
    pub fn clock_thread(&self) -> ThreadWatch {
        self.asker.watch().clone()
    }

    /// Takes the oldest waiting frame of a camera; `None` after the timeout.
    ///
    /// # Errors
    /// `UnknownVersion` or `Malformed` for a message that could not be used, the same text once in ten seconds; the subscriber stays usable.
    /// `Config` for a camera that was not named at the start.
    pub fn next_frame(&self, camera: &CameraId, timeout: Duration) -> Result<Option<Frame>, TransportError> {
        let deadline = flyrig_types::deadline_after(timeout);
        let mut inbox = lock(&self.shared.inbox);
        loop {
            if let Some(result) = inbox.take(camera)? {
                return result.map(Some);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            inbox = wait_timeout(&self.shared.changed, inbox, left);
        }
    }

    /// Returns the state of the link to a camera; all zero for one that was not named at the start.
    #[must_use]
    pub fn link(&self, camera: &CameraId) -> CameraLink {
        lock(&self.shared.inbox).link(camera, self.shared.clock.now_nanos())
    }

    /// Explains why no frames of a camera arrive, with the fix.
    #[must_use]
    pub fn absence(&self, camera: &CameraId) -> String {
        lock(&self.shared.inbox).absence(camera, &self.how)
    }

    /// Ends the session; dropping does the same without reporting errors.
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
        self.asker.stop();
        self.session.close().wait().map_err(|error| TransportError::session("closing", &error))
    }
}

impl Drop for CameraSubscriber {
    fn drop(&mut self) {
        if let Err(error) = self.stop() {
            tracing::warn!(%error, "closing the subscriber of cameras");
        }
    }
}

impl Shared {
    /// Ingests a sample; runs on a zenoh thread.
    fn receive(&self, camera: &CameraId, sample: &Sample) {
        let key = sample.key_expr().as_str();
        let label = keys::label_in(key).unwrap_or_default();
        let is_status = label.starts_with(keys::STATUS);
        let own = if is_status { keys::status_label(camera) } else { keys::frames_label(camera) };
        let holder = label.strip_prefix(&own).and_then(|rest| rest.strip_prefix('/')).map(HostId::named);
        if let Some(holders) = self.holders.as_ref().filter(|_| label != own) {
            // Not even an error of the camera: its true computer may send it at the same time.
            let name = holder.as_ref().and_then(HostId::holder).unwrap_or_default();
            if !holders.may_send(name, camera.as_str()) {
                return;
            }
        }
        let attachment = sample.attachment().filter(|bytes| bytes.len() <= MAX_ATTACHMENT);
        let attachment = attachment.map(zenoh::bytes::ZBytes::to_bytes).unwrap_or_default();
        // A payload that is too long is not even copied.
        let length = sample.payload().len();
        let limit = match is_status {
            true => MAX_JSON_BYTES,
            false => MAX_FRAME_BYTES.min(usize::try_from(self.inbox_bytes).unwrap_or(usize::MAX)),
        };
        let too_long = || {
            let mend = if !is_status && limit < MAX_FRAME_BYTES { "; raise inbox-bytes" } else { "" };
            TransportError::malformed(key, format!("{length} bytes, at most {limit}{mend}"))
        };
        let payload = (length <= limit).then(|| sample.payload().to_bytes().into_owned()).ok_or_else(too_long);
        let now_nanos = self.clock.now_nanos();
        let mut inbox = lock(&self.inbox);
        if is_status {
            inbox.status(camera, key, &attachment, payload);
        } else {
            inbox.frame(camera, holder, key, &attachment, payload, now_nanos);
        }
        drop(inbox);
        self.changed.notify_all();
    }
}

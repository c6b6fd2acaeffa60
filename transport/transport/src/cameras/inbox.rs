//! Received state of other computers' cameras: waiting frames, clocks, and which computers are present.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::{Duration, Instant},
};

use flyrig_types::{CameraId, Frame};

use crate::{
    cameras::{
        clock_exchange::ClockQuery,
        frame::{CameraStatus, FrameHeader},
        host_clock::ClockFit,
        host_id::HostId,
        link::CameraLink,
    },
    error::TransportError,
    header::{Header, MessageKind},
    keys,
    printable::printable,
    schema::SCHEMA_VERSION,
};

/// Largest number of waiting frames of a camera.
const WAITING: usize = 4;
/// Silence of a camera's publisher after which another may take over.
const SUCCESSION: Duration = Duration::from_secs(1);
/// Interval after which the same error is reported again.
const AGAIN: Duration = Duration::from_secs(10);
/// Largest age of a frame, and its largest lead, due to the clock's error; nanoseconds.
const OLDEST: i64 = 10_000_000_000;
const EARLIEST: i64 = 500_000_000;
/// Largest number of computers and names that are remembered.
const MAX_HOSTS: usize = 256;
/// Largest number of computers of one key: as many as it may have connections.
const MAX_HOSTS_OF_KEY: usize = 16;
/// Largest number of names of others in an error.
const SHOWN_NAMES: usize = 8;
/// Number of quick queries to a computer that does not answer.
const EAGER_QUESTIONS: u32 = 100;

/// Mailbox of the cameras of other computers.
#[derive(Debug)]
pub(crate) struct CameraInbox {
    rig: String,
    slots: Vec<Slot>,
    /// Bound of the bytes of waiting images over all cameras.
    quota: u64,
    /// Computers with cameras.
    hosts: BTreeMap<HostId, Host>,
    /// Keys of computers of other rigs and versions.
    others: BTreeSet<String>,
}

#[derive(Debug)]
struct Host {
    clock_key: String,
    fit: ClockFit,
    asked: u32,
}

impl Host {
    /// Returns whether it was queried often and never answered.
    fn is_mute(&self) -> bool {
        self.asked >= EAGER_QUESTIONS && self.fit.is_young()
    }
}

#[derive(Debug)]
struct Slot {
    camera: CameraId,
    waiting: VecDeque<Frame>,
    link: CameraLink,
    publisher: Option<HostId>,
    arrived: Option<Instant>,
    /// Sequence number and withheld count of the previous message.
    last: Option<(u64, u64)>,
    /// Error to report.
    trouble: Option<TransportError>,
    /// Text and time of the last reported error.
    reported: Option<(String, Instant)>,
}

impl CameraInbox {
    pub fn new(rig: &str, cameras: &[CameraId], quota: u64) -> Self {
        let slot = |camera: &CameraId| Slot {
            camera: camera.clone(),
            waiting: VecDeque::with_capacity(WAITING),
            link: CameraLink::default(),
            publisher: None,
            arrived: None,
            last: None,
            trouble: None,
            reported: None,
        };
        Self {
            rig: rig.to_owned(),
            slots: cameras.iter().map(slot).collect(),
            quota,
            hosts: BTreeMap::new(),
            others: BTreeSet::new(),
        }
    }

    /// Notes that a computer with cameras has appeared or disappeared.
    pub fn host(&mut self, key: &str, is_alive: bool) {
        let ours = (Some(self.rig.as_str()), Some(format!("v{SCHEMA_VERSION}")));
        if (keys::rig_in(key), keys::version_in(key).map(str::to_owned)) != ours {
            if !is_alive {
                self.others.remove(key);
            } else if self.others.len() < MAX_HOSTS {
                self.others.insert(key.to_owned());
            }
            return;
        }
        let Some(name) = keys::name_in(key, "host", "") else { return };
        let id = HostId::named(name);
        if !is_alive {
            self.hosts.remove(&id);
            return;
        }
        if self.hosts.len() >= MAX_HOSTS {
            // Names without a computer behind them must not keep a real computer out.
            self.hosts.retain(|_, host| !host.is_mute());
        }
        let of_key = |other: &&HostId| id.holder().is_some() && other.holder() == id.holder();
        if self.hosts.len() < MAX_HOSTS && self.hosts.keys().filter(of_key).count() < MAX_HOSTS_OF_KEY {
            let clock_key = keys::key(&self.rig, &format!("clock/{name}"));
            self.hosts.entry(id).or_insert_with(|| Host { clock_key, fit: ClockFit::default(), asked: 0 });
        }
    }

    /// Returns the queries for clocks to send now.
    pub fn clock_queries(&mut self) -> Vec<ClockQuery> {
        let query = |(host, state): (&HostId, &mut Host)| {
            state.asked = state.asked.saturating_add(1);
            ClockQuery {
                key: state.clock_key.clone(),
                host: host.clone(),
                is_urgent: state.fit.is_young() && !state.is_mute(),
            }
        };
        self.hosts.iter_mut().map(query).collect()
    }

    /// Ingests an answer to a query for a clock.
    pub fn clock(&mut self, host: &HostId, asked: i64, answer: i64, answered: i64) {
        if let Some(host) = self.hosts.get_mut(host) {
            host.fit.add(asked, answer, answered);
        }
    }

    /// Ingests the status of a camera.
    pub fn status(
        &mut self,
        camera: &CameraId,
        key: &str,
        attachment: &[u8],
        payload: Result<Vec<u8>, TransportError>,
    ) {
        let status = payload.and_then(|payload| {
            let header = Header::decode(key, attachment)?;
            if header.kind != MessageKind::CameraStatus {
                return Err(TransportError::malformed(key, format!("holds {:?}, not a status", header.kind)));
            }
            CameraStatus::decode(&payload)
        });
        let Some(slot) = self.slots.iter_mut().find(|slot| slot.camera == *camera) else { return };
        match status {
            Ok(status) => slot.link.status = Some(status),
            Err(error) => slot.refuse(error),
        }
    }

    /// Ingests a frame of a camera; `holder` is the session of a key's holder that sent it, `now_nanos` the local time.
    pub fn frame(
        &mut self,
        camera: &CameraId,
        holder: Option<HostId>,
        key: &str,
        attachment: &[u8],
        payload: Result<Vec<u8>, TransportError>,
        now_nanos: i64,
    ) {
        let Some(slot) = self.slots.iter_mut().find(|slot| slot.camera == *camera) else { return };
        let header = match FrameHeader::decode(key, attachment) {
            Ok(header) => header,
            Err(error) => return slot.refuse(error),
        };
        // A holder does not choose whose clock its frames are timed by.
        let publisher = holder.unwrap_or(HostId::Program(header.header.publisher));
        if let Err(error) = slot.follow(&header, &publisher, &self.hosts) {
            return slot.refuse(error);
        }
        let frame = match payload.and_then(|bytes| header.frame(key, camera, bytes)) {
            Ok(frame) => frame,
            Err(error) => return slot.refuse(error),
        };
        let host = self.hosts.get(&publisher);
        let Some(capture_nanos) = host.and_then(|host| host.fit.to_local(frame.capture_nanos)) else {
            slot.link.before_clock += 1;
            return;
        };
        let age = now_nanos.saturating_sub(capture_nanos);
        if !(-EARLIEST..=OLDEST).contains(&age) {
            let secs = age as f64 * 1e-9;
            let text =
                format!("its timestamp is {secs:.1} s before now, which is impossible; restart `flyrig capture` there");
            return slot.refuse(TransportError::malformed(key, text));
        }
        slot.link.frames += 1;
        if slot.waiting.len() == WAITING {
            slot.waiting.pop_front();
            slot.link.overtaken += 1;
        }
        slot.waiting.push_back(Frame { capture_nanos, ..frame });
        self.enforce_quota();
    }

    /// Drops the oldest frames of the camera with the most waiting bytes until the quota holds: a camera of huge images loses its own.
    fn enforce_quota(&mut self) {
        while self.slots.iter().map(Slot::waiting_bytes).sum::<u64>() > self.quota {
            let Some(slot) = self.slots.iter_mut().max_by_key(|slot| slot.waiting_bytes()) else { return };
            slot.waiting.pop_front();
            slot.link.overtaken += 1;
        }
    }

    /// Returns the oldest waiting frame, or the error to report first.
    pub fn take(&mut self, camera: &CameraId) -> Result<Option<Result<Frame, TransportError>>, TransportError> {
        let slot = self.slots.iter_mut().find(|slot| slot.camera == *camera);
        let slot = slot.ok_or_else(|| TransportError::config(format!("camera {camera}"), "was not asked for"))?;
        if let Some(trouble) = slot.trouble.take() {
            return Ok(Some(Err(trouble)));
        }
        Ok(slot.waiting.pop_front().map(Ok))
    }

    /// Returns the state of the link to a camera at a local time.
    pub fn link(&self, camera: &CameraId, now_nanos: i64) -> CameraLink {
        let Some(slot) = self.slots.iter().find(|slot| slot.camera == *camera) else { return CameraLink::default() };
        let host = slot.publisher.as_ref().and_then(|publisher| self.hosts.get(publisher));
        CameraLink { clock: host.and_then(|host| host.fit.estimate(now_nanos)), ..slot.link.clone() }
    }

    /// Explains why no frames of a camera arrive; `how` describes how a computer connects here.
    pub fn absence(&self, camera: &CameraId, how: &str) -> String {
        printable(&self.absence_of(camera, how)).into_owned()
    }

    fn absence_of(&self, camera: &CameraId, how: &str) -> String {
        let Some(slot) = self.slots.iter().find(|slot| slot.camera == *camera) else {
            return "was not asked for".into();
        };
        let rig = &self.rig;
        let status = slot.link.status.as_ref();
        let host = status.map(|status| status.host.as_str()).filter(|host| !host.is_empty());
        let computer = host.map_or_else(|| "its computer".to_owned(), |host| format!("its computer '{host}'"));
        let is_there = slot.publisher.as_ref().map(|publisher| self.hosts.contains_key(publisher));
        if is_there == Some(false) {
            return format!("{computer} has left the network; start `flyrig capture` there again, or check the cable");
        }
        let problem = status.map(|status| status.problem.as_str()).filter(|problem| !problem.is_empty());
        if let Some(problem) = problem.filter(|_| !self.hosts.is_empty()) {
            return format!("{computer} reports: {problem}");
        }
        if is_there.is_some() {
            return format!("{computer} is present and sends nothing; check the network between");
        }
        if !self.hosts.is_empty() {
            return format!(
                "no computer of rig '{rig}' sends a camera of this name; compare source.cameras there and here"
            );
        }
        let quoted = |names: BTreeSet<&str>| {
            let more = if names.len() > SHOWN_NAMES { ", ..." } else { "" };
            // Any program on the network can choose these names.
            let short = |name: &str| name.chars().take(32).collect::<String>();
            let names: Vec<String> = names.into_iter().take(SHOWN_NAMES).map(|n| format!("'{}'", short(n))).collect();
            names.join(", ") + more
        };
        let is_ours = |key: &&String| keys::rig_in(key) == Some(rig.as_str());
        let versions: BTreeSet<&str> =
            self.others.iter().filter(is_ours).filter_map(|key| keys::version_in(key)).collect();
        if !versions.is_empty() {
            return format!(
                "its computer speaks schema version {}, this program knows v{SCHEMA_VERSION}; run the same flyrig on both",
                quoted(versions)
            );
        }
        let rigs: BTreeSet<&str> = self.others.iter().filter_map(|key| keys::rig_in(key)).collect();
        if !rigs.is_empty() {
            return format!(
                "no computer of rig '{rig}' is present, but of {}; set the same rig.name on both sides",
                quoted(rigs)
            );
        }
        format!("no computer of rig '{rig}' is present; {how}")
    }
}

impl Slot {
    fn waiting_bytes(&self) -> u64 {
        self.waiting.iter().map(|frame| frame.image.bytes().len() as u64).sum()
    }

    /// Counts the messages missing before this one. A camera has one publisher at a time.
    fn follow(
        &mut self,
        header: &FrameHeader,
        publisher: &HostId,
        hosts: &BTreeMap<HostId, Host>,
    ) -> Result<(), TransportError> {
        let FrameHeader { header: Header { sequence, .. }, withheld, .. } = *header;
        if let Some(before) = self.publisher.as_ref().filter(|before| *before != publisher) {
            let is_fresh = self.arrived.is_some_and(|at| at.elapsed() < SUCCESSION);
            if is_fresh && hosts.contains_key(before) {
                return Err(TransportError::malformed(
                    format!("camera {}", self.camera),
                    "two computers publish a camera of this name; give each its own in source.cameras",
                ));
            }
            self.link.restarts += 1;
            self.last = None;
        }
        if let Some((last, withheld_before)) = self.last {
            let gap = sequence.saturating_sub(last).saturating_sub(1);
            let not_sent = withheld.saturating_sub(withheld_before).min(gap);
            self.link.withheld = self.link.withheld.saturating_add(not_sent);
            self.link.lost = self.link.lost.saturating_add(gap - not_sent);
        }
        self.publisher = Some(publisher.clone());
        self.arrived = Some(Instant::now());
        self.last = Some((sequence, withheld));
        Ok(())
    }

    fn refuse(&mut self, error: TransportError) {
        self.link.refused += 1;
        let text = error.to_string();
        let is_known = self.reported.as_ref().is_some_and(|(known, at)| *known == text && at.elapsed() < AGAIN);
        if !is_known {
            self.reported = Some((text, Instant::now()));
            self.trouble = Some(error);
        }
    }
}

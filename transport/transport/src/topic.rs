//! A topic of the publisher: one slot that the newest message wins, and its counts.

use std::sync::{
    Arc, Mutex, MutexGuard, PoisonError,
    atomic::{AtomicBool, Ordering},
};

use flyrig_stream::SplatState;
use flyrig_types::Frame;
use prost::bytes::Bytes;
use zenoh::{bytes::Encoding, qos::Priority};

use crate::{
    cameras::frame::FrameHeader,
    error::TransportError,
    header::{Header, MessageKind},
    host,
    views::view::ViewFrame,
};

/// What became of a message that was handed in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PublishOutcome {
    /// It waits for the publisher thread.
    Queued,
    /// The same, and an older one that still waited is dropped.
    Replaced,
    /// Nobody subscribes: dropped at once, nothing encoded.
    Unwatched,
}

/// Counts of one topic since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TopicCounts {
    /// Handed in.
    pub offered: u64,
    /// Handed to zenoh (which drops in silence what a subscriber is too slow for).
    pub sent: u64,
    /// Dropped because a newer one came first.
    pub replaced: u64,
    /// Dropped because nobody subscribes.
    pub unwatched: u64,
    /// Could not be encoded or sent; the log says why.
    pub failed: u64,
    /// Payload bytes handed to zenoh.
    pub bytes: u64,
    /// Whether somebody subscribes now.
    pub watched: bool,
}

/// A payload before it is encoded; encoding is the publisher thread's work.
#[derive(Debug, Clone)]
pub(crate) enum Body {
    View(ViewFrame),
    Splats(Arc<SplatState>),
    Frame(Arc<Frame>),
    Bytes(Bytes),
}

#[derive(Debug)]
pub(crate) struct Pending {
    pub body: Body,
    /// Its `publisher` is filled in when it is sent, and its `host` unless it is another one's.
    pub header: Header,
    /// Messages of the topic before this one that did not leave.
    pub withheld: u64,
}

#[derive(Debug, Default)]
struct State {
    pending: Option<Pending>,
    sequence: u64,
    counts: TopicCounts,
}

#[derive(Debug)]
pub(crate) struct Topic {
    /// Last parts of the key, such as `view/front`.
    pub label: String,
    /// Name of a view, else the label.
    pub name: String,
    pub kind: MessageKind,
    watched: AtomicBool,
    state: Mutex<State>,
}

/// A lock whose data stays whole even when a holder panics: every change is a plain assignment.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Topic {
    pub(crate) fn new(label: String, name: String, kind: MessageKind) -> Self {
        Self { label, name, kind, watched: AtomicBool::new(false), state: Mutex::default() }
    }

    pub(crate) fn is_watched(&self) -> bool {
        self.watched.load(Ordering::Relaxed)
    }

    pub(crate) fn set_watched(&self, watched: bool) {
        self.watched.store(watched, Ordering::Relaxed);
    }

    /// Hands a message in; never waits for more than the copy of a few words.
    pub(crate) fn offer(&self, body: Body, mut header: Header) -> PublishOutcome {
        let mut state = lock(&self.state);
        header.kind = self.kind;
        header.sequence = state.sequence;
        if header.host == 0 {
            header.publish_unix_nanos = host::unix_nanos();
        }
        state.sequence += 1;
        state.counts.offered += 1;
        if !self.is_watched() {
            state.counts.unwatched += 1;
            return PublishOutcome::Unwatched;
        }
        let is_replaced = state.pending.take().is_some();
        state.counts.replaced += u64::from(is_replaced);
        let withheld = state.counts.replaced + state.counts.unwatched + state.counts.failed;
        state.pending = Some(Pending { body, header, withheld });
        if is_replaced { PublishOutcome::Replaced } else { PublishOutcome::Queued }
    }

    pub(crate) fn take(&self) -> Option<Pending> {
        lock(&self.state).pending.take()
    }

    pub(crate) fn count(&self, result: &Result<usize, TransportError>) {
        let counts = &mut lock(&self.state).counts;
        match result {
            Ok(bytes) => {
                counts.sent += 1;
                counts.bytes += *bytes as u64;
            }
            Err(_) => counts.failed += 1,
        }
    }

    pub(crate) fn counts(&self) -> TopicCounts {
        TopicCounts { watched: self.is_watched(), ..lock(&self.state).counts }
    }

    /// Small messages travel in a queue of their own, so that images never hold them up.
    pub(crate) fn priority(&self) -> Priority {
        match self.kind {
            MessageKind::Motion => Priority::InteractiveHigh,
            // The coarse layer makes a person, the finest is missed least.
            MessageKind::Colors if self.label.ends_with("color-0") => Priority::DataHigh,
            MessageKind::Colors if self.label.ends_with("color-1") => Priority::Data,
            MessageKind::Colors => Priority::DataLow,
            MessageKind::View | MessageKind::Splats | MessageKind::Frame => Priority::Data,
            MessageKind::Calibration | MessageKind::Transforms | MessageKind::Stats | MessageKind::CameraStatus => {
                Priority::InteractiveLow
            }
        }
    }

    pub(crate) fn encoding(&self) -> Encoding {
        match self.kind {
            MessageKind::View => Encoding::APPLICATION_PROTOBUF.with_schema("foxglove.CompressedImage"),
            MessageKind::Calibration => Encoding::APPLICATION_PROTOBUF.with_schema("foxglove.CameraCalibration"),
            MessageKind::Transforms => Encoding::APPLICATION_PROTOBUF.with_schema("foxglove.FrameTransforms"),
            MessageKind::Splats => Encoding::APPLICATION_OCTET_STREAM.with_schema("flyrig.SplatState"),
            MessageKind::Stats => Encoding::APPLICATION_JSON.with_schema("flyrig.RigStats"),
            MessageKind::Frame => Encoding::APPLICATION_OCTET_STREAM.with_schema("flyrig.Frame"),
            MessageKind::CameraStatus => Encoding::APPLICATION_JSON.with_schema("flyrig.CameraStatus"),
            MessageKind::Motion => Encoding::APPLICATION_OCTET_STREAM.with_schema("flyrig.Motion"),
            MessageKind::Colors => Encoding::APPLICATION_OCTET_STREAM.with_schema("flyrig.Colors"),
        }
    }
}

impl Pending {
    /// What travels beside the payload.
    pub(crate) fn attachment(&self, header: Header) -> Vec<u8> {
        match &self.body {
            Body::Frame(frame) => {
                let (exposure_nanos, format) = (frame.exposure_nanos, frame.image.format());
                FrameHeader { header, exposure_nanos, withheld: self.withheld, format }.encode().to_vec()
            }
            Body::View(_) | Body::Splats(_) | Body::Bytes(_) => header.encode().to_vec(),
        }
    }
}

impl Body {
    pub(crate) fn encode(&self, name: &str) -> Result<Vec<u8>, TransportError> {
        match self {
            Self::View(frame) => frame.encode(name),
            Self::Splats(state) => Ok(state.encode()?),
            Self::Frame(frame) => Ok(frame.image.bytes().to_vec()),
            Self::Bytes(bytes) => Ok(bytes.to_vec()),
        }
    }
}

//! Topic of the publisher: one slot that the newest message wins, and its counts.

use std::sync::{
    Arc, Mutex,
    atomic::{AtomicBool, Ordering},
};

use flyrig_stream::SplatState;
use flyrig_types::Frame;
use prost::bytes::Bytes;
use zenoh::{bytes::Encoding, qos::Priority};

pub(crate) use flyrig_types::lock;

use crate::{
    cameras::frame::FrameHeader,
    error::TransportError,
    header::{Header, MessageKind},
    host,
    views::view::ViewFrame,
};

/// Outcome of handing a message in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PublishOutcome {
    /// The message waits for the publisher thread.
    Queued,
    /// The message waits, and replaces an older one that was still waiting.
    Replaced,
    /// There is no subscriber: the message is dropped without being encoded.
    Unwatched,
}

/// Message counts of one topic since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TopicCounts {
    /// Messages handed in.
    pub offered: u64,
    /// Messages handed to zenoh, which silently drops those that a subscriber is too slow for.
    pub sent: u64,
    /// Messages replaced by a newer one before they were sent.
    pub replaced: u64,
    /// Messages dropped for lack of subscribers.
    pub unwatched: u64,
    /// Messages that could not be encoded or sent; the log has the errors.
    pub failed: u64,
    /// Payload bytes handed to zenoh.
    pub bytes: u64,
    /// Whether there is a subscriber now.
    pub watched: bool,
}

/// Payload before the publisher thread encodes it.
#[derive(Debug, Clone)]
pub(crate) enum Body {
    View(ViewFrame),
    Splats(Arc<SplatState>),
    Frame(Arc<Frame>),
    Bytes(Bytes),
}

/// Message in a slot.
#[derive(Debug)]
pub(crate) struct Pending {
    pub body: Body,
    /// Header, without `publisher`, and without `host` unless the message is passed on from another host: both are filled in when
    /// it is sent.
    pub header: Header,
    /// Number of earlier messages of the topic that were not sent.
    pub withheld: u64,
}

#[derive(Debug, Default)]
struct State {
    pending: Option<Pending>,
    sequence: u64,
    counts: TopicCounts,
}

/// Topic with its slot.
#[derive(Debug)]
pub(crate) struct Topic {
    /// Label of the key, such as `view/front`.
    pub label: String,
    /// Name of the view, otherwise the label.
    pub name: String,
    pub kind: MessageKind,
    watched: AtomicBool,
    state: Mutex<State>,
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

    /// Hands a message in; waits for no more than the copy of a few words.
    pub(crate) fn offer(&self, body: Body, mut header: Header) -> PublishOutcome {
        let mut state = lock(&self.state);
        header.kind = self.kind;
        header.sequence = state.sequence;
        if header.host == 0 {
            (header.publish_unix_nanos, header.publish_nanos) = (host::unix_nanos(), host::monotonic_nanos());
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

    /// Returns the zenoh priority: small messages have a queue of their own, so that images never delay them.
    pub(crate) fn priority(&self) -> Priority {
        match self.kind {
            MessageKind::Motion => Priority::InteractiveHigh,
            // The coarse layer shows the person, the finest matters least.
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
    /// Encodes the attachment of the message.
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

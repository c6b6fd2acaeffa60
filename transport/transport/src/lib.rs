//! Wire schema and zenoh sessions between a rig, its viewers, relays, and other computers with cameras.
//!
//! | module | content |
//! |---|---|
//! | `publisher`, `subscriber` | the rig's side and the viewer's side |
//! | `topic`, `drain`, `inbox` | slots of the publisher and its thread, slots of the subscriber |
//! | `session` | settings, opening of sessions, access rules for holders of keys ([`flyrig_access`]), zenoh's threads |
//! | `people` | topics of the person stream ([`flyrig_stream`]), templates, choice of colour layers, relay |
//! | `cameras` | calibration on the wire; frames, status and clocks of other computers |
//! | `views` | rendered views, viewpoints that subscribers request |
//!
//! # Keys
//!
//! All keys of schema version 1 of the rig `studio` begin with `flyrig/v1/studio/`:
//!
//! | key | payload |
//! |---|---|
//! | `view/<name>` | foxglove `CompressedImage`, protobuf |
//! | `viewer/<subscriber>/view` | foxglove `CompressedImage` of a subscriber's own viewpoint |
//! | `splats`, `splats/<person>` | [`SplatState`] of the first person and of the others |
//! | `person/<person>/motion` | [`flyrig_stream::Motion`] |
//! | `person/<person>/color-<layer>` | layer of colours, for [`flyrig_stream::ColorDecoder`] |
//! | `template/<hash>-<chunk>` | query and reply: u32 size of a [`flyrig_stream::StreamTemplate`], and 60,000 of its bytes |
//! | `calibration/<camera>` | foxglove `CameraCalibration`, protobuf |
//! | `transforms` | foxglove `FrameTransforms`: `world_from_camera` of every camera, and the up direction |
//! | `stats` | [`RigStats`], JSON |
//! | `viewpoint/<subscriber>` | query and reply: JSON, the request and the answer |
//! | `camera/<camera>` | image of a camera as captured, with a [`FrameHeader`] as the attachment |
//! | `camera-status/<camera>` | [`CameraStatus`], JSON |
//! | `clock/<host>` | query and reply: `CLOCK_MONOTONIC` of a computer with cameras, nanoseconds, i64 little-endian |
//! | `alive/<publisher>`, `viewer/<subscriber>/alive`, `host/<host>` | liveliness tokens |
//!
//! Every published message carries a [`Header`] as its zenoh attachment: schema version, sequence, times.
//!
//! # Promises
//!
//! - Publishing never waits for the network: each topic has one slot, the newest message wins, replaced messages are counted, and one named
//!   thread drains the slots.
//! - No input makes a decoder panic or allocate more than the size of its payload allows. Payloads that wait for a reader are bounded in
//!   bytes ([`TransportConfig::inbox_bytes`]).
//! - Text of other programs is made [`printable()`] before it reaches the caller.
//! - A subscriber may start before the publisher, stall, die and return; a publisher may restart.

mod cameras;
mod drain;
mod error;
mod expected;
mod header;
mod host;
mod inbox;
mod json;
mod keys;
mod people;
mod printable;
mod publisher;
mod report;
mod schema;
mod session;
mod stats;
mod subscriber;
#[cfg(test)]
mod testing;
mod topic;
mod views;

pub use cameras::{
    calibration::{RigTransforms, decode_calibration, decode_transforms, encode_calibration, encode_transforms},
    frame::{CameraStatus, FRAME_HEADER_BYTES, FrameHeader, MAX_FRAME_BYTES},
    host_clock::{ClockEstimate, HostClock},
    link::CameraLink,
    publisher::CameraPublisher,
    subscriber::CameraSubscriber,
};
pub use error::{TransportError, TransportErrorKind};
pub use flyrig_stream::{MAX_SPLATS, SplatError, SplatState};
pub use header::{HEADER_BYTES, Header, MessageKind};
pub use keys::MAX_PERSON_TOPICS;
pub use people::{
    person_stream::PersonMessage,
    present::SharedColors,
    relay::Relay,
    template_fetcher::{FetchedTemplate, TemplateFetcher},
};
pub use printable::{MAX_PRINTABLE, printable};
pub use publisher::{Publisher, ViewpointCounts};
pub use report::{LatencyReport, TopicReport};
pub use schema::SCHEMA_VERSION;
pub use session::{config::TransportConfig, network_threads::use_one_network_thread};
pub use stats::{BudgetStats, LearningStats, RigStats, StageStats, SubjectStats, TrackingStats, ViewRate};
pub use subscriber::{Interests, Received, Subscriber, Views};
pub use topic::{PublishOutcome, TopicCounts};
pub use views::{
    view::{ImageFormat, MAX_IMAGE_BYTES, ViewFrame},
    viewpoint::{MAX_VIEWPOINT_SIDE, Viewpoint, ViewpointStatus},
};

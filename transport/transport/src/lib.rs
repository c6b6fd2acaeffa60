//! Wire schema, splat stream and zenoh sessions: how a rig is watched from other processes and hosts.
//!
//! # Keys
//!
//! Everything of schema version 1 of the rig `studio` lives under `flyrig/v1/studio/`:
//!
//! | key | payload |
//! |---|---|
//! | `view/<name>` | foxglove `CompressedImage`, protobuf |
//! | `viewer/<subscriber>/view` | the same, a subscriber's own viewpoint |
//! | `splats`, `splats/<person>` | [`SplatState`] of the first person and of the others, own binary layout |
//! | `person/<person>/motion` | [`flyrig_stream::Motion`] |
//! | `person/<person>/color-<layer>` | a layer of colours, for [`flyrig_stream::ColorDecoder`] |
//! | `template/<hash>-<chunk>` | query and reply: u32 size of a [`flyrig_stream::StreamTemplate`], and 60,000 of its bytes |
//! | `calibration/<camera>` | foxglove `CameraCalibration`, protobuf |
//! | `transforms` | foxglove `FrameTransforms`: `world_from_camera` of every camera and the world's up |
//! | `stats` | [`RigStats`], JSON |
//! | `viewpoint/<subscriber>` | query and reply: JSON, the request and the answer |
//! | `camera/<camera>` | a camera's image as it came, [`FrameHeader`] as the attachment |
//! | `camera-status/<camera>` | [`CameraStatus`], JSON |
//! | `clock/<host>` | query and reply: that computer's `CLOCK_MONOTONIC`, nanoseconds, i64 little-endian |
//! | `alive/<publisher>`, `viewer/<subscriber>/alive`, `host/<host>` | liveliness tokens |
//!
//! Every published message carries a [`Header`] as its zenoh attachment: schema version, sequence, times.
//!
//! # Promises
//!
//! - Publishing never waits for the network: each topic has one slot, the newest message wins, the
//!   rest are counted, one named thread drains the slots.
//! - Nothing that arrives makes a decoder panic or allocate more than its payload's size allows. What waits for a reader
//!   is bounded in bytes ([`TransportConfig::inbox_bytes`]).
//! - Text of other programs reaches the caller [`printable`].
//! - A subscriber may start before the publisher, stall, die, come back; a publisher may restart.

mod cameras;
mod drain;
mod error;
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
    relay::Relay,
    template_fetcher::{FetchedTemplate, TemplateFetcher},
};
pub use printable::{MAX_PRINTABLE, printable};
pub use publisher::{Publisher, ViewpointCounts};
pub use report::{LatencyReport, TopicReport};
pub use schema::SCHEMA_VERSION;
pub use session::{config::TransportConfig, network_threads::use_one_network_thread};
pub use stats::{BudgetStats, RigStats, StageStats, SubjectStats, TrackingStats, ViewRate};
pub use subscriber::{Interests, Received, Subscriber, Views};
pub use topic::{PublishOutcome, TopicCounts};
pub use views::{
    view::{ImageFormat, MAX_IMAGE_BYTES, ViewFrame},
    viewpoint::{MAX_VIEWPOINT_SIDE, Viewpoint, ViewpointStatus},
};

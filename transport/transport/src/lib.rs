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

mod access_rules;
mod calibration;
mod camera_inbox;
mod camera_publisher;
mod camera_subscriber;
mod clock_exchange;
mod color_layers;
mod config;
mod drain;
mod error;
mod frame;
mod header;
mod host_clock;
mod inbox;
mod keys;
mod network_threads;
mod people;
mod printable;
mod publisher;
mod relay;
mod renewal;
mod report;
mod session;
mod splats;
mod stats;
mod subscriber;
mod template_fetcher;
mod topic;
mod view;
mod viewpoint;
mod wake_lag;

pub use calibration::{RigTransforms, decode_calibration, decode_transforms, encode_calibration, encode_transforms};
pub use camera_publisher::CameraPublisher;
pub use camera_subscriber::{CameraLink, CameraSubscriber};
pub use config::TransportConfig;
pub use error::{TransportError, TransportErrorKind};
pub use frame::{CameraStatus, FRAME_HEADER_BYTES, FrameHeader, MAX_FRAME_BYTES};
pub use header::{HEADER_BYTES, Header, MessageKind, SCHEMA_VERSION};
pub use host_clock::{ClockEstimate, HostClock};
pub use network_threads::use_one_network_thread;
pub use people::PersonMessage;
pub use printable::{MAX_PRINTABLE, printable};
pub use publisher::{Publisher, ViewpointCounts};
pub use relay::Relay;
pub use report::{LatencyReport, TopicReport};
pub use splats::{MAX_PERSON_TOPICS, MAX_SPLATS, SplatState};
pub use stats::{BudgetStats, RigStats, StageStats, SubjectStats, TrackingStats, ViewRate};
pub use subscriber::{Interests, Received, Subscriber, Views};
pub use template_fetcher::{FetchedTemplate, TemplateFetcher};
pub use topic::{PublishOutcome, TopicCounts};
pub use view::{ImageFormat, MAX_IMAGE_BYTES, ViewFrame};
pub use viewpoint::{MAX_VIEWPOINT_SIDE, Viewpoint, ViewpointStatus};

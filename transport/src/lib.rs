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
//! | `splats` | [`SplatState`], own binary layout |
//! | `calibration/<camera>` | foxglove `CameraCalibration`, protobuf |
//! | `transforms` | foxglove `FrameTransforms`: `world_from_camera` of every camera and the world's up |
//! | `stats` | [`RigStats`], JSON |
//! | `viewpoint/<subscriber>` | query and reply: JSON, the request and the answer |
//! | `alive/<publisher>`, `viewer/<subscriber>/alive` | liveliness tokens |
//!
//! Every message carries a [`Header`] as its zenoh attachment: schema version, sequence, times.
//!
//! # Promises
//!
//! - Publishing never waits for the network: each topic has one slot, the newest message wins, the
//!   rest are counted, one named thread drains the slots.
//! - Nothing that arrives makes a decoder panic or allocate more than its payload's size allows.
//! - A subscriber may start before the publisher, stall, die, come back; a publisher may restart.

mod calibration;
mod config;
mod error;
mod header;
mod keys;
mod publisher;
mod splats;
mod stats;
mod subscriber;
mod view;
mod viewpoint;

pub use calibration::{decode_calibration, decode_transforms, encode_calibration, encode_transforms, RigTransforms};
pub use config::TransportConfig;
pub use error::{TransportError, TransportErrorKind};
pub use header::{Header, MessageKind, HEADER_BYTES, SCHEMA_VERSION};
pub use publisher::{PublishOutcome, Publisher, TopicCounts, ViewpointCounts};
pub use splats::{SplatState, MAX_SPLATS};
pub use stats::{RigStats, StageTime, ViewRate};
pub use subscriber::{Interests, LatencyReport, Received, Subscriber, TopicReport, Views};
pub use view::{ImageFormat, ViewFrame, MAX_IMAGE_BYTES};
pub use viewpoint::{Viewpoint, ViewpointStatus, MAX_VIEWPOINT_SIDE};

//! Schemas that are known by name, and their encodings.

use flyrig_types::{Isometry, shortened};
use foxglove::{
    Decode,
    messages::{CameraCalibration, CompressedImage, FrameTransform, FrameTransforms, RawImage, Timestamp},
};
use glam::{DQuat, DVec3};
use mcap::Channel;
use prost::bytes::Bytes;

use super::{
    cdr::Reader,
    content::{Family, ImageMessage, Kind, LensMessage, Link, Pixels},
    json, ros,
};

/// Encoding of messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wire {
    Protobuf,
    Json,
    Cdr,
    Ros1,
}

/// Known schema of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Schema {
    family: Family,
    kind: Kind,
    wire: Wire,
}

impl Schema {
    /// Returns the schema of a channel; `None` if it concerns no camera, an error if it does but cannot be read.
    pub fn of(channel: &Channel<'_>) -> Option<Result<Self, String>> {
        let name = channel.schema.as_ref()?.name.as_str();
        // "sensor_msgs/msg/Image" in ROS 2, "sensor_msgs/Image" in ROS 1, "foxglove.RawImage" in protobuf.
        let plain = name.replace("::", "/").replace("/msg/", "/").replace('.', "/");
        let (package, message) = plain.rsplit_once('/')?;
        let family = if package.starts_with("foxglove") { Family::Foxglove } else { Family::Ros };
        let kind = match (package, message) {
            ("foxglove" | "foxglove_msgs" | "sensor_msgs", "CompressedImage") => Kind::CompressedImage,
            ("foxglove" | "foxglove_msgs", "RawImage") | ("sensor_msgs", "Image") => Kind::RawImage,
            ("foxglove" | "foxglove_msgs", "CameraCalibration") | ("sensor_msgs", "CameraInfo") => Kind::Lens,
            ("foxglove" | "foxglove_msgs", "FrameTransform") | ("geometry_msgs", "TransformStamped") => Kind::Link,
            ("foxglove" | "foxglove_msgs", "FrameTransforms") | ("tf2_msgs" | "tf", "TFMessage" | "tfMessage") => {
                Kind::Links
            }
            ("foxglove" | "foxglove_msgs", "CompressedVideo") | (_, "FFMPEGPacket") => Kind::Video,
            ("theora_image_transport", "Packet") => Kind::Video,
            _ => return None,
        };
        let wire = match (channel.message_encoding.as_str(), family) {
            _ if kind == Kind::Video => Err(format!("{name} is a video; record images, or JPEG images")),
            ("protobuf", Family::Foxglove) => Ok(Wire::Protobuf),
            ("json", Family::Foxglove) => Ok(Wire::Json),
            ("cdr", _) => Ok(Wire::Cdr),
            ("ros1", _) => Ok(Wire::Ros1),
            (other, _) => Err(format!("{name} is encoded as '{}', which is not read", shortened(other))),
        };
        Some(wire.map(|wire| Self { family, kind, wire }))
    }

    pub fn kind(self) -> Kind {
        self.kind
    }

    /// Returns whether the messages are images.
    pub fn is_image(self) -> bool {
        matches!(self.kind, Kind::CompressedImage | Kind::RawImage)
    }

    pub fn image(self, payload: Vec<u8>) -> Result<ImageMessage, String> {
        let payload = Bytes::from(payload);
        match (self.wire, self.kind) {
            (Wire::Protobuf, Kind::RawImage) => {
                let RawImage { timestamp, frame_id, width, height, encoding, step, data } = protobuf(payload)?;
                let pixels = Pixels::Raw { width, height, encoding, step, data };
                Ok(ImageMessage { stamp_nanos: nanos(timestamp), frame_id, pixels })
            }
            (Wire::Protobuf, _) => {
                let CompressedImage { timestamp, frame_id, data, format } = protobuf(payload)?;
                let pixels = Pixels::Compressed { format, data };
                Ok(ImageMessage { stamp_nanos: nanos(timestamp), frame_id, pixels })
            }
            (Wire::Json, kind) => json::image(&json::parse(&payload)?, kind),
            (Wire::Cdr, kind) => ros::image(Reader::cdr(payload)?, self.family, kind),
            (Wire::Ros1, kind) => ros::image(Reader::ros1(payload), self.family, kind),
        }
    }

    pub fn lens(self, payload: Vec<u8>) -> Result<LensMessage, String> {
        let payload = Bytes::from(payload);
        match self.wire {
            Wire::Protobuf => {
                let CameraCalibration { frame_id, width, height, distortion_model, d, k, r, p, .. } =
                    protobuf(payload)?;
                Ok(LensMessage { frame_id, width, height, model: distortion_model, d, k, r, p, ..Default::default() })
            }
            Wire::Json => json::lens(&json::parse(&payload)?),
            Wire::Cdr => ros::lens(Reader::cdr(payload)?, self.family),
            Wire::Ros1 => ros::lens(Reader::ros1(payload), self.family),
        }
    }

    pub fn links(self, payload: Vec<u8>) -> Result<Vec<Link>, String> {
        let payload = Bytes::from(payload);
        match (self.wire, self.kind) {
            (Wire::Protobuf, Kind::Link) => Ok(vec![link(protobuf(payload)?)?]),
            (Wire::Protobuf, _) => {
                let FrameTransforms { transforms } = protobuf(payload)?;
                transforms.into_iter().map(link).collect()
            }
            (Wire::Json, kind) => json::links(&json::parse(&payload)?, kind),
            (Wire::Cdr, kind) => ros::links(Reader::cdr(payload)?, self.family, kind),
            (Wire::Ros1, kind) => ros::links(Reader::ros1(payload), self.family, kind),
        }
    }
}

fn protobuf<M: Decode>(payload: Bytes) -> Result<M, String> {
    M::decode(payload).map_err(|error| error.to_string())
}

/// Returns a time, nanoseconds; 0 for none.
fn nanos(timestamp: Option<Timestamp>) -> i64 {
    timestamp.map_or(0, |time| i64::from(time.sec()) * 1_000_000_000 + i64::from(time.nsec()))
}

fn link(transform: FrameTransform) -> Result<Link, String> {
    let (t, r) = transform.translation.zip(transform.rotation).ok_or("a transform without translation or rotation")?;
    Ok(Link {
        parent: transform.parent_frame_id,
        child: transform.child_frame_id,
        parent_from_child: Isometry {
            rotation: DQuat::from_xyzw(r.x, r.y, r.z, r.w),
            translation: DVec3::new(t.x, t.y, t.z),
        },
    })
}

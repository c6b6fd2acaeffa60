//! Calibration on the wire: foxglove `CameraCalibration` for intrinsics, `FrameTransforms` for poses.

use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Lens, Rig};
use foxglove::{
    Decode,
    messages::{CameraCalibration, FrameTransform, FrameTransforms, Quaternion, Vector3},
};
use glam::{DQuat, DVec2, DVec3};

use crate::{
    error::TransportError,
    keys,
    views::view::{timestamp, to_bytes},
};

/// Frames of the transforms message: the level frame (z up) is the parent of the world, which is the parent of the cameras.
const LEVEL: &str = "level";
const WORLD: &str = "world";

/// Largest number of cameras of a rig on the wire.
const MAX_CAMERAS: usize = 1024;

/// Largest payload that is read, bytes.
pub(crate) const MAX_BYTES: usize = 1 << 18;

/// Encodes the intrinsics of a camera as foxglove `CameraCalibration` (protobuf).
///
/// # Errors
/// `Config` when the camera is not valid.
pub fn encode_calibration(camera: &Camera) -> Result<Vec<u8>, TransportError> {
    camera.validate().map_err(|error| TransportError::config("calibration", error.to_string()))?;
    let i = &camera.intrinsics;
    let (model, d) = match i.lens {
        Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] } => {
            ("plumb_bob", vec![k1, k2, p1, p2, k3])
        }
        Lens::Rational { radial: [k1, k2, k3, k4, k5, k6], tangential: [p1, p2] } => {
            ("rational_polynomial", vec![k1, k2, p1, p2, k3, k4, k5, k6])
        }
        Lens::Fisheye { coefficients } => ("kannala_brandt", coefficients.to_vec()),
    };
    let (f, c) = (i.focal_px, i.center_px);
    let message = CameraCalibration {
        timestamp: Some(timestamp(0)),
        frame_id: camera.id.to_string(),
        width: i.width,
        height: i.height,
        distortion_model: model.to_owned(),
        d,
        k: vec![f.x, 0.0, c.x, 0.0, f.y, c.y, 0.0, 0.0, 1.0],
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: vec![f.x, 0.0, c.x, 0.0, 0.0, f.y, c.y, 0.0, 0.0, 0.0, 1.0, 0.0],
    };
    to_bytes("calibration", &message)
}

/// Decodes name and intrinsics of a camera from `CameraCalibration`.
///
/// # Errors
/// `Malformed` names the field.
pub fn decode_calibration(bytes: &[u8]) -> Result<(CameraId, Intrinsics), TransportError> {
    let malformed = |message: String| TransportError::malformed("calibration", message);
    let message: CameraCalibration = decode("calibration", bytes)?;
    let &[fx, skew, cx, zero_a, fy, cy, zero_b, zero_c, one] = message.k.as_slice() else {
        return Err(malformed(format!("K has {} numbers, expected 9", message.k.len())));
    };
    let rest = [skew, zero_a, zero_b, zero_c, one - 1.0];
    if rest.iter().any(|value| value.is_nan() || value.abs() > 1e-9) {
        return Err(malformed("K has skew or a last row other than 0 0 1".to_owned()));
    }
    let lens = match (message.distortion_model.as_str(), message.d.as_slice()) {
        ("plumb_bob", &[k1, k2, p1, p2, k3]) => Lens::RadialTangential { radial: [k1, k2, k3], tangential: [p1, p2] },
        ("rational_polynomial", &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
            Lens::Rational { radial: [k1, k2, k3, k4, k5, k6], tangential: [p1, p2] }
        }
        ("kannala_brandt", &[k1, k2, k3, k4]) => Lens::Fisheye { coefficients: [k1, k2, k3, k4] },
        ("", []) => Lens::PINHOLE,
        (model, d) => {
            let text = format!(
                "distortion {model:?} with {} numbers; known: plumb_bob with 5, rational_polynomial with 8, kannala_brandt with 4",
                d.len()
            );
            return Err(malformed(text));
        }
    };
    let intrinsics = Intrinsics {
        width: message.width,
        height: message.height,
        focal_px: DVec2::new(fx, fy),
        center_px: DVec2::new(cx, cy),
        lens,
    };
    let id = camera_id("calibration", &message.frame_id)?;
    let camera = Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: id.clone(),
        intrinsics,
        camera_from_world: Isometry::IDENTITY,
    };
    camera.validate().map_err(|error| malformed(error.to_string()))?;
    Ok((id, intrinsics))
}

/// Poses of the cameras, in rig order, and the up direction.
#[derive(Debug, Clone, PartialEq)]
pub struct RigTransforms {
    /// `camera_from_world` of each camera.
    pub camera_from_world: Vec<(CameraId, Isometry)>,
    /// Unit vector against gravity, world axes.
    pub world_up: DVec3,
}

/// Encodes the poses of a rig's cameras as foxglove `FrameTransforms` (protobuf): `level` (z up) is the parent of `world`, which is the
/// parent of every camera.
///
/// # Errors
/// `Config` when the rig is not valid.
pub fn encode_transforms(rig: &Rig) -> Result<Vec<u8>, TransportError> {
    rig.validate().map_err(|error| TransportError::config("transforms", error.to_string()))?;
    let up = rig.world_up.try_normalize().filter(|up| up.is_finite());
    let up = up.ok_or_else(|| TransportError::config("transforms", "the rig's world_up is no direction"))?;
    let level_from_world = Isometry::new(DQuat::from_rotation_arc(up, DVec3::Z), DVec3::ZERO);
    let cameras = rig.cameras.iter().map(|c| transform(WORLD, &c.id.to_string(), &c.camera_from_world.inverse()));
    let transforms = std::iter::once(transform(LEVEL, WORLD, &level_from_world)).chain(cameras).collect();
    to_bytes("transforms", &FrameTransforms { transforms })
}

/// Decodes the poses of a rig's cameras from `FrameTransforms`.
///
/// # Errors
/// `Malformed` names the transform.
pub fn decode_transforms(bytes: &[u8]) -> Result<RigTransforms, TransportError> {
    let malformed = |message: String| TransportError::malformed("transforms", message);
    let message: FrameTransforms = decode("transforms", bytes)?;
    if message.transforms.len() > MAX_CAMERAS + 1 {
        return Err(malformed(format!("{} transforms, at most {}", message.transforms.len(), MAX_CAMERAS + 1)));
    }
    let mut world_up = None;
    let mut cameras: Vec<(CameraId, Isometry)> = Vec::with_capacity(message.transforms.len());
    for t in &message.transforms {
        let parent_from_child = isometry(t)
            .ok_or_else(|| malformed(format!("{:?} is absent, not finite or not a rotation", t.child_frame_id)))?;
        match (t.parent_frame_id.as_str(), t.child_frame_id.as_str()) {
            (LEVEL, WORLD) => world_up = Some(parent_from_child.rotation.inverse() * DVec3::Z),
            (WORLD, name) => {
                let id = camera_id("transforms", name)?;
                if cameras.iter().any(|(other, _)| *other == id) {
                    return Err(malformed(format!("camera {id} appears twice")));
                }
                cameras.push((id, parent_from_child.inverse()));
            }
            (parent, child) => return Err(malformed(format!("{child:?} in {parent:?} is not known"))),
        }
    }
    let world_up = world_up.ok_or_else(|| malformed("the transform of the world is absent".to_owned()))?;
    Ok(RigTransforms { camera_from_world: cameras, world_up })
}

fn decode<M: Decode>(topic: &str, bytes: &[u8]) -> Result<M, TransportError> {
    if bytes.len() > MAX_BYTES {
        return Err(TransportError::malformed(topic, format!("{} bytes, at most {MAX_BYTES}", bytes.len())));
    }
    M::decode(bytes).map_err(|error| TransportError::malformed(topic, format!("not the expected protobuf: {error}")))
}

fn camera_id(topic: &str, name: &str) -> Result<CameraId, TransportError> {
    keys::check_name("camera", name).map_err(|error| TransportError::malformed(topic, error.to_string()))?;
    Ok(CameraId::from(name))
}

fn transform(parent: &str, child: &str, parent_from_child: &Isometry) -> FrameTransform {
    let (t, r) = (parent_from_child.translation, parent_from_child.rotation);
    FrameTransform {
        timestamp: Some(timestamp(0)),
        parent_frame_id: parent.to_owned(),
        child_frame_id: child.to_owned(),
        translation: Some(Vector3 { x: t.x, y: t.y, z: t.z }),
        rotation: Some(Quaternion { x: r.x, y: r.y, z: r.z, w: r.w }),
    }
}

fn isometry(transform: &FrameTransform) -> Option<Isometry> {
    let (t, r) = (transform.translation?, transform.rotation?);
    let rotation = DQuat::from_xyzw(r.x, r.y, r.z, r.w);
    let isometry = Isometry { rotation, translation: DVec3::new(t.x, t.y, t.z) };
    (isometry.is_finite() && (rotation.length() - 1.0).abs() < 1e-6).then_some(isometry)
}

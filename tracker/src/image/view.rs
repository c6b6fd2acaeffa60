//! A camera as the solver sees it: projection onto the undistorted image plane, and undistorted landmarks.

use flyrig_types::Camera;
use glam::{DMat3, DVec2, DVec3};

use crate::landmarks::keypoints::{LANDMARK_COUNT, Sharpness, ViewKeypoints};

/// Least depth of a point that is projected, metres.
const NEAR_M: f64 = 0.1;

/// Undistorted camera: extrinsics (camera from world) and the mean focal length.
#[derive(Debug, Clone)]
pub(crate) struct View {
    pub rotation: DMat3,
    pub translation: DVec3,
    pub focal_px: f64,
}

impl View {
    /// Returns the undistorted view of a camera.
    pub fn new(camera: &Camera) -> Self {
        Self {
            rotation: DMat3::from_quat(camera.camera_from_world.rotation),
            translation: camera.camera_from_world.translation,
            focal_px: 0.5 * (camera.intrinsics.focal_px.x + camera.intrinsics.focal_px.y),
        }
    }

    /// Returns the camera coordinates of a world point, metres; `None` when it is not in front of the camera.
    pub fn to_camera(&self, world: DVec3) -> Option<DVec3> {
        let point = self.rotation * world + self.translation;
        (point.is_finite() && point.z > NEAR_M).then_some(point)
    }

    /// Projects a world point to undistorted pixels from the principal point.
    pub fn project(&self, world: DVec3) -> Option<DVec2> {
        self.to_camera(world).map(|p| p.truncate() * (self.focal_px / p.z))
    }

    /// Returns the image scale at a world point, undistorted pixels per metre.
    pub fn px_per_m(&self, world: DVec3) -> Option<f64> {
        self.to_camera(world).map(|p| self.focal_px / p.z)
    }

    /// Returns [`Self::project`] and its derivative by the world point (rows: du, dv).
    pub fn project_with_derivative(&self, world: DVec3) -> Option<(DVec2, [DVec3; 2])> {
        let p = self.to_camera(world)?;
        let scale = self.focal_px / p.z;
        let ideal = p.truncate() / p.z;
        let rows = self.rotation.transpose();
        let du = rows * DVec3::new(scale, 0.0, -scale * ideal.x);
        let dv = rows * DVec3::new(0.0, scale, -scale * ideal.y);
        Some((ideal * self.focal_px, [du, dv]))
    }

    /// Undistorts a pixel of this view's camera, pixels from the principal point. `None` where the lens model has no
    /// inverse.
    pub fn undistorted(&self, camera: &Camera, pixel: DVec2) -> Option<DVec2> {
        let distorted = (pixel - camera.intrinsics.center_px) / camera.intrinsics.focal_px;
        let ideal = camera.intrinsics.lens.undistort(distorted)? * self.focal_px;
        ideal.is_finite().then_some(ideal)
    }

    /// Returns the camera's centre in the world, metres.
    pub fn center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }
}

/// Landmark on the undistorted image plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Observation {
    /// Undistorted pixels from the principal point.
    pub ideal_px: DVec2,
    /// Confidence of the network, 0..=1.
    pub confidence: f64,
    /// Sharpness of the landmark's heatmap, axes of the image.
    pub sharpness: Sharpness,
    /// Trust by age: 1 where the network ran on this very image, less where the landmark was carried along, 0..=1.
    pub trust: f64,
}

/// Undistorts the usable landmarks of one view whose confidence reaches the threshold.
pub(crate) fn observe(
    camera: &Camera,
    view: &View,
    keypoints: &ViewKeypoints,
    confidence_threshold: f64,
) -> [Option<Observation>; LANDMARK_COUNT] {
    std::array::from_fn(|i| {
        let keypoint = keypoints[i];
        if !keypoint.usable() || keypoint.confidence < confidence_threshold {
            return None;
        }
        let ideal_px = view.undistorted(camera, keypoint.pixel)?;
        Some(Observation {
            ideal_px,
            confidence: keypoint.confidence.min(1.0),
            sharpness: keypoint.sharpness,
            trust: 1.0,
        })
    })
}

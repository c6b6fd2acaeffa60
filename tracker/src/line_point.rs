//! Points of the body's surface that belong on lines in an image: what outlines and texture say of a pose.

use flyrig_body::Template;
use flyrig_types::Camera;
use glam::{DVec2, DVec3};

use crate::body_model::BodyModel;
use crate::view::View;

/// Where a line comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LineKind {
    /// The end of a mask.
    Outline,
    /// The brightness that the point had before.
    Texture,
}

/// A point of the body's surface in a view, and the line in the image that it belongs on.
#[derive(Debug, Clone)]
pub(crate) struct LinePoint {
    pub kind: LineKind,
    /// Vertex of the template.
    pub vertex: usize,
    /// Index of the view in the fit.
    pub view: usize,
    /// Normal of the line, undistorted pixels.
    pub normal: DVec2,
    /// Place of the line along its normal, undistorted pixels from the principal point.
    pub offset: f64,
    /// Standard deviation of the distance from the line, undistorted pixels.
    pub sigma_px: f64,
    /// Joints that carry the vertex, their weights (sum 1) and the vertex from the joint's origin, canonical metres.
    pub bones: Vec<(usize, f64, DVec3)>,
    /// Motion from the pose's time to the image's, world metres.
    pub shift: DVec3,
}

impl LinePoint {
    /// Hangs the point on the bones of a model of the template's shape.
    pub fn hang(&mut self, model: &BodyModel, template: &Template) {
        self.bones = bones(model, template, self.vertex);
    }
}

/// Returns joints, weights and places on the bones of a vertex.
pub(crate) fn bones(model: &BodyModel, template: &Template, vertex: usize) -> Vec<(usize, f64, DVec3)> {
    let (point, skin) = (template.positions[vertex].as_dvec3(), &template.skin[vertex]);
    let total: f64 = skin.weights.iter().filter(|w| **w > 0.0).map(|w| f64::from(*w)).sum();
    let carrying = skin.joints.iter().zip(&skin.weights).filter(|(_, w)| **w > 0.0);
    carrying
        .map(|(&joint, &weight)| {
            let joint = usize::from(joint);
            (joint, f64::from(weight) / total, point - model.origins[joint])
        })
        .collect()
}

/// Returns normal and offset on the undistorted plane of a line through a pixel of the image, by its normal in the image.
pub(crate) fn undistorted_line(camera: &Camera, view: &View, through: DVec2, normal: DVec2) -> Option<(DVec2, f64)> {
    let (on, beyond) = (view.undistorted(camera, through)?, view.undistorted(camera, through + normal)?);
    let normal = (beyond - on).normalize_or_zero();
    (normal != DVec2::ZERO).then(|| (normal, normal.dot(on)))
}

//! Points of the body's surface that belong on lines in an image: the form in which outlines and texture constrain a pose.

use std::collections::HashMap;

use flyrig_body::Template;
use flyrig_types::Camera;
use glam::{DVec2, DVec3, Vec3};

use crate::image::view::View;
use crate::pose::body_model::BodyModel;

/// Source of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LineKind {
    /// Border of a mask.
    Outline,
    /// Remembered brightness of the point.
    Texture,
}

/// Point of the body's surface in a view, and the image line that it belongs on.
#[derive(Debug, Clone)]
pub(crate) struct LinePoint {
    pub kind: LineKind,
    /// Vertex of the template.
    pub vertex: usize,
    /// Offset of the point from that vertex, canonical metres: the thickness of clothes.
    pub worn: DVec3,
    /// Index of the view in the fit.
    pub view: usize,
    /// Normal of the line, undistorted pixels.
    pub normal: DVec2,
    /// Distance of the line from the principal point along its normal, undistorted pixels.
    pub offset: f64,
    /// Standard deviation of the point's distance from the line, undistorted pixels.
    pub sigma_px: f64,
    /// Joints that carry the point, their weights (sum 1) and the point relative to each joint's origin, canonical metres.
    pub bones: Vec<(usize, f64, DVec3)>,
    /// Motion from the pose's time to the image's, world metres.
    pub shift: DVec3,
}

impl LinePoint {
    /// Attaches the point to the bones of a model of the template's shape.
    pub fn hang(&mut self, model: &BodyModel, template: &Template) {
        self.bones = bones(model, template, self.vertex);
        self.bones.iter_mut().for_each(|(_, _, local)| *local += self.worn);
    }
}

/// Bare body below clothes, to find its vertices by place.
pub(crate) struct BareBody<'a> {
    body: &'a Template,
    /// Vertex at each place: most vertices of a dressed body are those of the bare one, at other indices.
    by_place: HashMap<[u32; 3], usize>,
}

impl<'a> BareBody<'a> {
    /// Indexes the vertices of a body.
    pub fn new(body: &'a Template) -> Self {
        let by_place = body.positions.iter().enumerate().map(|(vertex, at)| (key(*at), vertex)).collect();
        Self { body, by_place }
    }

    /// Attaches a point of a dressed body to the nearest vertex of the bare one, at its offset, so that it moves with the
    /// body's shape.
    pub fn undress(&self, point: &mut LinePoint, dressed: &Template) {
        let Some(at) = dressed.positions.get(point.vertex) else { return };
        let bare = &self.body.positions;
        let distance = |v: &usize| bare[*v].distance_squared(*at);
        let search = || (0..bare.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        if let Some(nearest) = self.by_place.get(&key(*at)).copied().or_else(search) {
            (point.vertex, point.worn) = (nearest, (*at - bare[nearest]).as_dvec3());
        }
    }
}

/// Returns the exact place as a key.
fn key(at: Vec3) -> [u32; 3] {
    at.to_array().map(f32::to_bits)
}

/// Returns the joints that carry a vertex, their weights (sum 1) and the vertex relative to each joint's origin, canonical
/// metres.
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

/// Whether a fit of the body may use a point with these bones. Points on fingers are left out: fingers do not turn in that
/// fit, so wrist and arm would turn to match them.
pub(crate) fn is_usable(model: &BodyModel, bones: &[(usize, f64, DVec3)]) -> bool {
    let of_fingers: f64 = bones.iter().filter(|(joint, ..)| model.is_finger(*joint)).map(|(_, weight, _)| weight).sum();
    !bones.is_empty() && of_fingers <= 0.5
}

/// Returns normal and offset on the undistorted plane of the line through a pixel with a normal in the image.
pub(crate) fn undistorted_line(camera: &Camera, view: &View, through: DVec2, normal: DVec2) -> Option<(DVec2, f64)> {
    let (on, beyond) = (view.undistorted(camera, through)?, view.undistorted(camera, through + normal)?);
    let normal = (beyond - on).normalize_or_zero();
    (normal != DVec2::ZERO).then(|| (normal, normal.dot(on)))
}

#[cfg(test)]
mod tests {
    use flyrig_body::Shoes;

    use super::*;
    use crate::testing::body;

    #[test]
    fn points_of_the_palm_are_usable_and_those_of_fingers_are_not() {
        let fingered = body().with_fingers().unwrap();
        let model = BodyModel::new(&fingered).unwrap();
        let usable = |vertex: usize| is_usable(&model, &bones(&model, &fingered, vertex));
        let (tip, _) = (fingered.positions.iter().enumerate()).max_by(|a, b| a.1.x.total_cmp(&b.1.x)).unwrap();
        assert!(!usable(tip), "a fingertip");
        let is_palm = |&v: &usize| {
            let bones = bones(&model, &fingered, v);
            bones.iter().any(|(joint, weight, _)| model.roles.hand.contains(joint) && *weight > 0.6)
        };
        let palms: Vec<usize> = (0..fingered.positions.len()).filter(is_palm).collect();
        assert!(palms.len() > 5 && palms.iter().all(|v| usable(*v)), "{} points of palms", palms.len());
        let rest = (0..fingered.positions.len()).filter(|&v| usable(v)).count();
        assert!(rest > fingered.positions.len() / 2 && rest < fingered.positions.len(), "{rest}");
        assert!(!is_usable(&model, &[]), "no bone");
    }

    #[test]
    fn a_point_of_a_shoe_hangs_on_the_foot_as_far_outside_as_it_is() {
        let body = body();
        let dressed = Shoes { sole_m: 0.03 }.on(&body).unwrap();
        let model = BodyModel::new(&body).unwrap();
        let lowest = |template: &Template| {
            let height = |v: &usize| template.positions[*v].y;
            (0..template.positions.len()).min_by(|a, b| height(a).total_cmp(&height(b))).unwrap()
        };
        for vertex in [lowest(&dressed), 5, dressed.positions.len() - 1] {
            let mut point = LinePoint {
                kind: LineKind::Outline,
                vertex,
                worn: DVec3::ZERO,
                view: 0,
                normal: DVec2::X,
                offset: 0.0,
                sigma_px: 1.0,
                bones: bones(&model, &dressed, vertex),
                shift: DVec3::ZERO,
            };
            let place = |point: &LinePoint| -> DVec3 {
                point.bones.iter().map(|(bone, weight, local)| (model.origins[*bone] + *local) * *weight).sum()
            };
            let before = place(&point);
            BareBody::new(&body).undress(&mut point, &dressed);
            assert!(point.vertex < body.positions.len());
            assert!(vertex != 5 || point.worn == DVec3::ZERO, "bare skin is where it was");
            point.hang(&model, &body);
            assert!((place(&point) - before).length() < 1e-6, "{} and {before}", place(&point));
        }
    }
}

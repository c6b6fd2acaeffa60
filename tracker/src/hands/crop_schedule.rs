//! Crops around hands and faces, the last inference in each, and its staleness.

use flyrig_solve::RigidMotion;
use flyrig_types::Camera;
use glam::{DVec2, DVec3};

use crate::hands::hand_net::HAND_LANDMARKS;
use crate::image::crop::Crop;
use crate::image::view::View;
use crate::pose::body_model::{BodyModel, PosedSkeleton};

/// Age at which an inference expires, seconds.
pub(crate) const FORGET_SECS: f64 = 0.4;
/// Age at which the weight of an inference is halved, seconds.
const HALF_SECS: f64 = 0.12;
/// Staleness that an inference gains with age, metres per second: fingers move while the wrist rests.
const AGING_M_PER_SEC: f64 = 0.05;
/// Landmarks between the wrist and the middle joints, which frame a crop as in the original's hand tracking.
const PALM: [usize; 12] = [0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18];
/// Side of a crop as a multiple of the palm's frame, and its shift towards the fingers: those that the network was trained
/// with.
const HAND_MARGIN: f64 = 2.0;
const HAND_SHIFT: f64 = 0.1;
/// Least side of a crop, lengths of the unforeshortened hand.
const LEAST_HANDS: f64 = 1.3;
/// Height of a face on a body of 1.7 m, metres, and the crop's side in heights.
pub(crate) const FACE_M: f64 = 0.18;
const FACE_MARGIN: f64 = 1.5;
/// Smallest cosine between a face and the way to the camera.
const FACING: f64 = 0.2;

/// Last inference of a network on a hand or a face in one view.
#[derive(Debug, Clone)]
pub(crate) struct PartInference {
    pub nanos: i64,
    /// Undistorted pixels from the principal point; `None` for unusable landmarks.
    pub seen: Vec<Option<DVec2>>,
    pub presence: f64,
    /// Hand or head by the body's pose at the image's time, world frame.
    pub frame: RigidMotion,
}

impl PartInference {
    /// Returns the motion of the part since, metres: of its joint, of flesh at `reach_m` through rotation, and a share of
    /// age.
    pub fn staleness_m(&self, frame: &RigidMotion, reach_m: f64, nanos: i64) -> f64 {
        let turned = self.frame.rotation.angle_between(frame.rotation) * reach_m;
        self.frame.translation.distance(frame.translation) + turned + AGING_M_PER_SEC * self.age_secs(nanos)
    }

    /// Returns the weight at a later time, 0..=1.
    pub fn trust(&self, nanos: i64) -> f64 {
        self.presence / (1.0 + (self.age_secs(nanos) / HALF_SECS).powi(2))
    }

    /// Returns the age at a later time, seconds.
    pub fn age_secs(&self, nanos: i64) -> f64 {
        1e-9 * nanos.saturating_sub(self.nanos).max(0) as f64
    }

    /// Returns the motion of the part from now to the image's time, world frame.
    pub fn carry(&self, frame: &RigidMotion) -> RigidMotion {
        self.frame * frame.inverse()
    }
}

/// Whether a pixel lies in the image.
fn inside(camera: &Camera, pixel: DVec2) -> bool {
    let size = DVec2::new(f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
    pixel.cmpgt(DVec2::ZERO).all() && pixel.cmplt(size).all()
}

/// Returns the x axis of a crop in which `up` points up.
fn turn_of(up: DVec2) -> DVec2 {
    up.perp().normalize_or(DVec2::X)
}

/// Returns the crop around a hand whose landmarks are expected at world points (metres); `length_px` is the hand's length
/// in the image. `None` when the hand is out of the image.
pub(crate) fn hand_crop(camera: &Camera, points: &[DVec3; HAND_LANDMARKS], length_px: f64) -> Option<Crop> {
    let mut pixels = [DVec2::ZERO; HAND_LANDMARKS];
    for (pixel, point) in pixels.iter_mut().zip(points) {
        *pixel = camera.project(*point).filter(|pixel| pixel.is_finite())?;
    }
    let up = pixels[9] - pixels[0];
    let turn = if up.length() < 0.05 * length_px { DVec2::X } else { turn_of(up) };
    let turned = PALM.map(|i| (turn * DVec2::new(1.0, -1.0)).rotate(pixels[i]));
    let low = turned.iter().copied().fold(DVec2::INFINITY, DVec2::min);
    let high = turned.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
    let size = high - low;
    let middle = 0.5 * (low + high) - DVec2::new(0.0, HAND_SHIFT * size.y);
    let side = (HAND_MARGIN * size.max_element()).max(LEAST_HANDS * length_px);
    let crop = Crop { center: turn.rotate(middle), side, turn };
    (side.is_finite() && (4.0..1e4).contains(&side) && inside(camera, crop.center)).then_some(crop)
}

/// Face in an image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FaceTarget {
    pub crop: Crop,
    /// Height of the face, pixels.
    pub height_px: f64,
}

impl FaceTarget {
    /// Returns the face of a posed body; `None` when it faces away from the camera or is out of the image.
    pub fn new(camera: &Camera, model: &BodyModel, posed: &PosedSkeleton, scale: f64) -> Option<Self> {
        const EYES: [usize; 2] = [2, 5];
        const MOUTH: [usize; 2] = [9, 10];
        let view = View::new(camera);
        let middle = |pair: [usize; 2]| 0.5 * (model.mark(posed, pair[0]) + model.mark(posed, pair[1]));
        let (eyes, mouth) = (middle(EYES), middle(MOUTH));
        let forward = posed.rotation[model.roles.head] * DVec3::Z;
        if forward.dot((view.center() - eyes).try_normalize()?) < FACING {
            return None;
        }
        let height_px = FACE_M * scale * view.px_per_m(eyes)?;
        let (eyes, mouth) = (camera.project(eyes)?, camera.project(mouth)?);
        let center = 0.5 * (eyes + mouth);
        let up = eyes - mouth;
        let side = FACE_MARGIN * height_px;
        let usable = center.is_finite() && (4.0..1e4).contains(&side) && inside(camera, center) && up.length() > 0.5;
        usable.then(|| Self { crop: Crop { center, side, turn: turn_of(up) }, height_px })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hands::hand_model::{HandModel, relaxed};
    use crate::testing::{body, ring};
    use glam::DQuat;

    #[test]
    fn a_hands_crop_holds_all_of_it_with_the_fingers_up() {
        let model = &HandModel::pair(&body().with_fingers().unwrap()).unwrap()[0];
        for (k, camera) in ring(4).cameras.iter().enumerate() {
            let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.7 * k as f64, 0.9, 0.4);
            let points = model.bend(&relaxed()).points.map(|p| DVec3::new(0.1, 0.0, 1.2) + turn * p);
            let length_px = model.length_m * View::new(camera).px_per_m(points[0]).unwrap();
            let crop = hand_crop(camera, &points, length_px).unwrap();
            let at = |i: usize| crop.crop_from_image(camera.project(points[i]).unwrap()) / 256.0;
            assert!(at(9).y < at(0).y && (at(9).x - at(0).x).abs() < 0.02);
            for i in 0..HAND_LANDMARKS {
                let p = at(i);
                assert!(p.cmpgt(DVec2::splat(0.02)).all() && p.cmplt(DVec2::splat(0.98)).all(), "{i} {p}");
            }
            assert!(hand_crop(camera, &points.map(|p| p + DVec3::Z * 50.0), length_px).is_none());
            assert!(hand_crop(camera, &[DVec3::NAN; HAND_LANDMARKS], length_px).is_none());
        }
    }

    #[test]
    fn inferences_grow_stale_with_motion_and_age_and_are_carried_along() {
        let frame = RigidMotion { rotation: DQuat::from_rotation_x(0.3), translation: DVec3::new(0.2, 0.1, 1.0) };
        let inference = PartInference { nanos: 0, seen: Vec::new(), presence: 0.9, frame };
        assert!(inference.staleness_m(&frame, 0.1, 0).abs() < 1e-6);
        let moved = RigidMotion { translation: frame.translation + DVec3::X * 0.03, ..frame };
        assert!(inference.staleness_m(&moved, 0.1, 0) > 0.029);
        assert!(inference.staleness_m(&frame, 0.1, 1_000_000_000) > 0.04);
        assert!(inference.trust(0) > 0.89 && inference.trust(120_000_000) < 0.46);
        let point = DVec3::new(0.25, 0.0, 1.1);
        let then = inference.carry(&moved).apply(point);
        assert!((then - (point - DVec3::X * 0.03)).length() < 1e-9);
    }
}

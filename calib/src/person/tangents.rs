//! Epipolar tangency (e.g. Wong and Cipolla 2001): an epipolar plane that is tangent to a body is tangent to its silhouettes in both
//! cameras, so the angles of the two outermost tangent planes about the baseline are the same in both.

use flyrig_solve::RigidMotion;
use glam::DVec3;

use super::smoothing::parabola_weights;

/// Smallest sine of the angle between the baseline and the viewing direction: near the baseline the angle is ill-conditioned.
const LEAST_APART: f64 = 0.35;
/// Largest angle of a silhouette about the baseline, radians; a wider one surrounds the epipole.
const MOST_SPAN: f64 = 2.0;

/// Corner of the convex hull of a silhouette.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutlineCorner {
    /// Direction in the camera's axes.
    pub ray: DVec3,
    /// Whether the corner lies on the image border, where the silhouette may continue.
    pub is_cut: bool,
}

/// Silhouettes of one camera, in the order of time.
pub(crate) type Outlines = Vec<(i64, Vec<OutlineCorner>)>;

/// One of the two outermost tangent planes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    Low,
    High,
}

/// Camera of a pair.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Eye<'a> {
    pub camera: RigidMotion,
    pub outlines: &'a Outlines,
    /// Timestamp of the instant in this camera, nanoseconds.
    pub stamp: i64,
    pub interval_s: f64,
}

/// Reference frame for the angles of epipolar planes.
struct Pencil {
    across: DVec3,
    front: DVec3,
}

impl Pencil {
    /// Creates the frame with angle 0 towards `ahead`, a fixed direction in the world; `None` where the baseline is too
    /// close to it.
    fn new(a: &RigidMotion, b: &RigidMotion, ahead: DVec3) -> Option<Self> {
        let line = (b.inverse().translation - a.inverse().translation).try_normalize()?;
        let front = ahead.reject_from_normalized(line);
        let is_apart = front.length() >= LEAST_APART * ahead.length();
        let front = front.try_normalize().filter(|_| is_apart)?;
        Some(Self { across: line.cross(front), front })
    }

    fn angle(&self, ray: DVec3) -> f64 {
        ray.dot(self.across).atan2(ray.dot(self.front))
    }
}

/// Hull corners at which an outermost plane is tangent, in the images around an instant.
struct Touch {
    /// Direction in the camera's axes; weight in the angle at the instant, and in its slope per second.
    corners: Vec<(DVec3, f64, f64)>,
}

impl Touch {
    fn new(eye: &Eye<'_>, pencil: &Pencil, side: Side) -> Option<Self> {
        let (near, weights) = parabola_weights(eye.outlines, |(nanos, _)| *nanos, |_| 1.0, eye.stamp, eye.interval_s)?;
        let back = eye.camera.rotation.inverse();
        let corners = near.iter().zip(weights).map(|((_, hull), (value, slope))| {
            let mut low = (f64::INFINITY, None);
            let mut high = (f64::NEG_INFINITY, None);
            for corner in hull {
                let angle = pencil.angle(back * corner.ray);
                if angle < low.0 {
                    low = (angle, Some(corner));
                }
                if angle > high.0 {
                    high = (angle, Some(corner));
                }
            }
            let corner = if side == Side::Low { low.1? } else { high.1? };
            (high.0 - low.0 < MOST_SPAN && !corner.is_cut).then_some((corner.ray, value, slope))
        });
        Some(Self { corners: corners.collect::<Option<_>>()? })
    }

    fn angle(&self, camera: &RigidMotion, pencil: &Pencil) -> f64 {
        let back = camera.rotation.inverse();
        self.corners.iter().map(|(ray, weight, _)| weight * pencil.angle(back * *ray)).sum()
    }

    /// Returns the angular velocity, radians per second.
    fn speed(&self, camera: &RigidMotion, pencil: &Pencil) -> f64 {
        let back = camera.rotation.inverse();
        self.corners.iter().map(|(ray, _, slope)| slope * pencil.angle(back * *ray)).sum()
    }
}

/// Difference between a plane's angles in two cameras, with derivatives by the steps of both poses (turn, shift) and both time offsets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Tangency {
    pub angle: f64,
    pub by_cameras: [[f64; 6]; 2],
    pub by_lags: [f64; 2],
}

/// Compares one outermost tangent plane of two cameras; `None` where one of them does not see it. `ahead` is a fixed direction in the
/// world, roughly from the cameras to the person.
pub(crate) fn tangency(eyes: [Eye<'_>; 2], side: Side, ahead: DVec3, with_derivatives: bool) -> Option<Tangency> {
    let pencil = Pencil::new(&eyes[0].camera, &eyes[1].camera, ahead)?;
    let touches = [Touch::new(&eyes[0], &pencil, side)?, Touch::new(&eyes[1], &pencil, side)?];
    let difference = |cameras: [RigidMotion; 2]| {
        let pencil = Pencil::new(&cameras[0], &cameras[1], ahead)?;
        Some(touches[1].angle(&cameras[1], &pencil) - touches[0].angle(&cameras[0], &pencil))
    };
    let cameras = eyes.map(|eye| eye.camera);
    let angle = difference(cameras)?;
    let mut by_cameras = [[0.0; 6]; 2];
    let mut by_lags = [0.0; 2];
    if with_derivatives {
        // Corners stay fixed: at the outermost ones the angle is stationary along the outline.
        const STEP: f64 = 1e-6;
        for (which, by_camera) in by_cameras.iter_mut().enumerate() {
            for (k, by) in by_camera.iter_mut().enumerate() {
                let at = |step: f64| {
                    let mut twist = [0.0; 6];
                    twist[k] = step;
                    let mut cameras = cameras;
                    let [a, b, c, d, e, f] = twist;
                    cameras[which] = cameras[which].moved(DVec3::new(a, b, c), DVec3::new(d, e, f));
                    difference(cameras)
                };
                *by = (at(STEP)? - at(-STEP)?) / (2.0 * STEP);
            }
        }
        by_lags = [-touches[0].speed(&cameras[0], &pencil), touches[1].speed(&cameras[1], &pencil)];
    }
    angle.is_finite().then_some(Tangency { angle, by_cameras, by_lags })
}

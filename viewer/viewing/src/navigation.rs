//! Viewpoint of the viewer: orbit, fly, zoom, follow.

use flyrig_types::{Camera, Intrinsics, Isometry, Rig};
use glam::DVec3;

/// Range of the distance to the target, metres: a rig limits it further.
const DISTANCE_M: std::ops::RangeInclusive<f64> = 0.4..=50.0;
/// Farthest distance relative to that of the rig's farthest camera, and at least, metres: farther away a person is a dot.
const FARTHEST_SHARE: f64 = 2.0;
const LEAST_FARTHEST_M: f64 = 6.0;
/// Largest factor of one step of zooming: a wheel that is spun, or two fingers that meet, move no farther.
const MOST_ZOOM: f64 = 2.5;
/// Least width of the view relative to its height that the field is kept for: a telephone held upright shows a larger field.
const LEAST_ASPECT: f64 = 0.7;
/// Least angle between line of sight and vertical, radians.
const FROM_POLE: f64 = 0.05;
/// Vertical field of view, radians.
const FIELD: f64 = 0.8;

/// Camera that turns around a target.
///
/// ```
/// use flyrig_types::{Camera, ColorMatch, Intrinsics, Isometry, Rig};
/// use flyrig_viewing::Navigation;
/// use glam::DVec3;
///
/// let camera = Camera {
///     id: "front".into(),
///     time_offset_nanos: 0,
///     color: ColorMatch::default(),
///     intrinsics: Intrinsics::pinhole(640, 480, 500.0),
///     camera_from_world: Isometry::look_at(DVec3::new(3.0, 0.0, 1.0), DVec3::Z, DVec3::Z),
/// };
/// let mut navigation = Navigation::new(&Rig { cameras: vec![camera], world_up: DVec3::Z });
/// let before = navigation.distance();
/// navigation.zoom(2.0);
/// navigation.orbit(0.5, 0.1);
/// assert!((navigation.distance() - before / 2.0).abs() < 1e-9);
/// assert_eq!(navigation.camera(320, 240).size(), [320, 240]);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Navigation {
    up: DVec3,
    /// Point at the centre of the view, metres.
    target: DVec3,
    distance: f64,
    /// Angles around the world's up and above the horizon, radians.
    heading: f64,
    elevation: f64,
    /// Vertical field of view, radians.
    field: f64,
    /// Largest distance to the target, metres.
    farthest: f64,
    /// Position of the followed person at the last update, which keeps the viewer's own shift.
    followed: Option<DVec3>,
}

impl Navigation {
    /// Creates a viewpoint at the rig's first camera, with the cameras' common centre of attention as the target.
    #[must_use]
    pub fn new(rig: &Rig) -> Self {
        let mut navigation = Self {
            up: rig.world_up.try_normalize().unwrap_or(DVec3::Z),
            target: rig.center_of_attention(),
            distance: 3.0,
            heading: 0.0,
            elevation: 0.1,
            field: FIELD,
            farthest: *DISTANCE_M.end(),
            followed: None,
        };
        let reach = |camera: &Camera| camera.position().distance(navigation.target);
        let farthest = rig.cameras.iter().map(reach).fold(0.0, f64::max);
        navigation.farthest = (FARTHEST_SHARE * farthest).clamp(LEAST_FARTHEST_M, *DISTANCE_M.end());
        if let Some(camera) = rig.cameras.first() {
            navigation.stand_at(camera.position());
        }
        navigation
    }

    /// Returns two horizontal axes that headings are measured from.
    fn axes(&self) -> (DVec3, DVec3) {
        let x = if self.up.cross(DVec3::X).length() > 0.1 { DVec3::X } else { DVec3::Y };
        let x = (x - self.up * x.dot(self.up)).normalize();
        (x, self.up.cross(x))
    }

    /// Moves the eye to a point; the target stays.
    fn stand_at(&mut self, eye: DVec3) {
        let (x, y) = self.axes();
        let arm = eye - self.target;
        self.distance = arm.length().clamp(*DISTANCE_M.start(), self.farthest);
        self.heading = arm.dot(y).atan2(arm.dot(x));
        let most = std::f64::consts::FRAC_PI_2 - FROM_POLE;
        self.elevation = (arm.dot(self.up) / arm.length().max(1e-9)).clamp(-1.0, 1.0).asin().clamp(-most, most);
    }

    /// Returns the vector from target to eye, metres.
    fn arm(&self) -> DVec3 {
        let (x, y) = self.axes();
        let level = x * self.heading.cos() + y * self.heading.sin();
        (level * self.elevation.cos() + self.up * self.elevation.sin()) * self.distance
    }

    /// Returns the distance to the target, metres.
    #[must_use]
    pub fn distance(&self) -> f64 {
        self.distance
    }

    /// Turns around the target, radians.
    pub fn orbit(&mut self, right: f64, down: f64) {
        let most = std::f64::consts::FRAC_PI_2 - FROM_POLE;
        self.heading = (self.heading - right) % std::f64::consts::TAU;
        self.elevation = (self.elevation + down).clamp(-most, most);
    }

    /// Divides the distance to the target by a factor, at most 2.5 at a time, within limits of the rig.
    pub fn zoom(&mut self, factor: f64) {
        if factor.is_finite() && factor > 0.0 {
            let factor = factor.clamp(1.0 / MOST_ZOOM, MOST_ZOOM);
            self.distance = (self.distance / factor).clamp(*DISTANCE_M.start(), self.farthest);
        }
    }

    /// Moves the target to a point, metres, and the eye along with it.
    pub fn look_at(&mut self, place: DVec3) {
        if place.is_finite() {
            self.target = place;
            self.followed = None;
        }
    }

    /// Moves eye and target along the view's axes, metres.
    pub fn fly(&mut self, right: f64, up: f64, forward: f64) {
        let ahead = -self.arm().normalize();
        let aside = ahead.cross(self.up).normalize();
        self.target += aside * right + aside.cross(ahead) * up + ahead * forward;
    }

    /// Shifts the view by fractions of its height, so that the target follows the pointer (in a view that is not narrow).
    pub fn shift(&mut self, right: f64, down: f64) {
        let height = 2.0 * self.distance * (0.5 * self.field).tan();
        self.fly(-right * height, down * height, 0.0);
    }

    /// Moves along with a person at `place`, world, metres; the viewer's own shift stays. `None` ends following.
    pub fn follow(&mut self, place: Option<DVec3>) {
        if let (Some(before), Some(now)) = (self.followed, place.filter(|place| place.is_finite())) {
            self.target += now - before;
        }
        self.followed = place;
    }

    /// Jumps to a camera of the rig: its position, its field of view, and as the target the point of its optical axis nearest to the old
    /// one.
    pub fn jump(&mut self, camera: &Camera) {
        let eye = camera.position();
        let ahead = camera.camera_from_world.rotation.inverse() * DVec3::Z;
        let reach = (self.target - eye).dot(ahead).clamp(0.5, self.farthest);
        self.target = eye + ahead * reach;
        self.stand_at(eye);
        let lens = &camera.intrinsics;
        self.field = 2.0 * (0.5 * f64::from(lens.height) / lens.focal_px.y).atan();
    }

    /// Returns the camera of an image of this size, pixels.
    #[must_use]
    pub fn camera(&self, width: u32, height: u32) -> Camera {
        let shown = f64::from(height).min(f64::from(width) / LEAST_ASPECT);
        let focal = 0.5 * shown / (0.5 * self.field).tan();
        Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: "view".into(),
            intrinsics: Intrinsics::pinhole(width, height, focal),
            camera_from_world: Isometry::look_at(self.target + self.arm(), self.target, self.up),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use glam::DVec2;

    use super::*;

    fn rig() -> Rig {
        let camera = |eye: DVec3| Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: format!("{eye}").into(),
            intrinsics: Intrinsics::pinhole(640, 480, 500.0),
            camera_from_world: Isometry::look_at(eye, DVec3::new(0.2, 0.1, 1.0), DVec3::Z),
        };
        let eyes = [DVec3::new(3.0, 0.0, 1.2), DVec3::new(0.0, 3.0, 1.0), DVec3::new(-2.0, -2.0, 3.4)];
        Rig { cameras: eyes.into_iter().map(camera).collect(), world_up: DVec3::Z }
    }

    #[test]
    fn it_starts_at_the_first_camera_and_jumps_to_any() {
        let rig = rig();
        let mut navigation = Navigation::new(&rig);
        for camera in &rig.cameras {
            let view = navigation.camera(640, 480);
            if camera.id == rig.cameras[0].id {
                assert!(view.position().distance(camera.position()) < 1e-3, "{}", view.position());
            }
            navigation.jump(camera);
            let view = navigation.camera(640, 480);
            view.validate().unwrap();
            // The same image: place, direction and field of view.
            for point in [DVec3::new(0.2, 0.1, 1.0), DVec3::new(0.5, 0.0, 1.5)] {
                let (a, b) = (camera.project(point).unwrap(), view.project(point).unwrap());
                assert!(a.distance(b) < 0.5, "{a} {b}");
            }
        }
    }

    #[test]
    fn dragging_keeps_the_target_under_the_pointer() {
        let mut navigation = Navigation::new(&rig());
        let target = navigation.target;
        navigation.shift(0.25, -0.1);
        let pixel = navigation.camera(640, 480).project(target).unwrap();
        assert!((pixel - DVec2::new(319.5 + 0.25 * 480.0, 239.5 - 0.1 * 480.0)).length() < 1.0, "{pixel}");
    }

    #[test]
    fn following_keeps_the_view_of_the_person() {
        let mut navigation = Navigation::new(&rig());
        navigation.shift(0.1, 0.1);
        let person = DVec3::new(0.3, 0.2, 0.9);
        navigation.follow(Some(person));
        let before = navigation.camera(640, 480).project(person).unwrap();
        let moved = person + DVec3::new(0.5, -0.4, 0.1);
        navigation.follow(Some(moved));
        assert!(navigation.camera(640, 480).project(moved).unwrap().distance(before) < 1e-6);
        // Who is lost and found elsewhere does not drag the view along.
        navigation.follow(None);
        let view = navigation.camera(640, 480);
        navigation.follow(Some(DVec3::splat(100.0)));
        assert_eq!(navigation.camera(640, 480), view);
    }

    #[test]
    fn zooming_keeps_the_person_in_sight() {
        let rig = rig();
        let mut navigation = Navigation::new(&rig);
        let start = navigation.distance();
        navigation.zoom((-15.0f64).exp());
        assert!(navigation.distance() <= MOST_ZOOM * start + 1e-9);
        for _ in 0..10_000 {
            navigation.zoom(0.5);
        }
        // 1.8 m are at least a twelfth of the view's height.
        let focal = navigation.camera(640, 480).intrinsics.focal_px.y;
        assert!(1.8 * focal / navigation.distance() > 480.0 / 12.0, "{}", navigation.distance());
        for _ in 0..10_000 {
            navigation.zoom(2.0);
        }
        assert!((navigation.distance() - DISTANCE_M.start()).abs() < 1e-9);
        // A telephone that is held upright shows as much to both sides as a wider one.
        let side = |width: u32| f64::from(width) / navigation.camera(width, 800).intrinsics.focal_px.x;
        assert!((side(400) - side(560)).abs() < 1e-9 && side(800) > side(560));
        navigation.look_at(DVec3::new(1.0, 2.0, 0.5));
        navigation.look_at(DVec3::NAN);
        let pixel = navigation.camera(640, 480).project(DVec3::new(1.0, 2.0, 0.5)).unwrap();
        assert!(pixel.distance(DVec2::new(319.5, 239.5)) < 0.1, "{pixel}");
    }

    #[test]
    fn no_input_breaks_the_camera() {
        let mut navigation = Navigation::new(&Rig { cameras: Vec::new(), world_up: DVec3::ZERO });
        for by in [1e9, -1e9, 0.3] {
            navigation.orbit(by, by);
            navigation.zoom(by);
            navigation.zoom(f64::NAN);
            navigation.follow(Some(DVec3::NAN));
            navigation.camera(64, 48).validate().unwrap();
        }
    }
}

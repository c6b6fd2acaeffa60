//! State of one page.

use std::{fmt, sync::Arc};

use flyrig_stream::{Posed, PosedAxes, StreamError, StreamTemplate};
use flyrig_types::{Camera, Rig};
use flyrig_viewing::{Ellipsoids, Floor, Ingested, Navigation, People};
use glam::DVec3;

use crate::order::DrawOrder;

/// Longest message, bytes; templates are shorter.
pub const MAX_MESSAGE_BYTES: usize = 16 << 20;
/// Number of floats of a camera: `camera_from_world` by columns, then focal length and principal point, pixels.
pub const CAMERA_FLOATS: usize = 19;

/// Kind of a message of the page, by its first byte.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PageMessageKind {
    /// Cameras and up direction of the rig, JSON.
    Rig,
    /// Template of a person.
    Template,
    /// Motion of a person.
    Motion,
    /// Layer of a person's colours.
    Colors,
}

impl PageMessageKind {
    /// Returns the kind of a number.
    #[must_use]
    pub fn of(number: u32) -> Option<Self> {
        [Self::Rig, Self::Template, Self::Motion, Self::Colors].get(number as usize).copied()
    }
}

/// Error of a message that was refused.
#[derive(Debug, PartialEq)]
pub enum PageError {
    /// Damaged bytes.
    Stream(StreamError),
    /// Invalid calibration of the rig.
    Rig(String),
}

impl fmt::Display for PageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stream(error) => error.fmt(f),
            Self::Rig(problem) => write!(f, "the rig's calibration is damaged: {problem}"),
        }
    }
}

/// State of the page: people, viewpoint, and the Gaussians as shown now.
#[derive(Debug, Default)]
pub struct Page {
    people: People,
    rig: Option<Rig>,
    navigation: Option<Navigation>,
    floor: Option<Floor>,
    follows: bool,
    /// Person to follow; the first shown where there is none of this number.
    chosen: Option<u32>,
    centers: Vec<[f32; 4]>,
    normals: Vec<[f32; 4]>,
    colors: Vec<[f32; 4]>,
    /// Number, hash of the motion and count of colour messages of each person shown.
    shown: Vec<(u32, u64, u64)>,
    /// Whether a person has a new template, or was forgotten.
    is_stale: bool,
    /// Root of each person shown, metres, world.
    places: Vec<DVec3>,
    /// Frame number of the first person's motion on the rig.
    frame: u64,
    /// Capture time of the newest motion shown, seconds of the rig's clock.
    capture_secs: f64,
    posed: Posed,
    axes: PosedAxes,
    /// Shapes of the Gaussians; empty without an avatar.
    ellipsoids: Ellipsoids,
    order: DrawOrder,
    camera: [f32; CAMERA_FLOATS],
}

impl Page {
    /// Ingests a message that arrived at `now`. Messages of a person whose template is missing wait for it.
    ///
    /// # Errors
    /// [`PageError`] for damaged bytes; the state is then unchanged.
    pub fn ingest(&mut self, kind: PageMessageKind, person: u32, bytes: &[u8], now: f64) -> Result<(), PageError> {
        match kind {
            PageMessageKind::Rig => return self.ingest_rig(bytes),
            PageMessageKind::Template => {
                let template = StreamTemplate::decode(bytes).map_err(PageError::Stream)?;
                self.people.set_template(person, Arc::new(template));
                self.is_stale = true;
            }
            PageMessageKind::Motion | PageMessageKind::Colors => {
                let is_motion = kind == PageMessageKind::Motion;
                let ingested: Result<Ingested, StreamError> = self.people.ingest(person, is_motion, bytes, now);
                ingested.map_err(PageError::Stream)?;
            }
        }
        Ok(())
    }

    fn ingest_rig(&mut self, bytes: &[u8]) -> Result<(), PageError> {
        let rig: Rig = serde_json::from_slice(bytes).map_err(|error| PageError::Rig(error.to_string()))?;
        rig.validate().map_err(|error| PageError::Rig(error.to_string()))?;
        if self.rig.as_ref() != Some(&rig) {
            self.navigation = Some(Navigation::new(&rig));
            self.floor = Some(Floor::new(&rig));
            self.rig = Some(rig);
            // The people who came before it stand on its floor.
            self.is_stale = true;
        }
        Ok(())
    }

    /// Forgets all people, for a rig that restarted; the viewpoint stays.
    pub fn forget_people(&mut self) {
        self.people.clear();
        self.is_stale = true;
        if let Some(floor) = &mut self.floor {
            floor.clear();
        }
    }

    /// Poses all people as shown at `now`. Returns whether centres, and whether colours, have changed.
    pub fn pose(&mut self, now: f64, interpolate: bool) -> (bool, bool) {
        let numbers: Vec<u32> = self.people.iter().map(|(number, _)| number).collect();
        let mut motions = Vec::new();
        for number in numbers {
            let Some(person) = self.people.get(number) else { continue };
            if let Some(motion) = person.motion_at(now, interpolate) {
                // Interpolated motions share a frame number; the hash differs.
                // Another template with as many messages of colours has other colours.
                let colors = person.color_changes().wrapping_add(person.template().hash);
                let key = (number, motion_key(&motion), colors);
                motions.push((key, motion));
            }
        }
        let shown: Vec<(u32, u64, u64)> = motions.iter().map(|(key, _)| *key).collect();
        self.places.clear();
        self.places.extend(motions.iter().map(|(_, motion)| DVec3::from(motion.root_translation.map(f64::from))));
        let chosen = shown.iter().position(|(number, ..)| Some(*number) == self.chosen).unwrap_or(0);
        if self.follows
            && let (Some(navigation), Some(place)) = (&mut self.navigation, self.places.get(chosen))
        {
            navigation.follow(Some(*place));
        }
        let newest = motions.iter().map(|(_, motion)| motion.stamp.capture_nanos).max();
        self.capture_secs = newest.map_or(0.0, |nanos| nanos as f64 / 1e9);
        let is_stale = std::mem::take(&mut self.is_stale);
        if shown == self.shown && !is_stale {
            return (false, false);
        }
        let same = |part: fn(&(u32, u64, u64)) -> (u32, u64)| {
            !is_stale
                && shown.len() == self.shown.len()
                && shown.iter().zip(&self.shown).all(|(a, b)| part(a) == part(b))
        };
        let (moved, mut recolored) = (!same(|key| (key.0, key.1)), !same(|key| (key.0, key.2)));
        for list in [&mut self.centers, &mut self.normals, &mut self.colors] {
            list.clear();
        }
        self.ellipsoids.clear();
        let has_axes = |number: u32| self.people.get(number).is_some_and(|person| person.template().has_axes());
        let has_avatar = motions.iter().any(|((number, ..), _)| has_axes(*number));
        for ((number, ..), motion) in &motions {
            let Some(person) = self.people.get_mut(*number) else { continue };
            let colors = person.pose(motion, &mut self.posed);
            // The light changes an avatar's colours in each pose.
            recolored |= moved && person.template().has_colors();
            let count = self.posed.center_scale.len().min(colors.len());
            self.centers.extend_from_slice(&self.posed.center_scale[..count]);
            self.normals.extend_from_slice(&self.posed.normal[..count]);
            self.colors.extend_from_slice(&colors[..count]);
            if has_avatar {
                let axes = person.pose_axes(motion, &self.posed, &mut self.axes).then_some(&self.axes);
                self.ellipsoids.push(&self.posed.center_scale[..count], &colors[..count], axes);
            }
        }
        if let Some(floor) = self.floor.as_mut().filter(|_| moved && !self.centers.is_empty()) {
            floor.update(&self.centers);
        }
        self.frame = motions.first().map_or(0, |(_, motion)| motion.stamp.frame);
        self.shown = shown;
        (moved, recolored)
    }

    /// Returns the indices of the Gaussians to draw into an image of this size, farthest first; empty before the rig is known.
    pub fn order(&mut self, width: u32, height: u32) -> &[u32] {
        let Some(camera) = self.look(width, height) else { return &[] };
        if self.ellipsoids.is_empty() {
            return self.order.sort(&camera, &self.centers, &self.normals);
        }
        let seen = self.ellipsoids.seen();
        self.order.sort_shown(&camera, &self.centers, |index, _| seen.get(index).is_some_and(|shape| shape[3] > 0.0))
    }

    /// Returns the camera for an image of this size, and keeps its numbers ([`Self::camera`]) and the shapes that it sees
    /// ([`Self::scales`]); `None` before the rig is known.
    pub fn look(&mut self, width: u32, height: u32) -> Option<Camera> {
        let navigation = self.navigation.as_ref()?;
        let camera = navigation.camera(width.clamp(1, 16_384), height.clamp(1, 16_384));
        let from_world = camera.camera_from_world;
        let matrix = glam::DMat4::from_rotation_translation(from_world.rotation, from_world.translation);
        for (to, from) in self.camera.iter_mut().zip(matrix.to_cols_array()) {
            *to = from as f32;
        }
        let lens = &camera.intrinsics;
        let rest = [lens.focal_px.x, lens.center_px.x, lens.center_px.y];
        for (to, from) in self.camera[16..].iter_mut().zip(rest) {
            *to = from as f32;
        }
        self.ellipsoids.seen_from(camera.position().as_vec3(), &self.centers, &self.normals);
        Some(camera)
    }

    /// Returns the camera of the last [`Self::look`] or [`Self::order`].
    #[must_use]
    pub fn camera(&self) -> &[f32; CAMERA_FLOATS] {
        &self.camera
    }

    /// Returns centre and standard deviation of each Gaussian, metres, world.
    #[must_use]
    pub fn centers(&self) -> &[[f32; 4]] {
        &self.centers
    }

    /// Returns the unit normal of each Gaussian's surface, world; w: depth below the surface, metres.
    #[must_use]
    pub fn normals(&self) -> &[[f32; 4]] {
        &self.normals
    }

    /// Returns linear RGB and opacity of each Gaussian.
    #[must_use]
    pub fn colors(&self) -> &[[f32; 4]] {
        &self.colors
    }

    /// Returns the standard deviations along the axes of each Gaussian, metres, and its opacity, 0 for one that faces away from the camera
    /// of the last [`Self::look`] or [`Self::order`]; empty without an avatar.
    #[must_use]
    pub fn scales(&self) -> &[[f32; 4]] {
        self.ellipsoids.seen()
    }

    /// Returns the unit quaternion x, y, z, w of each Gaussian, world from its axes; empty without an avatar, when all Gaussians are
    /// isotropic.
    #[must_use]
    pub fn rotations(&self) -> &[[f32; 4]] {
        self.ellipsoids.rotations()
    }

    /// Returns the floor, once the rig is known.
    #[must_use]
    pub fn floor(&self) -> Option<&Floor> {
        self.floor.as_ref()
    }

    /// Returns the capture time of the newest motion shown, seconds of the rig's clock; 0 without people.
    #[must_use]
    pub fn capture_secs(&self) -> f64 {
        self.capture_secs
    }

    /// Returns the number of the person that is shown as the `index`th; `None` beyond them.
    #[must_use]
    pub fn person(&self, index: usize) -> Option<u32> {
        self.shown.get(index).map(|(number, ..)| *number)
    }

    /// Turns the view to a person, who is followed where [`Self::set_follows`] says so; a person who is not shown changes nothing.
    pub fn choose(&mut self, person: u32) {
        let index = self.shown.iter().position(|(number, ..)| *number == person);
        if let (Some(place), Some(navigation)) = (index.and_then(|index| self.places.get(index)), &mut self.navigation)
        {
            self.chosen = Some(person);
            navigation.look_at(*place);
        }
    }

    /// Returns to the viewpoint of the start.
    pub fn reset(&mut self) {
        self.navigation = self.rig.as_ref().map(Navigation::new);
        self.chosen = None;
    }

    /// Returns the viewpoint, once the rig is known.
    pub fn navigation(&mut self) -> Option<&mut Navigation> {
        self.navigation.as_mut()
    }

    /// Sets whether the viewpoint moves along with the chosen person, or the first.
    pub fn set_follows(&mut self, follows: bool) {
        self.follows = follows;
        if !follows && let Some(navigation) = &mut self.navigation {
            navigation.follow(None);
        }
    }

    /// Moves the viewpoint to a camera of the rig; a number beyond the cameras changes nothing.
    pub fn jump(&mut self, camera: usize) {
        let camera = self.rig.as_ref().and_then(|rig| rig.cameras.get(camera));
        if let (Some(camera), Some(navigation)) = (camera, &mut self.navigation) {
            navigation.jump(camera);
        }
    }

    /// Returns the number of people shown.
    #[must_use]
    pub fn people_shown(&self) -> usize {
        self.shown.len()
    }

    /// Returns the rig's frame number of the first person shown.
    #[must_use]
    pub fn frame(&self) -> u64 {
        self.frame
    }

    /// Returns whether all known people have all of their colours; false without people.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        !self.people.is_empty() && self.people.iter().all(|(_, person)| person.is_complete())
    }
}

/// Returns a number that differs where motions differ.
fn motion_key(motion: &flyrig_stream::Motion) -> u64 {
    // Interpolated motions of one pair share the stamp; the root and one rotation separate them.
    let numbers = motion
        .root_translation
        .iter()
        .chain(motion.joint_rotations.iter().flatten())
        .chain(motion.nodes.iter().flatten());
    let hash = numbers.fold(motion.stamp.frame, |hash, number| {
        (hash ^ u64::from(number.to_bits())).wrapping_mul(0x0000_0100_0000_01b3).rotate_left(5)
    });
    hash ^ motion.stamp.template
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "page_tests.rs"]
mod tests;

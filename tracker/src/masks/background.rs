//! The background of one camera: a plate that follows the room, or a screen of one colour.

use std::fmt;

use flyrig_types::{Camera, Image, Mask};

use crate::gate::BodyGate;
use crate::grid::Grid;
use crate::key::{KeyColor, Screen};
use crate::pixels::Rgb;
use crate::plate::{Drift, NO_EVIDENCE, floats, gated_mask, plate_evidence};
use crate::{TrackError, TrackErrorKind};

/// Share of the image away from people that differs from the plate when the whole room has changed.
const ALL_CHANGED: f32 = 0.4;
/// Share of the image away from people below which it says nothing about the room.
const LEAST_AWAY: f32 = 0.2;
/// Updates in which a pixel keeps its colour before it is known.
const STEADY_UPDATES: u8 = 8;
/// A change of a channel from update to update that is not noise, sRGB steps.
const STEADY: f32 = 14.0;
/// Updates in which a pixel away from people differs from the plate before it is relearnt.
const DIFFERENT_UPDATES: u8 = 15;
/// Share of the difference that the plate takes over in an update.
const FOLLOW: f32 = 1.0 / 16.0;
/// Distance from body and mask, in the gate's unit, from which a pixel in a person's reach is likely to show background.
const CLEAR: f32 = 0.4;
/// Such pixels are learnt in one of so many updates: a part of the person that the mask misses has time to move.
const CLEAR_EVERY: u32 = 4;
/// Share of the background around the body that has to be known for a mask from it and the body alone.
pub(crate) const MOSTLY_KNOWN: f64 = 0.7;
/// Updates in which a background that is being learnt asks for every image.
const EAGER_UPDATES: u32 = 60;
/// Share of the image that differs where nobody stands from which it is reported.
const REPORTED: f32 = 0.003;
/// Share of the pixels away from people that have to be known again after a change.
const RECOVERED: f32 = 0.7;
/// Farthest shift of a plate that is looked for, pixels, and the least that is reported.
const FAR_SHIFT: i64 = 8;
const LEAST_SHIFT: i64 = 2;
/// A shift has to explain this share of the plate's difference.
const SHIFT_GAIN: f64 = 0.6;
/// Contrast of a plate's brightness over four pixels at the places that show a shift, sRGB steps, and their least number.
const SHIFT_EDGE: f32 = 14.0;
const SHIFT_SAMPLES: usize = 120;

/// A change of a background that its owner should know.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum BackgroundEvent {
    /// The image differs from the plate in this share of what shows nobody, 0..=1; the plate is not used until it is
    /// relearnt.
    Changed(f64),
    /// The plate is in use again.
    Recovered,
    /// The image is shifted against the plate by so many pixels (x, y).
    Shifted(i64, i64),
    /// This share of the image, around a pixel, differs from the plate although nobody is tracked there.
    Differs(f64, [u32; 2]),
}

impl fmt::Display for BackgroundEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Changed(share) => write!(
                f,
                "{:.0} % of the background differs from the plate (lights switched, or a plate of another scene); masks do \
                 without the plate until the background has been relearnt, where nobody stands",
                100.0 * share
            ),
            Self::Recovered => f.write_str("the background has been relearnt and is in use again"),
            Self::Shifted(x, y) => write!(
                f,
                "the image is shifted by {x}, {y} pixels against the plate: the camera was moved; calibrate again and \
                 record new plates (`flyrig plate`); until then masks learn the background where nobody stands"
            ),
            Self::Differs(share, [x, y]) => write!(
                f,
                "{:.1} % of the image around pixel {x}, {y} differ from the plate where nobody is tracked: something was moved, \
                 or somebody stood in the plate; it is being relearnt; recording the plate again (`flyrig plate`) is more accurate",
                100.0 * share
            ),
        }
    }
}

/// Background of one camera, as far as it is known.
#[derive(Debug, Clone)]
pub struct Background {
    width: usize,
    height: usize,
    kind: Kind,
}

#[derive(Debug, Clone)]
enum Kind {
    Plate(Plate),
    Key(KeyColor),
}

/// An image of the empty scene that is kept up to date.
#[derive(Debug, Clone)]
pub(crate) struct Plate {
    /// sRGB values, three a pixel.
    values: Vec<f32>,
    /// Updates in which a pixel kept its colour, up to [`STEADY_UPDATES`]: from there on it is known.
    steady: Vec<u8>,
    /// Updates in which a known pixel differed from the plate.
    different: Vec<u8>,
    /// Whether the plate is relearnt after the whole room changed.
    renewing: bool,
    /// Whether a shift was looked for, and a difference reported.
    compared: bool,
    reported: bool,
    /// Updates since the start, or since everything was forgotten.
    updates: u32,
}

/// Where a person may be in an image.
#[derive(Debug, Clone)]
pub struct PersonArea<'a> {
    /// Reach of the posed body.
    pub gate: BodyGate,
    /// The person's mask; without one nothing in the body's reach is learnt.
    pub mask: Option<&'a Mask>,
}

/// Possible content of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Shows {
    /// Nobody reaches it.
    Background,
    /// In somebody's reach, but away from body and mask.
    LikelyBackground,
    /// On a person, or close by.
    Person,
}

impl Background {
    /// Starts from an image of the empty scene.
    ///
    /// # Errors
    /// Kind `Image` names the camera when the size is not that of its calibration or the format cannot be read.
    pub fn from_plate(camera: &Camera, plate: &Image) -> Result<Self, TrackError> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        if (plate.width(), plate.height()) != (width, height) {
            return Err(TrackError::new(
                TrackErrorKind::Image,
                format!(
                    "camera {}: the plate is {}x{} pixels but the camera's calibration is for {width}x{height}; record the \
                     plate again with the camera's own settings (`flyrig plate`), or remove it",
                    camera.id,
                    plate.width(),
                    plate.height()
                ),
            ));
        }
        let picture = Rgb::new(plate)?;
        let plate = Plate {
            values: floats(&picture),
            steady: vec![STEADY_UPDATES; picture.width * picture.height],
            ..Plate::unknown(picture.width, picture.height)
        };
        let plate = Plate { compared: false, updates: EAGER_UPDATES, ..plate };
        Ok(Self { width: picture.width, height: picture.height, kind: Kind::Plate(plate) })
    }

    /// Starts with nothing known of what `camera` sees: [`Self::update`] learns it where nobody stands.
    #[must_use]
    pub fn unknown(camera: &Camera) -> Self {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        Self { width, height, kind: Kind::Plate(Plate::unknown(width, height)) }
    }

    /// Whether much is to be learnt: the next image is worth an update.
    #[must_use]
    pub fn is_learning(&self) -> bool {
        matches!(&self.kind, Kind::Plate(plate) if plate.updates < EAGER_UPDATES)
    }

    /// A screen of one colour behind the people that `camera` sees.
    #[must_use]
    pub fn from_key(camera: &Camera, key: KeyColor) -> Self {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        Self { width, height, kind: Kind::Key(key) }
    }

    /// Returns the background after the camera was moved: from `plate`, the empty scene as the camera sees it now, else with nothing
    /// known. A screen of one colour stays one.
    ///
    /// # Errors
    /// Those of [`Self::from_plate`].
    pub fn after_move(&self, camera: &Camera, plate: Option<&Image>) -> Result<Self, TrackError> {
        match (&self.kind, plate) {
            (Kind::Key(_), _) => Ok(self.clone()),
            (Kind::Plate(_), Some(plate)) => Self::from_plate(camera, plate),
            (Kind::Plate(_), None) => Ok(Self::unknown(camera)),
        }
    }

    /// Returns the person's mask from this background and the posed body alone; `None` when nothing stands out near the body
    /// or the image has another size.
    ///
    /// # Errors
    /// Kind `Image` when the format cannot be read.
    pub fn mask(&self, image: &Image, gate: &BodyGate) -> Result<Option<Mask>, TrackError> {
        let picture = Rgb::new(image)?;
        let light = self.light(&picture, &|at| !gate.reaches_pixel(at));
        let evidence = light.and_then(|light| light.evidence(&picture, gate.bounds));
        Ok(evidence.and_then(|evidence| gated_mask(&evidence, gate)))
    }

    /// Takes in an image in which nobody stands but `people`: the background follows slow changes of the light and is relearnt
    /// after sudden ones. Returns what its owner should know, each once.
    ///
    /// # Errors
    /// Kind `Image` when the format cannot be read. Images of another size change nothing.
    pub fn update(&mut self, image: &Image, people: &[PersonArea<'_>]) -> Result<Vec<BackgroundEvent>, TrackError> {
        let picture = Rgb::new(image)?;
        match &mut self.kind {
            Kind::Plate(plate) if self.width == picture.width && self.height == picture.height => {
                Ok(plate.update(&picture, people))
            }
            _ => Ok(Vec::new()),
        }
    }

    /// Returns the background's light in an image's exposure, which is measured where `is_background`; `None` for an image
    /// of another size or without the screen.
    pub(crate) fn light<'a>(
        &'a self,
        picture: &Rgb,
        is_background: &dyn Fn(usize) -> bool,
    ) -> Option<BackgroundLight<'a>> {
        if (picture.width, picture.height) != (self.width, self.height) {
            return None;
        }
        match &self.kind {
            Kind::Key(key) => key.screen(picture).map(|screen| BackgroundLight::Screen(key, screen)),
            Kind::Plate(plate) => {
                let drift = Drift::new(picture, &plate.values, &|at| plate.knows(at) && is_background(at));
                Some(BackgroundLight::Plate(plate, drift))
            }
        }
    }

    /// The colour of the screen, where the background is one.
    pub(crate) fn key(&self) -> Option<&KeyColor> {
        match &self.kind {
            Kind::Key(key) => Some(key),
            Kind::Plate(_) => None,
        }
    }
}

/// The background in the exposure of an image.
pub(crate) enum BackgroundLight<'a> {
    Plate(&'a Plate, Drift),
    Screen(&'a KeyColor, Screen),
}

impl BackgroundLight<'_> {
    /// Returns per-pixel evidence for a foreground inside of `bounds` (x0, y0, x1, y1, ends excluded) of the image that this
    /// was made for, 0..=1 with the border at one half; `None` while nothing is known there.
    pub fn evidence(&self, picture: &Rgb, bounds: [usize; 4]) -> Option<Grid> {
        let (plate, drift) = match self {
            Self::Screen(key, screen) => return Some(key.evidence(picture, screen, bounds)),
            Self::Plate(plate, drift) => (plate, drift),
        };
        let mut evidence = plate_evidence(picture, &plate.values, drift, bounds)?;
        let mut known = 0;
        let rows = evidence.values.chunks_exact_mut((bounds[2] - bounds[0]).max(1));
        for (y, row) in (bounds[1]..).zip(rows) {
            for (x, value) in (bounds[0]..).zip(row) {
                if plate.knows(y * picture.width + x) {
                    known += 1;
                } else {
                    *value = NO_EVIDENCE;
                }
            }
        }
        (known > 0).then_some(evidence)
    }

    /// Share of `bounds` where the background is known, 0..=1.
    pub fn known_share(&self, width: usize, bounds: [usize; 4]) -> f64 {
        let Self::Plate(plate, _) = self else { return 1.0 };
        let [x0, y0, x1, y1] = bounds;
        let known = (y0..y1).map(|y| (x0..x1).filter(|x| plate.knows(y * width + x)).count()).sum::<usize>();
        known as f64 / ((x1 - x0) * (y1 - y0)).max(1) as f64
    }

    /// Returns the linear light of a pixel; `None` where the background is not known.
    pub fn at(&self, pixel: usize) -> Option<[f32; 3]> {
        match self {
            Self::Screen(_, screen) => Some(screen.at(pixel)),
            Self::Plate(plate, drift) => {
                let light = |k: usize| crate::light::linear(drift.gain[k] * plate.values[3 * pixel + k]);
                plate.knows(pixel).then(|| std::array::from_fn(light))
            }
        }
    }
}

impl Plate {
    fn unknown(width: usize, height: usize) -> Self {
        Self {
            values: vec![0.0; 3 * width * height],
            steady: vec![0; width * height],
            different: vec![0; width * height],
            renewing: false,
            compared: true,
            reported: false,
            updates: 0,
        }
    }

    fn knows(&self, pixel: usize) -> bool {
        self.steady[pixel] >= STEADY_UPDATES
    }

    fn update(&mut self, picture: &Rgb, people: &[PersonArea<'_>]) -> Vec<BackgroundEvent> {
        let mut events = Vec::new();
        let width = picture.width;
        self.updates = self.updates.saturating_add(1);
        let learns_near = self.updates.is_multiple_of(CLEAR_EVERY);
        let shows = classify(picture, people, learns_near);
        let away: Vec<bool> = shows.iter().map(|shows| *shows == Shows::Background).collect();
        let away_count = away.iter().filter(|away| **away).count();
        if !self.compared {
            self.compared = true;
            if let Some([x, y]) = self.shift(picture, &away) {
                self.forget();
                events.push(BackgroundEvent::Shifted(x, y));
            }
        }
        let drift = Drift::new(picture, &self.values, &|at| away[at] && self.knows(at));
        let evidence = plate_evidence(picture, &self.values, &drift, [0, 0, width, picture.height]);
        let Some(evidence) = evidence else { return events };
        let known = (0..away.len()).filter(|&at| away[at] && self.knows(at)).count();
        let differs = |at: usize| away[at] && self.knows(at) && evidence.values[at] >= 0.5;
        let different = (0..away.len()).filter(|&at| differs(at)).count();
        let enough = known as f32 > LEAST_AWAY * away.len() as f32;
        if enough && different as f32 > ALL_CHANGED * known as f32 {
            self.forget();
            events.push(BackgroundEvent::Changed(different as f64 / known as f64));
        }
        let (mut old, mut center) = (0usize, [0usize; 2]);
        for at in (0..shows.len()).filter(|&at| shows[at] != Shows::Person) {
            let now: [f32; 3] = std::array::from_fn(|k| f32::from(picture.bytes[3 * at + k]));
            if !self.knows(at) {
                self.learn(at, now);
            } else if !away[at] {
                // Known well enough, and too near to somebody to be relearnt.
            } else if evidence.values[at] < 0.5 {
                self.different[at] = 0;
                let values = self.values[3 * at..3 * at + 3].iter_mut();
                for ((value, now), gain) in values.zip(now).zip(drift.gain) {
                    *value += FOLLOW * (now / gain - *value);
                }
            } else {
                self.different[at] += 1;
                if self.different[at] >= DIFFERENT_UPDATES {
                    (self.different[at], self.steady[at]) = (0, 0);
                    old += 1;
                    center = [center[0] + at % width, center[1] + at / width];
                }
            }
        }
        if old as f32 > REPORTED * away.len() as f32 && !self.reported {
            self.reported = true;
            let share = old as f64 / away.len() as f64;
            events.push(BackgroundEvent::Differs(share, center.map(|sum| (sum / old) as u32)));
        }
        let known = (0..away.len()).filter(|&at| away[at] && self.knows(at)).count();
        if self.renewing && known as f32 > RECOVERED * away_count.max(1) as f32 {
            self.renewing = false;
            events.push(BackgroundEvent::Recovered);
        }
        events
    }

    fn forget(&mut self) {
        self.steady.fill(0);
        self.different.fill(0);
        (self.renewing, self.updates) = (true, 0);
    }

    /// Adds a colour of a pixel that is not known: its mean is, once it has been steady.
    fn learn(&mut self, at: usize, now: [f32; 3]) {
        let run = self.steady[at];
        let value = &mut self.values[3 * at..3 * at + 3];
        if run == 0 || value.iter().zip(now).any(|(v, n)| (*v - n).abs() > STEADY) {
            value.copy_from_slice(&now);
            self.steady[at] = 1;
        } else {
            value.iter_mut().zip(now).for_each(|(v, n)| *v += (n - *v) / (f32::from(run) + 1.0));
            self.steady[at] = run + 1;
        }
    }

    /// Returns how far the image is shifted against the plate, where a shift explains most of their difference.
    fn shift(&self, picture: &Rgb, away: &[bool]) -> Option<[i64; 2]> {
        let (width, height) = (picture.width as i64, picture.height as i64);
        let first = |x: i64, y: i64| 3 * (y * width + x) as usize;
        let plate = |x: i64, y: i64| self.values[first(x, y)..first(x, y) + 3].iter().sum::<f32>() / 3.0;
        let now = |x: i64, y: i64| {
            let sum: u32 = picture.bytes[first(x, y)..first(x, y) + 3].iter().map(|c| u32::from(*c)).sum();
            sum as f32 / 3.0
        };
        let edge = |x: i64, y: i64| {
            let (across, down) = (plate(x + 2, y) - plate(x - 2, y), plate(x, y + 2) - plate(x, y - 2));
            across.abs().max(down.abs()) > SHIFT_EDGE
        };
        let margin = FAR_SHIFT + 2;
        let mut places = Vec::new();
        for y in (margin..height - margin).step_by(3) {
            let row = (margin..width - margin).step_by(3);
            places.extend(row.filter(|&x| away[(y * width + x) as usize] && edge(x, y)).map(|x| (x, y)));
        }
        if places.len() < SHIFT_SAMPLES {
            return None;
        }
        let difference = |dx: i64, dy: i64| {
            let of = |&(x, y): &(i64, i64)| f64::from((now(x + dx, y + dy) - plate(x, y)).abs()).min(60.0);
            places.iter().map(of).sum::<f64>()
        };
        let shifts = (-FAR_SHIFT..=FAR_SHIFT).flat_map(|dy| (-FAR_SHIFT..=FAR_SHIFT).map(move |dx| [dx, dy]));
        let best = shifts.map(|[dx, dy]| (difference(dx, dy), [dx, dy])).min_by(|a, b| a.0.total_cmp(&b.0))?;
        let far = best.1[0].abs().max(best.1[1].abs()) >= LEAST_SHIFT;
        (far && best.0 < SHIFT_GAIN * difference(0, 0)).then_some(best.1)
    }
}

/// Classifies every pixel of an image. With `separates_near`, pixels in somebody's reach but away from body and mask count as
/// [`Shows::LikelyBackground`]; without, as [`Shows::Person`].
fn classify(picture: &Rgb, people: &[PersonArea<'_>], separates_near: bool) -> Vec<Shows> {
    let mut shows = vec![Shows::Background; picture.width * picture.height];
    for PersonArea { gate, mask } in people {
        let [x0, y0, x1, y1] = gate.bounds;
        let own_size =
            |mask: &&Mask| (mask.width() as usize, mask.height() as usize) == (picture.width, picture.height);
        let mask = mask.filter(own_size).filter(|_| separates_near);
        let clear_px = CLEAR * gate.unit_px() as f32;
        let from_mask = mask.map(|mask| {
            let mut covered = Grid::new(x1 - x0, y1 - y0, 0.0);
            for (row, y) in covered.values.chunks_exact_mut((x1 - x0).max(1)).zip(y0..y1) {
                let coverage = &mask.coverage()[y * picture.width + x0..y * picture.width + x1];
                row.iter_mut().zip(coverage).for_each(|(covered, coverage)| *covered = f32::from(*coverage > 25));
            }
            covered.distance_to_set()
        });
        for y in y0..y1.min(picture.height) {
            for x in x0..x1.min(picture.width) {
                if !gate.reaches(x, y) {
                    continue;
                }
                let at = (y - y0) * gate.distance.width + x - x0;
                let is_clear = gate.distance.values[at] > CLEAR
                    && from_mask.as_ref().is_some_and(|distance| distance.values[at] > clear_px);
                let shown = &mut shows[y * picture.width + x];
                *shown = match (is_clear, *shown) {
                    (true, Shows::Background) => Shows::LikelyBackground,
                    (true, before) => before,
                    (false, _) => Shows::Person,
                };
            }
        }
    }
    shows
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry, Lens, PixelFormat};
    use glam::DVec2;
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    use super::*;

    const SIDE: usize = 96;

    fn camera() -> Camera {
        Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: "left".into(),
            intrinsics: Intrinsics {
                width: SIDE as u32,
                height: SIDE as u32,
                focal_px: DVec2::splat(90.0),
                center_px: DVec2::splat(47.5),
                lens: Lens::PINHOLE,
            },
            camera_from_world: Isometry::IDENTITY,
        }
    }

    fn picture(seed: u64, paint: impl Fn(i64, i64) -> [f64; 3]) -> Image {
        let mut rng = StdRng::seed_from_u64(seed);
        let mut noisy = |c: f64| (c + rng.random_range(-2.0..2.0)).clamp(0.0, 255.0) as u8;
        let bytes: Vec<u8> =
            (0..SIDE * SIDE).flat_map(|at| paint((at % SIDE) as i64, (at / SIDE) as i64)).map(&mut noisy).collect();
        Image::new(SIDE as u32, SIDE as u32, PixelFormat::Rgb8, bytes).unwrap()
    }

    /// A wall with posters.
    fn room(x: i64, y: i64) -> [f64; 3] {
        let poster = (x.div_euclid(11) * 7 + y.div_euclid(13) * 5).rem_euclid(4) as f64;
        [90.0 + 30.0 * poster, 70.0 + 26.0 * poster, 80.0 + 20.0 * poster]
    }

    fn dimmed(x: i64, y: i64) -> [f64; 3] {
        let [r, g, b] = room(x, y);
        [0.15 * r, 0.25 * g, 0.9 * b]
    }

    /// A gate around a body in the middle.
    fn gate() -> BodyGate {
        let mut body = Grid::new(SIDE, SIDE, 0.0);
        for y in 30..70 {
            body.values[y * SIDE + 42..y * SIDE + 54].fill(1.0);
        }
        BodyGate::of_grid(&body, 60.0)
    }

    fn area(gate: &BodyGate) -> PersonArea<'static> {
        PersonArea { gate: gate.clone(), mask: None }
    }

    fn evidence(background: &Background, now: &Image) -> Option<Grid> {
        let picture = Rgb::new(now).unwrap();
        background.light(&picture, &|_| true)?.evidence(&picture, [0, 0, SIDE, SIDE])
    }

    fn wrong(background: &Background, now: &Image) -> usize {
        let evidence = evidence(background, now).unwrap();
        evidence.values.iter().filter(|v| **v > 0.5).count()
    }

    #[test]
    fn a_switched_lamp_is_reported_once_and_the_room_is_learnt_anew() {
        let mut background = Background::from_plate(&camera(), &picture(1, room)).unwrap();
        let gate = gate();
        for seed in 2..6 {
            assert_eq!(background.update(&picture(seed, room), &[area(&gate)]).unwrap(), []);
        }
        let mut events = Vec::new();
        for seed in 10..30 {
            let now = picture(seed, dimmed);
            events.extend(background.update(&now, &[area(&gate)]).unwrap());
            if let Some(evidence) = evidence(&background, &now) {
                assert!(evidence.values.iter().all(|v| *v <= 0.5), "what is not known is no evidence");
            }
        }
        assert!(
            matches!(events[..], [BackgroundEvent::Changed(share), BackgroundEvent::Recovered] if share > 0.9),
            "{events:?}"
        );
        let now = picture(31, |x, y| if x < 12 { [250.0, 20.0, 20.0] } else { dimmed(x, y) });
        assert!((SIDE * 11..SIDE * 13).contains(&wrong(&background, &now)), "{}", wrong(&background, &now));
    }

    #[test]
    fn an_unknown_background_is_learnt_away_from_body_and_mask_and_never_on_them() {
        let mut background = Background::unknown(&camera());
        let gate = gate();
        // The person reaches beyond the body, and the mask shows it.
        let person = |x: i64, y: i64| (38..58).contains(&x) && (26..74).contains(&y);
        let now = |seed| picture(seed, |x, y| if person(x, y) { [10.0; 3] } else { room(x, y) });
        let coverage = (0..SIDE * SIDE).map(|at| 255 * u8::from(person((at % SIDE) as i64, (at / SIDE) as i64)));
        let mask = Mask::new(SIDE as u32, SIDE as u32, coverage.collect()).unwrap();
        let knows = |background: &Background, x: usize, y: usize| {
            let Kind::Plate(plate) = &background.kind else { panic!("a learnt background is a plate") };
            plate.knows(y * SIDE + x)
        };
        assert!(evidence(&background, &now(0)).is_none() && background.is_learning());
        for seed in 0..10 {
            let area = PersonArea { gate: gate.clone(), mask: Some(&mask) };
            assert_eq!(background.update(&now(seed), &[area]).unwrap(), []);
        }
        assert!(knows(&background, 2, 50) && !knows(&background, 64, 50), "far first");
        for seed in 10..50 {
            let area = PersonArea { gate: gate.clone(), mask: Some(&mask) };
            assert_eq!(background.update(&now(seed), &[area]).unwrap(), []);
        }
        assert!(knows(&background, 64, 50), "then what is clear of the mask");
        for (x, y) in [(48, 50), (39, 50), (48, 27), (57, 73)] {
            assert!(!knows(&background, x, y), "the person at {x}, {y}");
        }
        // Without a mask nothing in reach is learnt.
        let mut careful = Background::unknown(&camera());
        for seed in 0..60 {
            assert_eq!(careful.update(&now(seed), &[area(&gate)]).unwrap(), []);
        }
        assert!(knows(&careful, 2, 50) && !knows(&careful, 64, 50) && !careful.is_learning());
    }

    #[test]
    fn slow_light_and_white_balance_are_followed() {
        let mut background = Background::from_plate(&camera(), &picture(1, room)).unwrap();
        let gate = gate();
        for step in 0..60 {
            let warm = f64::from(step) / 60.0;
            let now = picture(step as u64, |x, y| {
                let lamp = 1.0 + 0.4 * warm * (x as f64 / SIDE as f64);
                std::array::from_fn(|k| room(x, y)[k] * lamp * [1.0 + 0.1 * warm, 1.0, 1.0 - 0.3 * warm][k])
            });
            assert_eq!(background.update(&now, &[area(&gate)]).unwrap(), [], "step {step}");
            assert!(wrong(&background, &now) < 40, "step {step}: {}", wrong(&background, &now));
        }
    }

    #[test]
    fn a_shifted_plate_is_recognised() {
        let mut background = Background::from_plate(&camera(), &picture(1, room)).unwrap();
        let moved = picture(2, |x, y| room(x - 5, y + 3));
        let events = background.update(&moved, &[area(&gate())]).unwrap();
        assert_eq!(events, [BackgroundEvent::Shifted(5, -3)]);
        assert!(evidence(&background, &moved).is_none(), "the plate is not used");
    }

    #[test]
    fn somebody_in_the_plate_is_reported_once_and_forgotten() {
        let in_plate = |x: i64, y: i64| if (6..20).contains(&x) && y > 30 { [20.0, 20.0, 60.0] } else { room(x, y) };
        let mut background = Background::from_plate(&camera(), &picture(1, in_plate)).unwrap();
        let (gate, mut events) = (gate(), Vec::new());
        for seed in 2..40 {
            events.extend(background.update(&picture(seed, room), &[area(&gate)]).unwrap());
        }
        let [BackgroundEvent::Differs(share, [x, y])] = events[..] else { panic!("{events:?}") };
        assert!(share > 0.05 && (8..18).contains(&x) && (50..75).contains(&y), "{share} at {x}, {y}");
        assert!(wrong(&background, &picture(50, room)) < 20);
    }

    #[test]
    fn bodies_are_never_learnt_and_poison_does_no_harm() {
        let mut background = Background::from_plate(&camera(), &picture(1, room)).unwrap();
        let gate = gate();
        let person =
            |x: i64, y: i64| if (42..54).contains(&x) && (30..70).contains(&y) { [10.0; 3] } else { room(x, y) };
        for seed in 0..40 {
            assert_eq!(background.update(&picture(seed, person), &[area(&gate)]).unwrap(), []);
        }
        assert!(wrong(&background, &picture(60, person)) > 400);
        // The body everywhere, images of other sizes, black ones.
        let mut everywhere = Grid::new(SIDE, SIDE, 1.0);
        everywhere.values[0] = 1.0;
        assert_eq!(background.update(&picture(1, dimmed), &[area(&BodyGate::of_grid(&everywhere, 60.0))]).unwrap(), []);
        let small = Image::new(2, 2, PixelFormat::Rgb8, vec![0; 12]).unwrap();
        assert_eq!(background.update(&small, &[]).unwrap(), []);
        let black = picture(1, |_, _| [-9.0; 3]);
        let mut dark = Background::from_plate(&camera(), &black).unwrap();
        assert_eq!(dark.update(&black, &[]).unwrap(), []);
        let error = Background::from_plate(&camera(), &small).unwrap_err().to_string();
        assert!(error.contains("camera left") && error.contains("2x2") && error.contains("96x96"), "{error}");
    }
}

//! The plate: an image of the empty scene that follows the room.
//!
//! Pixels that no person reaches follow slow changes of the light. A pixel that differs for long is relearnt, all pixels
//! are after a sudden change of most of them (a switched lamp) or a shift (a camera that was moved). An unknown pixel
//! counts as known once it has kept its colour for a while.

use crate::image::pixels::Rgb;
use crate::masks::background_event::BackgroundEvent;
use crate::masks::drift::Drift;
use crate::masks::person_area::{PersonArea, Shows, classify};
use crate::masks::plate_evidence::plate_evidence;
use crate::masks::plate_shift::find_shift;

/// Share of the known pixels away from people that differ from the plate when the whole room has changed.
const ALL_CHANGED: f32 = 0.4;
/// Share of the image that must be known and away from people to judge the whole room by it.
const LEAST_AWAY: f32 = 0.2;
/// Updates for which an unknown pixel must keep its colour to become known.
const STEADY_UPDATES: u8 = 8;
/// Change of a channel between updates that is no noise, sRGB steps.
const STEADY: f32 = 14.0;
/// Updates for which a pixel away from people must differ from the plate to be relearnt.
const DIFFERENT_UPDATES: u8 = 15;
/// Share of the difference that the plate adopts per update.
const FOLLOW: f32 = 1.0 / 16.0;
/// Period, in updates, in which pixels near a person are learnt: a part of the person that the mask misses has time to
/// move.
const CLEAR_EVERY: u32 = 4;
/// Updates for which a background that is being learnt asks for every image.
const EAGER_UPDATES: u32 = 60;
/// Share of the image that must differ where no person stands to be reported.
const REPORTED: f32 = 0.003;
/// Share of the pixels away from people that must be known again after a change.
const RECOVERED: f32 = 0.7;

/// Image of the empty scene that is kept up to date.
#[derive(Debug, Clone)]
pub(crate) struct Plate {
    /// sRGB values, three per pixel.
    values: Vec<f32>,
    /// Updates for which each pixel has kept its colour, up to [`STEADY_UPDATES`], where it counts as known.
    steady: Vec<u8>,
    /// Updates for which each known pixel has differed from the plate.
    different: Vec<u8>,
    /// Whether the plate is being relearnt after the whole room changed.
    renewing: bool,
    /// Whether the plate has been tested for a shift, and whether a difference has been reported.
    compared: bool,
    reported: bool,
    /// Updates since the start, or since all pixels were forgotten.
    updates: u32,
}

impl Plate {
    /// Returns a plate without a known pixel.
    pub fn unknown(width: usize, height: usize) -> Self {
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

    /// Returns the plate of an image of the empty scene.
    pub fn recorded(picture: &Rgb) -> Self {
        Self {
            values: picture.bytes.iter().map(|byte| f32::from(*byte)).collect(),
            steady: vec![STEADY_UPDATES; picture.width * picture.height],
            compared: false,
            updates: EAGER_UPDATES,
            ..Self::unknown(picture.width, picture.height)
        }
    }

    /// Returns the sRGB values, three per pixel; those of unknown pixels mean nothing.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Whether the next image is worth an update.
    pub fn is_learning(&self) -> bool {
        self.updates < EAGER_UPDATES
    }

    /// Measures the exposure of an image relative to the plate, at known pixels where `is_background`.
    pub fn drift(&self, picture: &Rgb, is_background: &dyn Fn(usize) -> bool) -> Drift {
        Drift::new(picture, &self.values, &|at| self.knows(at) && is_background(at))
    }

    /// Whether the colour of a pixel is known.
    pub fn knows(&self, pixel: usize) -> bool {
        self.steady[pixel] >= STEADY_UPDATES
    }

    /// Ingests an image of the plate's size that shows no person but `people`; see [`crate::Background::update`].
    pub fn update(&mut self, picture: &Rgb, people: &[PersonArea<'_>]) -> Vec<BackgroundEvent> {
        let mut events = Vec::new();
        let width = picture.width;
        self.updates = self.updates.saturating_add(1);
        let learns_near = self.updates.is_multiple_of(CLEAR_EVERY);
        let shows = classify(picture, people, learns_near);
        let away: Vec<bool> = shows.iter().map(|shows| *shows == Shows::Background).collect();
        let away_count = away.iter().filter(|away| **away).count();
        if !self.compared {
            self.compared = true;
            if let Some([x, y]) = find_shift(picture, &self.values, &away) {
                self.forget();
                events.push(BackgroundEvent::Shifted(x, y));
            }
        }
        let drift = self.drift(picture, &|at| away[at]);
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
                // Known well enough, and too near to a person to be relearnt.
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

    /// Forgets all pixels, so that the plate is relearnt.
    fn forget(&mut self) {
        self.steady.fill(0);
        self.different.fill(0);
        (self.renewing, self.updates) = (true, 0);
    }

    /// Adds a colour of an unknown pixel; its mean counts as known once it has been steady.
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
}

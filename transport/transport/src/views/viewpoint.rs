//! Viewpoints that subscribers request.

use std::{
    collections::VecDeque,
    ops::RangeInclusive,
    time::{Duration, Instant},
};

use flyrig_types::{Camera, caught, saturating_secs};
use serde::{Deserialize, Serialize};

use crate::{error::TransportError, json::from_json, keys, printable::clean, views::first_images::FirstImages};

/// Largest side of an image that a subscriber may request, pixels.
pub const MAX_VIEWPOINT_SIDE: u32 = 4096;

/// Rates that a subscriber may request, images per second.
const RATES: RangeInclusive<f64> = 0.01..=1000.0;

/// Time for which a request that could not be drawn is refused.
const REFUSAL: Duration = Duration::from_secs(60);

/// Largest number of refused requests that are remembered; the oldest is forgotten first.
const MAX_REFUSALS: usize = 64;

/// Camera that a subscriber requests images through.
#[derive(Debug, Clone, PartialEq)]
pub struct Viewpoint {
    /// Name of the subscriber.
    pub subscriber: String,
    /// Name of the view to publish the images under.
    pub view: String,
    /// Camera to draw; validated, at most 4096 pixels per side, its name printable.
    pub camera: Camera,
    /// Largest rate that the subscriber wants, images per second.
    pub max_fps: f64,
}

/// Status of a subscriber's viewpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ViewpointStatus {
    /// No viewpoint is requested.
    Idle,
    /// No answer so far; the request is repeated.
    Pending,
    /// The publisher renders the viewpoint.
    Granted {
        /// Name of the view.
        view: String,
    },
    /// The publisher refuses; the request is repeated at each renewal.
    Refused {
        /// Reason that the publisher gives.
        reason: String,
    },
}

/// Request for a viewpoint; one without a camera releases it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewpointRequest {
    pub camera: Option<Camera>,
    pub max_fps: f64,
}

/// Answer of the publisher.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewpointAnswer {
    pub granted: bool,
    pub reason: String,
    pub lease_millis: u64,
}

impl ViewpointAnswer {
    /// Decodes an answer from JSON; the reason is made [`crate::printable()`].
    pub(crate) fn decode(topic: &str, bytes: &[u8]) -> Result<Self, TransportError> {
        let mut answer: Self = from_json(topic, bytes)?;
        clean(&mut answer.reason);
        Ok(answer)
    }
}

/// Checks the numbers of a request.
pub(crate) fn check_camera(topic: &str, camera: &Camera, max_fps: f64) -> Result<(), TransportError> {
    let refuse = |message: String| Err(TransportError::config(topic, message));
    if let Err(error) = camera.validate() {
        return refuse(error.to_string());
    }
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    if width > MAX_VIEWPOINT_SIDE || height > MAX_VIEWPOINT_SIDE {
        return refuse(format!("{width}x{height} pixels requested, at most {MAX_VIEWPOINT_SIDE} per side"));
    }
    if !RATES.contains(&max_fps) {
        let (least, most) = (RATES.start(), RATES.end());
        return refuse(format!("{max_fps:?} images per second requested, expected {least} to {most}"));
    }
    // Drawing computes in single precision, where larger or smaller numbers are infinite or zero.
    let intrinsics = &camera.intrinsics;
    let (focal, center) = (intrinsics.focal_px, intrinsics.center_px);
    let largest = |numbers: &[f64]| numbers.iter().fold(0.0, |largest: f64, number| largest.max(number.abs()));
    let distance = largest(&camera.camera_from_world.translation.to_array());
    for (what, value, range, unit) in [
        ("focal length fx", focal.x, 0.1..=1e7, " pixels"),
        ("focal length fy", focal.y, 0.1..=1e7, " pixels"),
        ("offset of the principal point", largest(&center.to_array()), 0.0..=1e6, " pixels"),
        ("distance from the origin", distance, 0.0..=1e5, " m"),
        ("largest lens coefficient", largest(&intrinsics.lens.coefficients()), 0.0..=1e6, ""),
    ] {
        if !range.contains(&value) {
            let (least, most) = (range.start(), range.end());
            return refuse(format!("{what} of {value:?}{unit} requested, expected {least} to {most}{unit}"));
        }
    }
    Ok(())
}

struct Lease {
    viewpoint: Viewpoint,
    ends: Instant,
    /// Time at which the next image is due.
    next_due: Instant,
    /// Whether no frame set has come since it is watched.
    is_new: bool,
}

impl Lease {
    fn new(viewpoint: Viewpoint, ends: Instant, now: Instant) -> Self {
        let period = period(&viewpoint);
        // Not one that may be a little early, see below: it would pay to give the viewpoint back after every image.
        Self { viewpoint, ends, next_due: now + period + period / 8, is_new: true }
    }

    /// Replaces viewpoint and end. Pixels that were earned towards the next image stay earned at another size or rate.
    fn renew(&mut self, viewpoint: Viewpoint, ends: Instant, now: Instant) {
        let before = std::mem::replace(&mut self.viewpoint, viewpoint);
        self.ends = ends;
        let is_same = [pixels, pixel_rate].map(|of| of(&before).total_cmp(&of(&self.viewpoint)).is_eq()) == [true; 2];
        if !is_same {
            let missing = self.next_due.saturating_duration_since(now).as_secs_f64() * pixel_rate(&before);
            let earned = (pixels(&before) - missing).max(0.0);
            let missing = (pixels(&self.viewpoint) - earned).max(0.0);
            self.next_due = now + saturating_secs(missing / pixel_rate(&self.viewpoint));
        }
    }

    /// Returns whether an image is due, and schedules the next one a period later.
    fn take_due(&mut self, first_images: &mut FirstImages, now: Instant) -> bool {
        let period = period(&self.viewpoint);
        if std::mem::take(&mut self.is_new) && first_images.take(&self.viewpoint.subscriber, now) {
            self.next_due = now + period;
            return true;
        }
        // A frame set of the same rate that is a little early must not lose its image.
        if now + period / 8 < self.next_due {
            return false;
        }
        // Periods add up, so that jitter does not change the mean rate. After a pause, at most half a period is made up for.
        let earliest = now.checked_sub(period / 2).unwrap_or(now);
        self.next_due = (self.next_due + period).max(earliest);
        true
    }
}

/// Returns the time from one image to the next.
fn period(viewpoint: &Viewpoint) -> Duration {
    saturating_secs(1.0 / viewpoint.max_fps)
}

/// Request that could not be drawn.
struct Refusal {
    viewpoint: Viewpoint,
    reason: String,
    ends: Instant,
}

/// Viewpoints of a publisher: bounded in number and in pixels per second, each with a lease.
pub(crate) struct Leases {
    active: Vec<Lease>,
    refusals: VecDeque<Refusal>,
    max_viewers: usize,
    lease: Duration,
    pixels_per_second: u64,
    max_view_pixels: u64,
    first_images: FirstImages,
    pub granted: u64,
    pub refused: u64,
    pub expired: u64,
}

impl Leases {
    pub(crate) fn new(max_viewers: usize, lease: Duration, pixels_per_second: u64) -> Self {
        Self {
            active: Vec::new(),
            refusals: VecDeque::new(),
            max_viewers,
            lease,
            pixels_per_second,
            max_view_pixels: u64::MAX,
            first_images: FirstImages::default(),
            granted: 0,
            refused: 0,
            expired: 0,
        }
    }

    /// Chooses whether subscribers hold keys, so that each holder has first images of its own.
    pub(crate) fn with_keys(mut self, has_keys: bool) -> Self {
        self.first_images.has_keys = has_keys;
        self
    }

    /// Grants, renews, releases or refuses a viewpoint.
    pub(crate) fn ask(
        &mut self,
        subscriber: &str,
        request: Result<ViewpointRequest, TransportError>,
        now: Instant,
    ) -> ViewpointAnswer {
        self.expire(now);
        let answer = self.try_ask(subscriber, request, now);
        let (granted, reason) = match answer {
            Ok(()) => (true, String::new()),
            Err(error) => {
                self.refused += 1;
                (false, error.to_string())
            }
        };
        ViewpointAnswer { granted, reason, lease_millis: self.lease.as_millis() as u64 }
    }

    fn try_ask(
        &mut self,
        subscriber: &str,
        request: Result<ViewpointRequest, TransportError>,
        now: Instant,
    ) -> Result<(), TransportError> {
        let topic = format!("viewpoint of {subscriber}");
        let ViewpointRequest { camera, max_fps } = request?;
        keys::check_name("subscriber", subscriber)?;
        let Some(camera) = camera else {
            self.active.retain(|lease| lease.viewpoint.subscriber != subscriber);
            return Ok(());
        };
        check_camera(&topic, &camera, max_fps)?;
        let viewpoint = Viewpoint {
            subscriber: subscriber.to_owned(),
            view: format!("{}{subscriber}", keys::VIEWER_PREFIX),
            camera,
            max_fps,
        };
        if let Some(at) = self.refusals.iter().position(|refusal| refusal.viewpoint.subscriber == subscriber) {
            if self.refusals[at].viewpoint == viewpoint {
                return Err(TransportError::config(topic, self.refusals[at].reason.clone()));
            }
            self.refusals.remove(at);
        }
        self.check_pixels(&topic, &viewpoint)?;
        let ends = now + self.lease;
        if let Some(lease) = self.active.iter_mut().find(|lease| lease.viewpoint.subscriber == subscriber) {
            lease.renew(viewpoint, ends, now);
            return Ok(());
        }
        if self.active.len() >= self.max_viewers {
            let max = self.max_viewers;
            return Err(TransportError::config(
                topic,
                format!("all {max} viewpoints of the rig are taken; wait for one or raise max_viewers"),
            ));
        }
        self.active.push(Lease::new(viewpoint, ends, now));
        self.granted += 1;
        Ok(())
    }

    /// Checks that a viewpoint fits the largest image and, beside those of other subscribers, the budget.
    fn check_pixels(&self, topic: &str, viewpoint: &Viewpoint) -> Result<(), TransportError> {
        let refuse = |message: String| Err(TransportError::config(topic, message));
        let (width, height) = (viewpoint.camera.intrinsics.width, viewpoint.camera.intrinsics.height);
        // The largest image of the same aspect ratio with `most` pixels.
        let within = |most: f64| {
            let scale = (most / pixels(viewpoint)).sqrt();
            format!("{}x{}", (f64::from(width) * scale) as u32, (f64::from(height) * scale) as u32)
        };
        let most = self.max_view_pixels as f64;
        if pixels(viewpoint) > most {
            return refuse(format!(
                "{width}x{height} is {} Mpx, the rig draws at most {} Mpx; ask for {}",
                mega(pixels(viewpoint)),
                mega(most),
                within(most)
            ));
        }
        let others = self.active.iter().map(|lease| &lease.viewpoint);
        let taken: f64 = others.filter(|other| other.subscriber != viewpoint.subscriber).map(pixel_rate).sum();
        let budget = self.pixels_per_second as f64;
        let left = (budget - taken).max(0.0);
        // Sums of products of whole and of measured rates are not exact to the last bit.
        if pixel_rate(viewpoint) <= left * (1.0 + 1e-9) {
            return Ok(());
        }
        let max_fps = viewpoint.max_fps;
        let (slower, smaller) = ((left / pixels(viewpoint)).floor(), left / max_fps);
        let fits = match (slower >= 1.0, smaller >= 1024.0) {
            (true, true) => format!("ask for {} or --max-fps {slower}", within(smaller)),
            (true, false) => format!("ask for --max-fps {slower}"),
            (false, true) => format!("ask for {}", within(smaller)),
            (false, false) => "wait until another viewer leaves, or raise viewpoint-pixels-per-second".to_owned(),
        };
        refuse(format!(
            "{width}x{height} at {max_fps} per second is {} Mpx/s; {} of the rig's {} Mpx/s are left; {fits}",
            mega(pixel_rate(viewpoint)),
            mega(left),
            mega(budget)
        ))
    }

    /// Sets the largest image, pixels; larger viewpoints end.
    pub(crate) fn set_max_view_pixels(&mut self, most: u64) {
        self.max_view_pixels = most;
        let before = self.active.len();
        self.active.retain(|lease| pixels(&lease.viewpoint) <= most as f64);
        self.expired += (before - self.active.len()) as u64;
    }

    /// Ends a subscriber's lease and refuses the same request for [`REFUSAL`].
    pub(crate) fn refuse(&mut self, subscriber: &str, reason: &str, now: Instant) {
        let Some(at) = self.active.iter().position(|lease| lease.viewpoint.subscriber == subscriber) else { return };
        let viewpoint = self.active.remove(at).viewpoint;
        self.expired += 1;
        self.refusals.retain(|refusal| refusal.viewpoint.subscriber != subscriber);
        if self.refusals.len() >= MAX_REFUSALS {
            self.refusals.pop_front();
        }
        self.refusals.push_back(Refusal { viewpoint, reason: reason.to_owned(), ends: now + REFUSAL });
    }

    /// Takes the watched viewpoints whose next image is due.
    pub(crate) fn take_due(&mut self, now: Instant, is_watched: impl Fn(&str) -> bool) -> Vec<Viewpoint> {
        self.take_due_with(now, is_watched, Lease::take_due)
    }

    /// Takes the watched viewpoints that are due by `schedule`; one for which it panics ends.
    fn take_due_with(
        &mut self,
        now: Instant,
        is_watched: impl Fn(&str) -> bool,
        schedule: impl Fn(&mut Lease, &mut FirstImages, Instant) -> bool,
    ) -> Vec<Viewpoint> {
        self.expire(now);
        let (mut due, mut panics) = (Vec::new(), Vec::new());
        for lease in self.active.iter_mut().filter(|lease| is_watched(&lease.viewpoint.view)) {
            match caught(|| schedule(lease, &mut self.first_images, now)) {
                Ok(true) => due.push(lease.viewpoint.clone()),
                Ok(false) => {}
                Err(panic) => panics.push((lease.viewpoint.subscriber.clone(), panic)),
            }
        }
        for (subscriber, panic) in panics {
            tracing::error!(viewer = subscriber, "scheduling a viewpoint panicked: {panic}");
            self.refuse(&subscriber, &format!("its schedule cannot be computed: {panic}"), now);
        }
        due
    }

    /// Forgets a subscriber that has left.
    pub(crate) fn drop_subscriber(&mut self, subscriber: &str) {
        let before = self.active.len();
        self.active.retain(|lease| lease.viewpoint.subscriber != subscriber);
        self.refusals.retain(|refusal| refusal.viewpoint.subscriber != subscriber);
        self.expired += (before - self.active.len()) as u64;
    }

    pub(crate) fn expire(&mut self, now: Instant) {
        let before = self.active.len();
        self.active.retain(|lease| lease.ends > now);
        self.refusals.retain(|refusal| refusal.ends > now);
        self.expired += (before - self.active.len()) as u64;
    }

    pub(crate) fn viewpoints(&self) -> Vec<Viewpoint> {
        self.active.iter().map(|lease| lease.viewpoint.clone()).collect()
    }

    pub(crate) fn len(&self) -> usize {
        self.active.len()
    }
}

fn pixels(viewpoint: &Viewpoint) -> f64 {
    let intrinsics = &viewpoint.camera.intrinsics;
    f64::from(intrinsics.width) * f64::from(intrinsics.height)
}

/// Returns the rate of a viewpoint, pixels per second.
fn pixel_rate(viewpoint: &Viewpoint) -> f64 {
    pixels(viewpoint) * viewpoint.max_fps
}

/// Formats a number of pixels in millions.
fn mega(pixels: f64) -> String {
    format!("{:.1}", pixels * 1e-6)
}

#[cfg(test)]
#[path = "viewpoint_tests.rs"]
mod tests;

//! Viewpoints that subscribers request.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use flyrig_types::Camera;
use serde::{Deserialize, Serialize};

use crate::{error::TransportError, json::from_json, keys, printable::clean};

/// Largest side of an image that a subscriber may request, pixels.
pub const MAX_VIEWPOINT_SIDE: u32 = 4096;

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
    if !(max_fps > 0.0 && max_fps <= 1000.0) {
        return refuse(format!("{max_fps} images per second requested, expected more than 0, at most 1000"));
    }
    Ok(())
}

struct Lease {
    viewpoint: Viewpoint,
    ends: Instant,
    /// Time at which the next image is due; `None` before the first.
    next_due: Option<Instant>,
}

impl Lease {
    /// Returns whether an image is due, and schedules the next one a period later.
    fn take_due(&mut self, now: Instant) -> bool {
        let period = Duration::from_secs_f64(1.0 / self.viewpoint.max_fps);
        let Some(due) = self.next_due else {
            self.next_due = now.checked_add(period);
            return true;
        };
        // A frame set of the same rate that is a little early must not lose its image.
        if now + period / 8 < due {
            return false;
        }
        // Periods add up, so that jitter does not change the mean rate. After a pause, at most half a period is made up for.
        let earliest = now.checked_sub(period / 2).unwrap_or(now);
        self.next_due = due.checked_add(period).map(|next| next.max(earliest));
        true
    }
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
            granted: 0,
            refused: 0,
            expired: 0,
        }
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
        let Some(mut camera) = camera else {
            self.active.retain(|lease| lease.viewpoint.subscriber != subscriber);
            return Ok(());
        };
        check_camera(&topic, &camera, max_fps)?;
        let mut name = camera.id.to_string();
        clean(&mut name);
        camera.id = name.into();
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
            *lease = Lease { viewpoint, ends, next_due: lease.next_due };
            return Ok(());
        }
        if self.active.len() >= self.max_viewers {
            let max = self.max_viewers;
            return Err(TransportError::config(
                topic,
                format!("all {max} viewpoints of the rig are taken; wait for one or raise max_viewers"),
            ));
        }
        self.active.push(Lease { viewpoint, ends, next_due: None });
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
        self.expire(now);
        let due = self.active.iter_mut().filter(|lease| is_watched(&lease.viewpoint.view));
        due.filter_map(|lease| lease.take_due(now).then(|| lease.viewpoint.clone())).collect()
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
mod tests {
    use flyrig_types::{Intrinsics, Isometry, Lens};
    use glam::DVec2;

    use super::*;

    const LEASE: Duration = Duration::from_secs(3);
    const BUDGET: u64 = 512 * 512 * 30 * 4;

    fn leases() -> Leases {
        Leases::new(8, LEASE, BUDGET)
    }

    fn camera(width: u32, height: u32) -> Camera {
        Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: "mine".into(),
            intrinsics: Intrinsics {
                width,
                height,
                focal_px: DVec2::splat(500.0),
                center_px: DVec2::new(f64::from(width), f64::from(height)) / 2.0,
                lens: Lens::PINHOLE,
            },
            camera_from_world: Isometry::IDENTITY,
        }
    }

    /// Returns the reason of a refusal; empty when granted.
    fn ask(leases: &mut Leases, who: &str, (width, height): (u32, u32), max_fps: f64, now: Instant) -> String {
        let request = ViewpointRequest { camera: Some(camera(width, height)), max_fps };
        let answer = leases.ask(who, Ok(request), now);
        assert_eq!(answer.granted, answer.reason.is_empty());
        answer.reason
    }

    #[test]
    fn the_budget_of_pixels_is_shared_and_a_refusal_names_what_fits() {
        let (mut leases, now) = (leases(), Instant::now());
        // Four viewers of the usual size fill it to the pixel, and each may renew and move.
        for round in 0..3 {
            for who in ["a", "b", "c", "d"] {
                assert_eq!(ask(&mut leases, who, (512, 512), 30.0, now), "", "{who} {round}");
            }
        }
        let full = ask(&mut leases, "e", (512, 512), 30.0, now);
        assert!(
            full.contains("512x512 at 30 per second is 7.9 Mpx/s; 0.0 of the rig's 31.5 Mpx/s are left; wait"),
            "{full}"
        );
        // One that leaves makes room; a larger one learns which sizes fit, and both of them do.
        leases.drop_subscriber("d");
        let large = ask(&mut leases, "e", (1024, 1024), 30.0, now);
        assert!(large.contains("1024x1024 at 30 per second is 31.5 Mpx/s; 7.9 of the rig's 31.5 Mpx/s"), "{large}");
        assert!(large.ends_with("ask for 512x512 or --max-fps 7"), "{large}");
        assert_eq!(ask(&mut leases, "e", (1024, 1024), 7.0, now), "");
        leases.drop_subscriber("e");
        assert_eq!(ask(&mut leases, "e", (512, 512), 30.0, now), "");
        // A subscriber that requests more keeps the granted viewpoint, and takes nothing from the others.
        assert!(!ask(&mut leases, "e", (513, 512), 30.0, now).is_empty());
        let rates: Vec<f64> = leases.viewpoints().iter().map(pixel_rate).collect();
        assert_eq!(rates, [512.0 * 512.0 * 30.0; 4]);
        for who in ["a", "b", "c"] {
            assert_eq!(ask(&mut leases, who, (512, 512), 30.0, now), "");
        }
        // A lease that ends gives its pixels back.
        assert_eq!(ask(&mut leases, "f", (1024, 1024), 30.0, now + LEASE), "");
        // More than everything.
        let huge = ask(&mut leases, "f", (4096, 4096), 1000.0, now + LEASE);
        assert!(huge.contains("16777.2 Mpx/s; 31.5 of") && huge.ends_with("ask for 177x177 or --max-fps 1"), "{huge}");
        assert!(ask(&mut Leases::new(8, LEASE, 0), "a", (64, 64), 30.0, now).contains("raise viewpoint-pixels"));
    }

    #[test]
    fn images_too_large_for_the_rig_are_refused_and_ended() {
        let (mut leases, now) = (Leases::new(8, LEASE, u64::MAX), Instant::now());
        assert_eq!(ask(&mut leases, "a", (4096, 4096), 30.0, now), "");
        assert_eq!(ask(&mut leases, "b", (2048, 1024), 30.0, now), "");
        leases.set_max_view_pixels(8 << 20);
        assert_eq!(leases.viewpoints().iter().map(|v| v.subscriber.as_str()).collect::<Vec<_>>(), ["b"]);
        let reason = ask(&mut leases, "a", (4096, 4096), 30.0, now);
        assert!(
            reason.ends_with("4096x4096 is 16.8 Mpx, the rig draws at most 8.4 Mpx; ask for 2896x2896"),
            "{reason}"
        );
        assert_eq!(ask(&mut leases, "a", (2896, 2896), 30.0, now), "");
    }

    #[test]
    fn what_could_not_be_drawn_is_refused_until_it_changes_or_a_minute_has_passed() {
        let (mut leases, now) = (leases(), Instant::now());
        for who in ["a", "b"] {
            assert_eq!(ask(&mut leases, who, (512, 512), 30.0, now), "");
        }
        leases.refuse("a", "out of memory\u{1b}[2J", now);
        leases.refuse("nobody", "x", now);
        assert_eq!(leases.viewpoints().len(), 1);
        for seconds in [0, 1, 59] {
            let reason = ask(&mut leases, "a", (512, 512), 30.0, now + Duration::from_secs(seconds));
            assert_eq!(reason, "viewpoint of a: out of memory\\u{1b}[2J");
            assert_eq!(ask(&mut leases, "b", (512, 512), 30.0, now + Duration::from_secs(seconds)), "");
        }
        assert_eq!(ask(&mut leases, "a", (512, 512), 30.0, now + REFUSAL), "");
        // Another size is another request, and the first one may be tried again after it.
        leases.refuse("a", "out of memory", now + REFUSAL);
        assert_eq!(ask(&mut leases, "a", (256, 256), 30.0, now + REFUSAL), "");
        assert_eq!(ask(&mut leases, "a", (512, 512), 30.0, now + REFUSAL), "");
        // Any number of refusals is remembered within bounds.
        for n in 0..1000 {
            let who = format!("n{n}");
            assert_eq!(ask(&mut leases, &who, (64, 64), 1.0, now + REFUSAL), "");
            leases.refuse(&who, "x", now + REFUSAL);
        }
        assert_eq!(leases.refusals.len(), MAX_REFUSALS);
    }

    /// Returns the number of images of each viewer in 20 s of a rig of `rig_fps`, whose frame sets are up to `jitter` of an interval early
    /// or late.
    fn pictures(rates: &[f64], rig_fps: f64, jitter: f64) -> Vec<usize> {
        let (mut leases, start) = (Leases::new(8, LEASE, u64::MAX), Instant::now());
        let mut counts = vec![0; rates.len()];
        let mut random = 7u64;
        for set in 0..(20.0 * rig_fps) as u32 {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let shift = ((random >> 33) as f64 / f64::from(1u32 << 31) * 2.0 - 1.0) * jitter;
            let now = start + Duration::from_secs_f64((f64::from(set) + 1.0 + shift) / rig_fps);
            for (n, max_fps) in rates.iter().enumerate() {
                assert_eq!(ask(&mut leases, &n.to_string(), (64, 64), *max_fps, now), "");
            }
            for viewpoint in leases.take_due(now, |_| true) {
                counts[viewpoint.subscriber.parse::<usize>().unwrap()] += 1;
            }
        }
        counts
    }

    #[test]
    fn every_viewer_gets_its_own_rate() {
        for jitter in [0.0, 0.1, 0.3, 0.49] {
            // 20 s of a rig at 30 frame sets per second: 600.
            let counts = pictures(&[30.0, 20.0, 7.5, 1.0, 1000.0, 29.0], 30.0, jitter);
            for (count, wanted) in counts.iter().zip([600, 400, 150, 20, 600, 580]) {
                assert!(count.abs_diff(wanted) <= 2, "jitter {jitter}: {counts:?}");
            }
        }
        // A rig that is faster than asked for by any ratio.
        assert!(pictures(&[30.0], 47.0, 0.3)[0].abs_diff(600) <= 2);
    }

    #[test]
    fn no_image_is_drawn_for_a_viewer_that_does_not_watch_or_to_make_up_for_a_pause() {
        let (mut leases, now) = (leases(), Instant::now());
        assert_eq!(ask(&mut leases, "a", (64, 64), 10.0, now), "");
        assert_eq!(ask(&mut leases, "b", (64, 64), 10.0, now), "");
        let due = |leases: &mut Leases, millis, watched: &str| -> Vec<String> {
            let now = now + Duration::from_millis(millis);
            leases.take_due(now, |view| view == watched).into_iter().map(|viewpoint| viewpoint.subscriber).collect()
        };
        assert_eq!(due(&mut leases, 0, "viewer-a"), ["a"]);
        assert!(due(&mut leases, 50, "viewer-a").is_empty());
        assert_eq!(due(&mut leases, 60, "viewer-b"), ["b"]);
        assert_eq!(due(&mut leases, 100, "viewer-a"), ["a"]);
        // After a pause of one second, the next second has ten images, without the ten that were missed.
        let taken: usize = (0..100).map(|n| due(&mut leases, 1100 + 10 * n, "viewer-a").len()).sum();
        assert!((10..=12).contains(&taken), "{taken}");
        // The lease ends, as everywhere.
        assert!(due(&mut leases, 3000, "viewer-a").is_empty());
    }
}

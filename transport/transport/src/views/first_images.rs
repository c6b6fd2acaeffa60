//! Images that viewers get before they have waited for them.
//!
//! A granted viewpoint earns its images: each is due once the pixels of one image have passed at the granted rate. Only its first image
//! may come at once, out of pixels that no viewpoint has been granted, and only once per holder within [`PERIOD`]. So a viewer gains
//! nothing by giving its viewpoint back and asking again, under its own name or others, and the rig draws no more than its budget.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// Time within which a holder gets one first image: the longest period of a viewpoint.
const PERIOD: Duration = Duration::from_secs(100);

/// Largest number of holders that are remembered; while there are as many, others wait for their first image.
const MAX_HOLDERS: usize = 1024;

/// Pixels for first images, and the holders that have had theirs.
pub(crate) struct FirstImages {
    /// Most pixels that are kept: those of the budget in one second.
    most: f64,
    /// Pixels left; negative after an image larger than the rest.
    pixels: f64,
    /// Time of the last refill.
    at: Option<Instant>,
    /// Holders with the times of their last first image, the oldest first.
    served: VecDeque<(String, Instant)>,
}

impl FirstImages {
    pub(crate) fn new(pixels_per_second: u64) -> Self {
        let most = pixels_per_second as f64;
        Self { most, pixels: most, at: None, served: VecDeque::new() }
    }

    /// Adds the pixels of the time since the last call; `free` is the rate that no viewpoint has been granted since then, pixels per
    /// second.
    pub(crate) fn refill(&mut self, free: f64, now: Instant) {
        let since = self.at.map_or(Duration::ZERO, |at| now.saturating_duration_since(at));
        self.at = Some(now);
        self.pixels = (self.pixels + free * since.as_secs_f64()).min(self.most);
        let is_over = |at: Instant| now.saturating_duration_since(at) >= PERIOD;
        while self.served.front().is_some_and(|(_, at)| is_over(*at)) {
            self.served.pop_front();
        }
    }

    /// Takes the pixels of a subscriber's first image; returns false when it must wait for a period.
    pub(crate) fn take(&mut self, subscriber: &str, pixels: f64, now: Instant) -> bool {
        let holder = holder(subscriber);
        let is_served = self.served.iter().any(|(served, _)| served == holder);
        if is_served || self.pixels <= 0.0 || self.served.len() >= MAX_HOLDERS {
            return false;
        }
        self.pixels -= pixels;
        self.served.push_back((holder.to_owned(), now));
        true
    }
}

/// Returns the name that all subscribers with one key share; that of a subscriber without a key is its own.
fn holder(subscriber: &str) -> &str {
    subscriber.split_once('.').map_or(subscriber, |(holder, _)| holder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_holder_has_one_first_image_whatever_its_subscribers_are_called() {
        let (mut first, now) = (FirstImages::new(1000), Instant::now());
        assert!(first.take("ring-1.a", 10.0, now));
        for name in ["ring-1.a", "ring-1.b", "ring-1"] {
            assert!(!first.take(name, 10.0, now), "{name}");
        }
        assert!(first.take("ring-2.a", 10.0, now) && first.take("a", 10.0, now));
        first.refill(0.0, now + PERIOD);
        assert!(first.take("ring-1.b", 10.0, now + PERIOD));
    }

    #[test]
    fn pixels_and_memory_are_bounded() {
        let (mut first, now) = (FirstImages::new(1000), Instant::now());
        // One image more than there are pixels.
        let taken = |first: &mut FirstImages, of: &str, now| {
            (0..100).filter(|n| first.take(&format!("{of}{n}"), 300.0, now)).count()
        };
        assert_eq!(taken(&mut first, "a", now), 4);
        first.refill(400.0, now);
        first.refill(400.0, now + Duration::from_secs(1));
        assert_eq!(taken(&mut first, "b", now), 1);
        // A long pause gives no more than a second of the whole budget.
        first.refill(400.0, now + Duration::from_secs(50));
        assert_eq!(taken(&mut first, "c", now), 4);
        let mut endless = FirstImages::new(u64::MAX);
        assert_eq!((0..5000).filter(|n| endless.take(&n.to_string(), 1.0, now)).count(), MAX_HOLDERS);
    }
}

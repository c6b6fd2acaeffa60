//! Images that viewers get before they have waited for them.
//!
//! A viewpoint earns its images from its grant on: each is due once the pixels of one image have passed at the granted rate. The first
//! image alone may come at once, for each holder of a key once within [`PERIOD`]; viewers without keys count as one holder, since nothing
//! but a name of their own choice tells them apart. So a viewer gains nothing by giving its viewpoint back and asking again, under
//! whatever name.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// Time within which a holder gets one first image at once: the longest period of a viewpoint.
const PERIOD: Duration = Duration::from_secs(100);

/// Largest number of holders that are remembered; while there are as many, others wait for their first image.
const MAX_SERVED: usize = 512;

/// Holders that have had their first image.
#[derive(Debug, Default)]
pub(crate) struct FirstImages {
    /// Whether the rig has keys, whose holders' names begin with a number of the key.
    pub has_keys: bool,
    /// Holders with the times of their last first image, the oldest first.
    served: VecDeque<(String, Instant)>,
}

impl FirstImages {
    /// Takes a subscriber's first image; returns false when it must wait for a period.
    pub(crate) fn take(&mut self, subscriber: &str, now: Instant) -> bool {
        let is_over = |at: Instant| now.saturating_duration_since(at) >= PERIOD;
        while self.served.front().is_some_and(|(_, at)| is_over(*at)) {
            self.served.pop_front();
        }
        // All subscribers with one key have the part before the point in common.
        let holder = subscriber.split_once('.').filter(|_| self.has_keys).map_or("", |(holder, _)| holder);
        if self.served.len() >= MAX_SERVED || self.served.iter().any(|(served, _)| served == holder) {
            return false;
        }
        self.served.push_back((holder.to_owned(), now));
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_holder_has_one_first_image_whatever_its_subscribers_are_called() {
        let now = Instant::now();
        let mut first = FirstImages { has_keys: true, ..FirstImages::default() };
        assert!(first.take("ring-1.a", now));
        for name in ["ring-1.a", "ring-1.b", "ring-1.b.c"] {
            assert!(!first.take(name, now), "{name}");
        }
        assert!(first.take("ring-2.a", now) && !first.take("ring-2.b", now));
        assert!(!first.take("ring-1.b", now + PERIOD - Duration::from_millis(1)));
        assert!(first.take("ring-1.b", now + PERIOD));
        // Programs of this computer have no key.
        assert!(first.take("a", now) && !first.take("b", now));
        // Without keys anybody may choose any name.
        let mut first = FirstImages::default();
        assert!(first.take("a.1", now) && !first.take("b.1", now) && first.take("c", now + PERIOD));
    }

    #[test]
    fn memory_is_bounded() {
        let now = Instant::now();
        let mut first = FirstImages { has_keys: true, ..FirstImages::default() };
        assert_eq!((0..5000).filter(|n| first.take(&format!("{n}.a"), now)).count(), MAX_SERVED);
        assert!(first.take("another.a", now + PERIOD) && first.served.len() == 1);
    }
}

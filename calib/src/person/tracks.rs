//! Image tracks of a person's landmarks and silhouettes, per camera, resampled at common instants.

use glam::DVec2;

use super::smoothing::parabola_weights;
use super::tangents::{OutlineCorner, Outlines};

/// Image track of one landmark in one camera.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Track {
    /// Timestamp (nanoseconds), pixel, and confidence, sorted by time.
    samples: Vec<(i64, DVec2, f64)>,
}

/// Smoothed position and velocity of a landmark in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Place {
    pub pixel: DVec2,
    /// Pixels per second.
    pub velocity: DVec2,
    /// Confidence in 0..=1.
    pub confidence: f64,
}

impl Track {
    /// Returns the local quadratic fit at a time; `None` with too few samples, or samples on one side only.
    pub fn at(&self, nanos: i64, interval_s: f64) -> Option<Place> {
        let (near, weights) = parabola_weights(&self.samples, |(at, ..)| *at, |(.., trust)| *trust, nanos, interval_s)?;
        let mut place = Place { pixel: DVec2::ZERO, velocity: DVec2::ZERO, confidence: 0.0 };
        for ((_, pixel, trust), (value, slope)) in near.iter().zip(weights) {
            place.pixel += *pixel * value;
            place.velocity += *pixel * slope;
            place.confidence += trust / near.len() as f64;
        }
        (place.pixel.is_finite() && place.velocity.is_finite() && place.confidence > 0.0).then_some(place)
    }
}

/// Landmarks and silhouettes of one person in the images of all cameras.
#[derive(Debug, Clone, PartialEq)]
pub struct PersonTracks {
    landmarks: usize,
    cameras: Vec<CameraTracks>,
}

/// Landmarks in the images of one camera.
#[derive(Debug, Clone, Default, PartialEq)]
struct CameraTracks {
    /// Times of the images.
    nanos: Vec<i64>,
    tracks: Vec<Track>,
    outlines: Outlines,
}

impl PersonTracks {
    /// Creates empty tracks for a number of cameras and landmarks.
    #[must_use]
    pub fn new(cameras: usize, landmarks: usize) -> Self {
        let empty = CameraTracks { tracks: vec![Track::default(); landmarks], ..CameraTracks::default() };
        Self { landmarks, cameras: vec![empty; cameras] }
    }

    /// Adds the landmarks of an image: pixel and confidence (in 0..=1), `None` for unseen ones. Ignores images out of
    /// order, unknown cameras, and values that are not finite.
    pub fn add(&mut self, camera: usize, nanos: i64, landmarks: &[Option<(DVec2, f64)>]) {
        let Some(camera) = self.cameras.get_mut(camera) else { return };
        if camera.nanos.last().is_some_and(|last| *last >= nanos) {
            return;
        }
        camera.nanos.push(nanos);
        for (track, seen) in camera.tracks.iter_mut().zip(landmarks) {
            if let Some((pixel, confidence)) = *seen
                && pixel.is_finite()
                && confidence > 0.0
            {
                track.samples.push((nanos, pixel, confidence.min(1.0)));
            }
        }
    }

    /// Adds the convex hull of the silhouette in an image. Ignores images out of order, unknown cameras, hulls of fewer than three
    /// corners, and values that are not finite.
    pub fn add_outline(&mut self, camera: usize, nanos: i64, corners: Vec<OutlineCorner>) {
        let Some(camera) = self.cameras.get_mut(camera) else { return };
        let is_newer = camera.outlines.last().is_none_or(|(last, _)| *last < nanos);
        if is_newer && corners.len() > 2 && corners.iter().all(|corner| corner.ray.is_finite()) {
            camera.outlines.push((nanos, corners));
        }
    }

    /// Returns the silhouettes of a camera.
    pub(crate) fn outlines(&self, camera: usize) -> &Outlines {
        &self.cameras[camera].outlines
    }

    /// Returns the number of cameras.
    #[must_use]
    pub fn cameras(&self) -> usize {
        self.cameras.len()
    }

    /// Returns the number of landmarks.
    #[must_use]
    pub fn landmarks(&self) -> usize {
        self.landmarks
    }

    /// Returns the number of images of a camera in which the person was seen.
    #[must_use]
    pub fn images(&self, camera: usize) -> usize {
        self.cameras.get(camera).map_or(0, |camera| camera.nanos.len())
    }

    /// Returns the times of the first and the last image of any camera.
    pub(crate) fn span(&self) -> Option<(i64, i64)> {
        let first = self.cameras.iter().filter_map(|camera| camera.nanos.first()).min()?;
        let last = self.cameras.iter().filter_map(|camera| camera.nanos.last()).max()?;
        Some((*first, *last))
    }

    /// Returns the median interval between images of a camera, seconds.
    pub(crate) fn interval_s(&self, camera: usize) -> f64 {
        let gaps = self.cameras[camera].nanos.windows(2).map(|pair| pair[1].saturating_sub(pair[0]) as f64 * 1e-9);
        flyrig_solve::median(&mut gaps.collect::<Vec<f64>>()).unwrap_or(0.0)
    }

    pub(crate) fn track(&self, camera: usize, landmark: usize) -> &Track {
        &self.cameras[camera].tracks[landmark]
    }

    /// Returns the timestamps of a camera's images.
    pub(crate) fn times(&self, camera: usize) -> Vec<i64> {
        self.cameras[camera].nanos.clone()
    }

    /// Returns the unsmoothed landmark of the image with a timestamp.
    pub(crate) fn sample(&self, camera: usize, landmark: usize, nanos: i64) -> Option<DVec2> {
        let samples = &self.track(camera, landmark).samples;
        let index = samples.binary_search_by_key(&nanos, |(at, ..)| *at).ok()?;
        Some(samples[index].1)
    }

    /// Exchanges two landmarks in the image with a timestamp, if both are seen.
    pub(crate) fn exchange(&mut self, camera: usize, a: usize, b: usize, nanos: i64) {
        let tracks = &mut self.cameras[camera].tracks;
        let at = |landmark: usize| tracks[landmark].samples.binary_search_by_key(&nanos, |(at, ..)| *at).ok();
        if let (Some(i), Some(k)) = (at(a), at(b)) {
            let first = tracks[a].samples[i];
            tracks[a].samples[i] = tracks[b].samples[k];
            tracks[b].samples[k] = first;
        }
    }

    /// Returns the images between two fractions of the take's duration.
    pub(crate) fn part(&self, from: f64, to: f64) -> Self {
        let Some((first, last)) = self.span() else { return self.clone() };
        let at = |share: f64| first.saturating_add((share * last.saturating_sub(first) as f64) as i64);
        let (from, to) = (at(from), at(to));
        let mut part = self.clone();
        for camera in &mut part.cameras {
            camera.nanos.retain(|nanos| (from..=to).contains(nanos));
            camera.outlines.retain(|(at, _)| (from..=to).contains(at));
            camera.tracks.iter_mut().for_each(|track| track.samples.retain(|(at, ..)| (from..=to).contains(at)));
        }
        part
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parabolas_are_followed_exactly_and_ends_give_nothing() {
        let mut tracks = PersonTracks::new(1, 1);
        let path = |s: f64| DVec2::new(100.0 + 40.0 * s - 300.0 * s * s, 50.0 - 80.0 * s);
        for i in 0..30 {
            tracks.add(0, i * 33_000_000, &[Some((path(0.033 * i as f64), 0.8))]);
        }
        let interval = tracks.interval_s(0);
        let place = tracks.track(0, 0).at(400_000_000, interval).unwrap();
        assert!(place.pixel.distance(path(0.4)) < 1e-9, "{place:?}");
        assert!(place.velocity.distance(DVec2::new(40.0 - 600.0 * 0.4, -80.0)) < 1e-6, "{place:?}");
        assert!((place.confidence - 0.8).abs() < 1e-12);
        for nanos in [-20_000_000, 1_100_000_000, i64::MIN, i64::MAX] {
            assert_eq!(tracks.track(0, 0).at(nanos, interval), None, "{nanos}");
        }
    }

    #[test]
    fn poisoned_and_late_images_are_left_out() {
        let mut tracks = PersonTracks::new(1, 2);
        tracks.add(0, 5, &[Some((DVec2::NAN, 1.0)), Some((DVec2::ONE, f64::NAN))]);
        tracks.add(0, 5, &[Some((DVec2::ONE, 1.0))]);
        tracks.add(0, 3, &[Some((DVec2::ONE, 1.0))]);
        tracks.add(7, 9, &[Some((DVec2::ONE, 1.0))]);
        assert_eq!((tracks.images(0), tracks.images(7)), (1, 0));
        assert!(tracks.cameras[0].tracks.iter().all(|track| track.samples.is_empty()));
        assert_eq!(PersonTracks::new(0, 0).span(), None);
    }
}

//! One inference of the pose network, with its landmarks in the image.

use glam::DVec2;

use crate::error::TrackError;
use crate::image::crop::Crop;
use crate::image::pixels::Rgb;
use crate::landmarks::keypoints::{LANDMARK_COUNT, ViewKeypoints};
use crate::network::output::NetOutput;
use crate::network::pose_net::PoseNet;

/// Output of the pose network for one crop of an image.
#[derive(Debug, Clone)]
pub(crate) struct Sighting {
    pub crop: Crop,
    pub output: NetOutput,
    /// Landmarks in pixels of the image.
    pub keypoints: ViewKeypoints,
}

impl Sighting {
    /// Runs the network on a crop.
    ///
    /// # Errors
    /// Kind `Net` when the network fails.
    pub fn infer(net: &PoseNet, picture: &Rgb, crop: Crop) -> Result<Self, TrackError> {
        let output = net.infer(picture, crop)?;
        let keypoints = crop.keypoints(&output);
        Ok(Self { crop, output, keypoints })
    }

    /// Returns the crop around these landmarks.
    pub fn next_crop(&self) -> Option<Crop> {
        Crop::around(&self.keypoints.map(|keypoint| Some(keypoint.pixel).filter(|pixel| pixel.is_finite())))
    }

    /// Returns the mean confidence of the landmarks, 0..=1.
    pub fn mean_confidence(&self) -> f64 {
        let known = self.keypoints.iter().filter(|keypoint| keypoint.pixel.is_finite());
        let (sum, count) = known.fold((0.0, 0.0), |(sum, count), keypoint| (sum + keypoint.confidence, count + 1.0));
        sum / f64::max(count, 1.0)
    }

    /// Returns a score to rank sightings by: it grows with size and confidence.
    pub fn score(&self) -> f64 {
        self.output.presence * self.mean_confidence() * self.crop.side.max(1.0).sqrt()
    }

    /// Whether this is the person whose landmarks are at `pixels`.
    pub fn shows(&self, pixels: &[Option<DVec2>; LANDMARK_COUNT]) -> bool {
        self.mean_distance(pixels).is_some_and(|distance| distance < 0.1 * self.crop.side)
    }

    /// Returns the mean distance of the landmarks from `pixels`; `None` without a common one.
    pub fn mean_distance(&self, pixels: &[Option<DVec2>; LANDMARK_COUNT]) -> Option<f64> {
        let known = self.keypoints.iter().zip(pixels).filter(|(own, _)| own.pixel.is_finite());
        let pairs = known.filter_map(|(own, other)| Some((own.pixel, (*other)?)));
        let (sum, count) = pairs.fold((0.0, 0.0), |(sum, count), (a, b)| (sum + a.distance(b), count + 1.0));
        (count > 0.0).then(|| sum / count)
    }

    /// Whether both are the same person.
    pub fn overlaps(&self, other: &Self) -> bool {
        let pixels = other.keypoints.map(|keypoint| Some(keypoint.pixel).filter(|pixel| pixel.is_finite()));
        self.mean_distance(&pixels).is_some_and(|distance| distance < 0.1 * self.crop.side.max(other.crop.side))
    }
}

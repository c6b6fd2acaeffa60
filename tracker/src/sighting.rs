//! The pose network's view of one crop.

use glam::DVec2;

use crate::crop::Crop;
use crate::net::NetOutput;
use crate::pixels::Rgb;
use crate::{LANDMARK_COUNT, PoseNet, TrackError, ViewKeypoints};

/// The network's output for one crop of an image.
#[derive(Debug, Clone)]
pub(crate) struct Sighting {
    pub crop: Crop,
    pub output: NetOutput,
    pub keypoints: ViewKeypoints,
}

impl Sighting {
    pub fn take(net: &PoseNet, picture: &Rgb, crop: Crop) -> Result<Self, TrackError> {
        let output = net.run(&crop.sample(picture))?;
        let keypoints = crop.keypoints(&output);
        Ok(Self { crop, output, keypoints })
    }

    /// The crop that the landmarks ask for.
    pub fn next_crop(&self) -> Option<Crop> {
        Crop::around(&std::array::from_fn(|i| Some(self.keypoints[i].pixel)))
    }

    pub fn mean_confidence(&self) -> f64 {
        self.keypoints.iter().map(|k| k.confidence).sum::<f64>() / LANDMARK_COUNT as f64
    }

    /// Larger and surer is better.
    pub fn score(&self) -> f64 {
        self.output.presence * self.mean_confidence() * self.crop.side.max(1.0).sqrt()
    }

    /// Whether this is the person with these landmarks in the image.
    pub fn shows(&self, pixels: &[Option<DVec2>; LANDMARK_COUNT]) -> bool {
        self.mean_distance(pixels).is_some_and(|distance| distance < 0.1 * self.crop.side)
    }

    /// Mean distance of the landmarks from others, pixels; `None` without any.
    pub fn mean_distance(&self, pixels: &[Option<DVec2>; LANDMARK_COUNT]) -> Option<f64> {
        let pairs = self.keypoints.iter().zip(pixels).filter_map(|(own, other)| Some((own.pixel, (*other)?)));
        let (sum, count) = pairs.fold((0.0, 0.0), |(sum, count), (a, b)| (sum + a.distance(b), count + 1.0));
        (count > 0.0).then(|| sum / count)
    }

    pub fn overlaps(&self, other: &Self) -> bool {
        let mut distance = 0.0;
        for (a, b) in self.keypoints.iter().zip(&other.keypoints) {
            distance += (a.pixel - b.pixel).length();
        }
        distance / (LANDMARK_COUNT as f64) < 0.1 * self.crop.side.max(other.crop.side)
    }
}

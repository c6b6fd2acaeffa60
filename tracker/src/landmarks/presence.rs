//! Test for people in an image, for plates that must show none.

use flyrig_types::Image;

use crate::error::TrackError;
use crate::image::pixels::Rgb;
use crate::landmarks::search::sightings;
use crate::network::pose_net::PoseNet;
use crate::pose::config::PoseConfig;

/// Least probability of a person: an empty room has furniture that looks a little like one.
const SURE: f64 = 0.8;

/// Whether the pose network finds a person anywhere in an image. Takes about a second.
///
/// # Errors
/// Kinds `Image` and `Net` when the image cannot be read or the network fails.
pub fn shows_person(net: &PoseNet, image: &Image) -> Result<bool, TrackError> {
    let config = PoseConfig { presence_threshold: SURE, ..PoseConfig::default() };
    Ok(!sightings(net, &Rgb::new(image)?, &config)?.is_empty())
}

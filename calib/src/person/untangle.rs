//! Left-right confusions of the landmark network.

use flyrig_solve::RigidMotion;
use flyrig_types::Rig;
use glam::DVec2;

use super::{
    rays::{Ray, motions, nearest},
    tracks::PersonTracks,
};
use crate::projection::project;

/// Passes over all images.
const ROUNDS: usize = 3;
/// Left and right are exchanged where that lowers the distances to this fraction.
const CLEARLY: f64 = 0.5;

/// Corrects left-right confusions of single cameras that the other cameras contradict. `mirrored` holds groups of (left, right)
/// landmarks that are confused together. Returns the corrected tracks and the number of corrections.
pub(super) fn untangled(rig: &Rig, tracks: &PersonTracks, mirrored: &[Vec<(usize, usize)>]) -> (PersonTracks, usize) {
    let cameras = motions(rig);
    let mut tracks = tracks.clone();
    let mut corrections = 0;
    for _ in 0..ROUNDS {
        let before = tracks.clone();
        let intervals_s: Vec<f64> = (0..cameras.len()).map(|slot| before.interval_s(slot)).collect();
        let rays_at = |nanos: i64, landmark: usize| -> Vec<Ray> {
            let ray = |(slot, motion): (usize, &RigidMotion)| {
                let place = before.track(slot, landmark).at(nanos, intervals_s[slot])?;
                Ray::new(&rig.cameras[slot].intrinsics, motion, place.pixel, place.confidence)
            };
            cameras.iter().enumerate().filter_map(ray).collect()
        };
        let mut is_same = true;
        for (slot, motion) in cameras.iter().enumerate() {
            let intrinsics = &rig.cameras[slot].intrinsics;
            for nanos in before.times(slot) {
                let drawn = |landmark: usize| {
                    let rays = rays_at(nanos, landmark);
                    (rays.len() > 2).then(|| project(intrinsics, motion.apply(nearest(&rays)?))).flatten()
                };
                for group in mirrored {
                    let (mut as_seen, mut exchanged) = (0.0, 0.0);
                    for (left, right) in group {
                        let seen = |landmark| before.sample(slot, landmark, nanos);
                        let (Some(a), Some(b)) = (seen(*left), seen(*right)) else { continue };
                        let (Some(left), Some(right)) = (drawn(*left), drawn(*right)) else { continue };
                        let far = 0.5 * left.distance(right).max(1.0);
                        let off = |pixel: DVec2, drawn: DVec2| (pixel.distance(drawn) / far).min(2.0);
                        as_seen += off(a, left) + off(b, right);
                        exchanged += off(b, left) + off(a, right);
                    }
                    if exchanged < CLEARLY * as_seen {
                        group.iter().for_each(|(left, right)| tracks.exchange(slot, *left, *right, nanos));
                        is_same = false;
                        corrections += 1;
                    }
                }
            }
        }
        if is_same {
            break;
        }
    }
    (tracks, corrections)
}

//! Which views are compared, where there are more than are worth their time.

use std::collections::BTreeMap;

use flyrig_types::{Camera, CameraId};
use glam::DVec3;

/// A view that disagreed with all others is not chosen for so many frames, where there are others.
const PATIENCE: u32 = 30;

/// Keeps in mind which cameras disagreed.
#[derive(Debug, Default)]
pub struct Chooser {
    /// Frames until the camera gets another chance.
    doubted: BTreeMap<CameraId, u32>,
}

impl Chooser {
    /// At most `most` (0: all) of the cameras, those that look at `center` from directions as different as possible;
    /// ascending. The same cameras and center give the same choice.
    pub fn choose(&mut self, cameras: &[&Camera], center: DVec3, most: usize) -> Vec<usize> {
        self.doubted.retain(|_, left| {
            *left -= 1;
            *left > 0
        });
        if most == 0 || cameras.len() <= most {
            return (0..cameras.len()).collect();
        }
        let from: Vec<DVec3> = cameras.iter().map(|c| (c.position() - center).normalize_or_zero()).collect();
        let doubted = |i: usize| self.doubted.contains_key(&cameras[i].id);
        let mut chosen: Vec<usize> = Vec::with_capacity(most);
        while chosen.len() < most {
            // The largest cosine to a chosen one: the less, the newer is what the view tells.
            let known = |i: usize| chosen.iter().map(|&c| from[c].dot(from[i])).fold(-2.0, f64::max);
            let rest = (0..cameras.len()).filter(|i| !chosen.contains(i));
            let best = rest.min_by(|&a, &b| doubted(a).cmp(&doubted(b)).then(known(a).total_cmp(&known(b))));
            let Some(best) = best else { break };
            chosen.push(best);
        }
        chosen.sort_unstable();
        chosen
    }

    /// The camera disagreed with all others.
    pub fn doubt(&mut self, camera: &CameraId) {
        self.doubted.insert(camera.clone(), PATIENCE);
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry, Lens};
    use glam::DVec2;

    use super::*;

    /// On a circle around the origin at these degrees.
    fn ring(degrees: &[f64]) -> Vec<Camera> {
        let one = |(i, deg): (usize, &f64)| {
            let at = DVec3::new(deg.to_radians().cos(), deg.to_radians().sin(), 0.0) * 3.0;
            Camera {
                time_offset_nanos: 0,
                color: Default::default(),
                id: format!("{i}").into(),
                intrinsics: Intrinsics {
                    width: 64,
                    height: 64,
                    focal_px: DVec2::splat(60.0),
                    center_px: DVec2::splat(31.5),
                    lens: Lens::PINHOLE,
                },
                camera_from_world: Isometry::look_at(at, DVec3::ZERO, DVec3::Z),
            }
        };
        degrees.iter().enumerate().map(one).collect()
    }

    fn choose(chooser: &mut Chooser, cameras: &[Camera], center: DVec3, most: usize) -> Vec<usize> {
        chooser.choose(&cameras.iter().collect::<Vec<_>>(), center, most)
    }

    #[test]
    fn twins_are_left_out_and_all_sides_are_kept() {
        let cameras = ring(&[0.0, 3.0, 120.0, 121.0, 240.0, 238.0]);
        let mut chooser = Chooser::default();
        let three = choose(&mut chooser, &cameras, DVec3::ZERO, 3);
        assert_eq!(three.iter().map(|i| i / 2).collect::<Vec<_>>(), [0, 1, 2], "{three:?}");
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 3), three);
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 0), [0, 1, 2, 3, 4, 5]);
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 9), [0, 1, 2, 3, 4, 5]);
        assert_eq!(choose(&mut chooser, &[], DVec3::ZERO, 3), [0usize; 0]);
    }

    #[test]
    fn a_doubted_camera_is_replaced_for_a_while() {
        let cameras = ring(&[0.0, 90.0, 180.0, 270.0]);
        let mut chooser = Chooser::default();
        let first = choose(&mut chooser, &cameras, DVec3::ZERO, 2);
        chooser.doubt(&cameras[first[1]].id);
        let second = choose(&mut chooser, &cameras, DVec3::ZERO, 2);
        assert!(second != first && !second.contains(&first[1]));
        for _ in 0..PATIENCE {
            choose(&mut chooser, &cameras, DVec3::ZERO, 2);
        }
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 2), first);
        // Where all are needed, it is taken all the same.
        chooser.doubt(&cameras[0].id);
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 4), [0, 1, 2, 3]);
    }

    #[test]
    fn centers_that_are_no_numbers_choose_something() {
        let cameras = ring(&[0.0, 90.0, 180.0]);
        for center in [DVec3::NAN, DVec3::INFINITY, cameras[0].position()] {
            assert_eq!(choose(&mut Chooser::default(), &cameras, center, 2).len(), 2);
        }
    }
}

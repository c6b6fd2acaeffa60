//! Choice of the views that are compared, where there are more than are worth their time.

use std::collections::BTreeMap;

use flyrig_types::{Camera, CameraId};
use glam::DVec3;

/// Frame sets for which a view that disagreed with all others is not chosen, where there are others.
const PATIENCE: u32 = 30;

/// Chooser of views, with a memory of the cameras that disagreed.
#[derive(Debug, Default)]
pub struct ViewChooser {
    /// Frame sets until the camera gets another chance.
    distrusted: BTreeMap<CameraId, u32>,
}

impl ViewChooser {
    /// Returns the ascending indices of at most `most` cameras (0: all), those that look at `center` from directions as different as
    /// possible. Equal cameras and centres give equal choices.
    pub fn choose(&mut self, cameras: &[&Camera], center: DVec3, most: usize) -> Vec<usize> {
        self.distrusted.retain(|_, left| {
            *left -= 1;
            *left > 0
        });
        if most == 0 || cameras.len() <= most {
            return (0..cameras.len()).collect();
        }
        let from: Vec<DVec3> = cameras.iter().map(|c| (c.position() - center).normalize_or_zero()).collect();
        let distrusted = |i: usize| self.distrusted.contains_key(&cameras[i].id);
        let mut chosen: Vec<usize> = Vec::with_capacity(most);
        while chosen.len() < most {
            // The largest cosine to a chosen one: the smaller, the more the view adds.
            let known = |i: usize| chosen.iter().map(|&c| from[c].dot(from[i])).fold(-2.0, f64::max);
            let rest = (0..cameras.len()).filter(|i| !chosen.contains(i));
            let best = rest.min_by(|&a, &b| distrusted(a).cmp(&distrusted(b)).then(known(a).total_cmp(&known(b))));
            let Some(best) = best else { break };
            chosen.push(best);
        }
        chosen.sort_unstable();
        chosen
    }

    /// Notes that a camera disagreed with all others.
    pub fn distrust(&mut self, camera: &CameraId) {
        self.distrusted.insert(camera.clone(), PATIENCE);
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry, Lens};
    use glam::DVec2;

    use super::*;

    /// Returns cameras on a circle around the origin at these degrees.
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

    fn choose(chooser: &mut ViewChooser, cameras: &[Camera], center: DVec3, most: usize) -> Vec<usize> {
        chooser.choose(&cameras.iter().collect::<Vec<_>>(), center, most)
    }

    #[test]
    fn twins_are_left_out_and_all_sides_are_kept() {
        let cameras = ring(&[0.0, 3.0, 120.0, 121.0, 240.0, 238.0]);
        let mut chooser = ViewChooser::default();
        let three = choose(&mut chooser, &cameras, DVec3::ZERO, 3);
        assert_eq!(three.iter().map(|i| i / 2).collect::<Vec<_>>(), [0, 1, 2], "{three:?}");
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 3), three);
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 0), [0, 1, 2, 3, 4, 5]);
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 9), [0, 1, 2, 3, 4, 5]);
        assert_eq!(choose(&mut chooser, &[], DVec3::ZERO, 3), [0usize; 0]);
    }

    #[test]
    fn a_distrusted_camera_is_replaced_for_a_while() {
        let cameras = ring(&[0.0, 90.0, 180.0, 270.0]);
        let mut chooser = ViewChooser::default();
        let first = choose(&mut chooser, &cameras, DVec3::ZERO, 2);
        chooser.distrust(&cameras[first[1]].id);
        let second = choose(&mut chooser, &cameras, DVec3::ZERO, 2);
        assert!(second != first && !second.contains(&first[1]));
        for _ in 0..PATIENCE {
            choose(&mut chooser, &cameras, DVec3::ZERO, 2);
        }
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 2), first);
        // Where all are needed, it is taken all the same.
        chooser.distrust(&cameras[0].id);
        assert_eq!(choose(&mut chooser, &cameras, DVec3::ZERO, 4), [0, 1, 2, 3]);
    }

    #[test]
    fn centers_that_are_no_numbers_choose_something() {
        let cameras = ring(&[0.0, 90.0, 180.0]);
        for center in [DVec3::NAN, DVec3::INFINITY, cameras[0].position()] {
            assert_eq!(choose(&mut ViewChooser::default(), &cameras, center, 2).len(), 2);
        }
    }
}
